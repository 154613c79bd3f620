// The targets of a site as its cameras measure them together.
import { get, sitePath } from './api';
import { listen } from './events';
import type { Position, WorldTrack, WorldTrackFeature } from './types';

const TRAIL_POINTS = 240;
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

export class SiteLive {
  targets = $state.raw<SiteTarget[]>([]);
  changes = $state.raw<TrackChange[]>([]);
  isOpen = $state(false);
  wasOpen = $state(false);
  readonly #targets = new Map<string, SiteTarget>();
  readonly #stop: () => void;
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
  }

  close(): void {
    this.#stop();
    cancelAnimationFrame(this.#frame);
  }

  /** Those that are there before the events begin; what ended while nobody listened is gone. */
  async #readTracks(path: string): Promise<void> {
    const { items } = await get<{ items: WorldTrack[] }>(`${path}/tracks`).catch(() => ({ items: [] }));
    const ids = new Set(items.map(({ id }) => id));
    for (const id of [...this.#targets.keys()]) if (!ids.has(id)) this.#targets.delete(id);
    for (const track of items) if (!this.#targets.has(track.id)) this.#take(track);
    this.#publish();
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
