// Handles on a Leaflet map that are dragged, or moved by the arrow keys.
import type * as L from 'leaflet';
import type { Position } from './types';

/** Called while a handle is moved, and when it is let go. */
export type OnMove = (at: number, position: Position, isDone: boolean) => void;

/** How far an arrow key moves a handle, px; with the shift key more. */
const STEP_PX = 1;
const LARGE_STEP_PX = 10;
const DIRECTIONS: Record<string, [right: number, down: number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class Handles {
  readonly #leaflet: typeof L;
  readonly #map: L.Map;
  #markers: L.Marker[] = [];
  #onmove: OnMove = () => {};

  constructor(leaflet: typeof L, map: L.Map) {
    this.#leaflet = leaflet;
    this.#map = map;
  }

  /** Shows a handle at each position; those that are there stay, so that one that is dragged is not let go. */
  show(positions: readonly Position[], labels: readonly string[], onmove: OnMove): void {
    this.#onmove = onmove;
    if (positions.length !== this.#markers.length) {
      this.clear();
      this.#markers = positions.map((position, at) => this.#marker(position, labels[at]!, at));
    }
    positions.forEach(({ latitude_deg, longitude_deg }, at) => this.#markers[at]!.setLatLng([latitude_deg, longitude_deg]));
  }

  clear(): void {
    this.#markers.splice(0).forEach((marker) => marker.remove());
  }

  #marker({ latitude_deg, longitude_deg }: Position, label: string, at: number): L.Marker {
    const icon = this.#leaflet.divIcon({ className: 'map-handle', iconSize: [24, 24] });
    const marker = this.#leaflet.marker([latitude_deg, longitude_deg], { icon, draggable: true, title: label, alt: label, autoPan: true });
    const moved = (isDone: boolean): void => {
      const { lng, lat } = marker.getLatLng();
      this.#onmove(at, { longitude_deg: lng, latitude_deg: lat }, isDone);
    };
    marker.on('drag', () => moved(false)).on('dragend', () => moved(true)).addTo(this.#map);
    const element = marker.getElement()!;
    element.setAttribute('aria-label', label);
    element.addEventListener('keydown', (event) => {
      const direction = DIRECTIONS[event.key];
      if (!direction) return;
      // The map would move as well.
      event.preventDefault();
      event.stopPropagation();
      const step = event.shiftKey ? LARGE_STEP_PX : STEP_PX;
      const { x, y } = this.#map.latLngToContainerPoint(marker.getLatLng());
      marker.setLatLng(this.#map.containerPointToLatLng([x + direction[0] * step, y + direction[1] * step]));
      moved(true);
    });
    return marker;
  }
}
