// Where the targets of live cameras are now, for the map of all cameras.
import { cameraPath, get } from './api';
import type { CameraStatus, Position, TrackFeature } from './types';

const PAUSE_MS = 3000;
/** Cameras that are asked in a turn; with more, each is asked every few turns. */
const CAMERAS_PER_TURN = 20;

export class OverviewTargets {
  positions = $state.raw<Position[]>([]);
  readonly #statuses: () => CameraStatus[];
  readonly #byCamera = new Map<string, Position[]>();
  #next = 0;

  constructor(statuses: () => CameraStatus[]) {
    this.#statuses = statuses;
  }

  /** Reads again and again until the returned function is called. */
  watch(): () => void {
    const timer = setInterval(() => void this.#turn(), PAUSE_MS);
    return () => clearInterval(timer);
  }

  async #turn(): Promise<void> {
    if (document.hidden) return;
    const live = this.#statuses().filter(({ targets }) => targets > 0).map(({ camera }) => camera.id);
    for (const id of this.#byCamera.keys()) if (!live.includes(id)) this.#byCamera.delete(id);
    if (live.length === 0 && this.positions.length === 0) return;
    const count = Math.min(live.length, CAMERAS_PER_TURN);
    const asked = Array.from({ length: count }, (_, at) => live[(this.#next + at) % live.length]!);
    this.#next += count;
    await Promise.all(asked.map((id) => this.#read(id)));
    this.positions = [...this.#byCamera.values()].flat();
  }

  async #read(id: string): Promise<void> {
    const { features } = await get<{ features: TrackFeature[] }>(cameraPath(id, 'tracks')).catch(() => ({ features: [] }));
    const targets = features.map(({ geometry: { coordinates } }) => ({ longitude_deg: coordinates[0], latitude_deg: coordinates[1] }));
    this.#byCamera.set(id, targets);
  }
}
