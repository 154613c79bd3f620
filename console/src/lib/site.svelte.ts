// The targets of a site as its cameras measure them together.
import { get, sitePath } from './api';
import { listen } from './events';
import type { Position, WorldTrack, WorldTrackFeature } from './types';

const TRAIL_POINTS = 240;
/** How often the cameras' clocks are asked for. */
const CLOCKS_MS = 10_000;
const MOST_CHANGES = 50;

export interface SiteTarget extends WorldTrack {
  trail: Position[];
  heardAt_ms: number;
}

/** Events of a track other than moves. */
export interface TrackChange {
  kind: 'handed_over' | 'identified' | 'merged';
  time: string;
  track_id: string;
  from_camera_id?: string;
  to_camera_id?: string;
  target_id?: string;
  ended_track_id?: string;
}

/** A camera whose clock is wrong beside those of the site's other cameras. */
export interface WrongClock {
  camera_id: string;
  offset_s: number;
}

export class SiteLive {
  targets = $state.raw<SiteTarget[]>([]);
  changes = $state.raw<TrackChange[]>([]);
  wrongClocks = $state.raw<WrongClock[]>([]);
  isOpen = $state(false);
  wasOpen = $state(false);
  readonly #targets = new Map<string, SiteTarget>();
  readonly #stop: () => void;
  readonly #clocks: ReturnType<typeof setInterval>;
  #frame = 0;

  constructor(site: string) {
    const path = sitePath(site);
    const change = (kind: TrackChange['kind']) => (data: unknown) => {
      this.changes = [{ ...(data as Omit<TrackChange, 'kind'>), kind }, ...this.changes].slice(0, MOST_CHANGES);
    };
    this.#stop = listen(`${path}/events`, {
      on: {
        track: (data) => {
          const { properties, geometry } = data as WorldTrackFeature;
          const [longitude_deg, latitude_deg] = geometry.coordinates;
          this.#take({ ...properties, position: { longitude_deg, latitude_deg } });
        },
        handed_over: change('handed_over'),
        identified: change('identified'),
        merged: (data) => {
          change('merged')(data);
          this.#end((data as TrackChange).ended_track_id!);
        },
        track_ended: (data) => this.#end((data as TrackChange).track_id),
      },
      state: (isOpen) => {
        this.isOpen = isOpen;
        this.wasOpen ||= isOpen;
        if (isOpen) void this.#readTracks(path);
      },
    });
    this.#clocks = setInterval(() => this.isOpen && void this.#readNow(path), CLOCKS_MS);
  }

  close(): void {
    this.#stop();
    clearInterval(this.#clocks);
    cancelAnimationFrame(this.#frame);
  }

  /** Those that are there before the events begin; what ended while nobody listened is gone. */
  async #readTracks(path: string): Promise<void> {
    const items = await this.#readNow(path);
    const ids = new Set(items.map(({ id }) => id));
    for (const id of [...this.#targets.keys()]) if (!ids.has(id)) this.#targets.delete(id);
    for (const track of items) if (!this.#targets.has(track.id)) this.#take(track);
    this.#publish();
  }

  /** The tracks; the clocks that come with them are shown. */
  async #readNow(path: string): Promise<WorldTrack[]> {
    type Answer = { items: WorldTrack[]; clocks?: (WrongClock & { is_wrong: boolean })[] };
    const { items, clocks = [] } = await get<Answer>(`${path}/tracks`).catch((): Answer => ({ items: [] }));
    this.wrongClocks = clocks.filter(({ is_wrong }) => is_wrong);
    return items;
  }

  #take(track: WorldTrack): void {
    const trail = [...(this.#targets.get(track.id)?.trail ?? []), track.position].slice(-TRAIL_POINTS);
    this.#targets.set(track.id, { ...track, trail, heardAt_ms: Date.now() });
    this.#publish();
  }

  #end(id: string): void {
    this.#targets.delete(id);
    this.#publish();
  }

  /** Once per frame, however many events come. */
  #publish(): void {
    cancelAnimationFrame(this.#frame);
    this.#frame = requestAnimationFrame(() => {
      this.targets = [...this.#targets.values()].sort((a, b) => a.id.localeCompare(b.id, undefined, { numeric: true }));
    });
  }
}
