// The state of the connection: if the server answers, and if it asks for a key.

/** When this page last loaded itself again, ms since 1970. */
const RELOADED_AT = 'sightfix.reloaded_at';
const RELOAD_AGAIN_AFTER_MS = 60_000;

class Connection {
  lost = $state(false);
  /** True if a part of the page could not be loaded: the line broke, or the server has a newer release. */
  isIncomplete = $state(false);
  #timer: ReturnType<typeof setTimeout> | undefined;

  /** Called by every request that found no server; asks until it is back. */
  lose(): void {
    this.lost = true;
    this.#timer ??= setTimeout(() => void this.#probe(), 1500);
  }

  regain(): void {
    this.lost = false;
    clearTimeout(this.#timer);
    this.#timer = undefined;
    if (this.isIncomplete) this.#reload();
  }

  /** Called when a part of the page could not be loaded: loads the page again once the server answers. */
  missPart(): void {
    this.isIncomplete = true;
    this.#timer ??= setTimeout(() => void this.#probe(), 0);
  }

  /** Once: if that did not help, the operator decides. */
  #reload(): void {
    const last_ms = Number(sessionStorage.getItem(RELOADED_AT) ?? 0);
    if (Date.now() - last_ms < RELOAD_AGAIN_AFTER_MS) return;
    sessionStorage.setItem(RELOADED_AT, String(Date.now()));
    location.reload();
  }

  async #probe(): Promise<void> {
    this.#timer = undefined;
    try {
      await fetch('/livez', { cache: 'no-store' });
      this.regain();
    } catch {
      this.lose();
    }
  }
}

class Session {
  /** Set when an answer was 401: the sign-in view covers the page. */
  required = $state(false);
  /** Counts sign-ins, so that views read again. */
  generation = $state(0);

  signedIn(): void {
    this.required = false;
    this.generation += 1;
  }
}

export const connection = new Connection();
export const session = new Session();
