// The targets of a site as its cameras measure them together.
import { get, sitePath } from './api';
import { listen } from './events';
import type { Position, WorldTrack, WorldTrackFeature } from './types';

const TRAIL_POINTS = 240;
/** How often the clocks are asked for. */
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

/** A camera or a receiver whose clock is wrong beside those of the site's other cameras. */
export interface WrongClock {
  kind: 'camera' | 'receiver';
  id: string;
  offset_s: number;
}

export class SiteLive {
  targets = $state.raw<SiteTarget[]>([]);
  changes = $state.raw<TrackChange[]>([]);
  wrongClocks = $state.raw<WrongClock[]>([]);
  /** By how much the times of all cameras are later than those of most receivers; 0 unless that is no chance. */
  camerasLate_s = $state(0);
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
    interface Clock { offset_s: number; is_wrong: boolean }
    interface Answer { items: WorldTrack[]; clocks?: (Clock & { camera_id: string })[]; receiver_clocks?: (Clock & { receiver_id: string })[]; common_receiver_clock?: Clock }
    const answer = await get<Answer>(`${path}/tracks`).catch((): Answer => ({ items: [] }));
    const { clocks = [], receiver_clocks: receivers = [], common_receiver_clock: common } = answer;
    const wrong = <T extends Clock>(list: T[], kind: WrongClock['kind'], id: (of: T) => string): WrongClock[] =>
      list.filter(({ is_wrong }) => is_wrong).map((clock) => ({ kind, id: id(clock), offset_s: clock.offset_s }));
    // Where all receivers are late, the cameras are early.
    this.camerasLate_s = common?.is_wrong ? -common.offset_s : 0;
    this.wrongClocks = [
      ...wrong(clocks, 'camera', ({ camera_id }) => camera_id),
      ...(this.camerasLate_s ? [] : wrong(receivers, 'receiver', ({ receiver_id }) => receiver_id)),
    ];
    return answer.items;
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
