// The statuses of all cameras, read again while somebody looks.
import { getAll } from './api';
import { failureOf, type Failure } from './failure';
import type { CameraStatus } from './types';

const MOST_CAMERAS = 10_000;

class Cameras {
  statuses = $state.raw<CameraStatus[]>([]);
  loaded = $state(false);
  error = $state.raw<Failure>();
  #watchers = 0;
  #timer: ReturnType<typeof setTimeout> | undefined;

  get(id: string): CameraStatus | undefined {
    return this.statuses.find((status) => status.camera.id === id);
  }

  async refresh(): Promise<void> {
    try {
      this.statuses = await getAll<CameraStatus>('/v1/camera-statuses', MOST_CAMERAS);
      this.loaded = true;
      this.error = undefined;
    } catch (error) {
      this.error = failureOf(error);
    }
  }

  /** Reads now and again and again until the returned function is called. */
  watch(): () => void {
    this.#watchers += 1;
    if (this.#watchers === 1) void this.#poll();
    return () => {
      this.#watchers -= 1;
      if (this.#watchers === 0) clearTimeout(this.#timer);
    };
  }

  async #poll(): Promise<void> {
    if (!document.hidden) await this.refresh();
    // Thousands of cameras are some megabytes.
    const pause_ms = Math.max(3000, this.statuses.length * 8);
    clearTimeout(this.#timer);
    if (this.#watchers > 0) this.#timer = setTimeout(() => void this.#poll(), pause_ms);
  }
}

export const cameras = new Cameras();
