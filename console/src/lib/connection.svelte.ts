// Whether the server answers, and whether it asks for a key.

class Connection {
  lost = $state(false);
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
