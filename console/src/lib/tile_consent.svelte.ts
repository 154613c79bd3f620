// The consent to ask another server for map tiles, in this browser.
const STORED = 'sightfix.tile_consent';

class TileConsent {
  isGiven = $state(localStorage.getItem(STORED) === 'given');

  give(): void {
    localStorage.setItem(STORED, 'given');
    this.isGiven = true;
  }

  withdraw(): void {
    localStorage.removeItem(STORED);
    this.isGiven = false;
  }
}

export const consent = new TileConsent();
