// The targets of one camera as they are measured.
import { cameraPath, get } from './api';
import { listen } from './events';
import type { BoundingBox, CameraMoved, Fix, FusedFix, Position, TrackFeature, TrackUpdate } from './types';

const TRAIL_POINTS = 120;
/** A target that was not measured for this long is shown as lost. */
export const LOST_AFTER_MS = 5_000;
/** Targets whose trail is read when the view opens. */
const MOST_HISTORIES = 50;
const FORGET_AFTER_MS = 60_000;
/** Flags are shown for this long after their last observation. */
export const FLAG_SHOWN_MS = 4_000;

const BY_NUMBER = new Intl.Collator(undefined, { numeric: true });

export interface LiveTarget {
  id: string;
  position: Position;
  state: TrackFeature['properties'];
  trail: Position[];
  fixes: Position[];
  regressed: Position[];
  box?: BoundingBox;
  latest?: FusedFix;
  latestFix?: Fix;
  heardAt_ms: number;
}

export class Live {
  targets = $state.raw<LiveTarget[]>([]);
  isOpen = $state(false);
  wasOpen = $state(false);
  lostEvents = $state(0);
  events = $state(0);
  moved = $state.raw<CameraMoved>();
  readonly #targets = new Map<string, LiveTarget>();
  readonly #stop: () => void;
  readonly #sweep: ReturnType<typeof setInterval>;
  #frame = 0;

  constructor(camera: string) {
    this.#stop = listen(cameraPath(camera, 'events'), {
      on: {
        track: (data) => this.#take(data as TrackUpdate, Date.now()),
        camera_moved: (data) => (this.moved = data as CameraMoved),
        // Without a number after a restart of the server.
        lost: (data) => (this.lostEvents += Number(data ?? 0)),
      },
      state: (isOpen) => {
        this.isOpen = isOpen;
        this.wasOpen ||= isOpen;
        if (isOpen) void this.#readTracks(camera);
      },
    });
    this.#sweep = setInterval(() => this.#forget(), 1000);
  }

  close(): void {
    this.#stop();
    clearInterval(this.#sweep);
    cancelAnimationFrame(this.#frame);
  }

  /** The tracks from before the events began. */
  async #readTracks(camera: string): Promise<void> {
    const read = async (...path: string[]): Promise<TrackFeature[]> =>
      (await get<{ features: TrackFeature[] }>(cameraPath(camera, 'tracks', ...path)).catch(() => ({ features: [] }))).features;
    for (const feature of (await read()).slice(0, MOST_HISTORIES)) {
      const id = feature.properties.target_id;
      const history = await read(id);
      if (!this.#targets.has(id)) this.#take(feature, Date.now());
      const target = this.#targets.get(id)!;
      const before = history.map(({ geometry: { coordinates } }) => ({ longitude_deg: coordinates[0], latitude_deg: coordinates[1] }));
      target.trail = [...before, ...target.trail].slice(-TRAIL_POINTS);
    }
    this.#publish();
  }

  #take(update: TrackUpdate, now_ms: number): void {
    const id = update.properties.target_id;
    const [longitude_deg, latitude_deg] = update.geometry.coordinates;
    const position = { longitude_deg, latitude_deg };
    const known = this.#targets.get(id);
    const target: LiveTarget = known ?? { id, position, state: update.properties, trail: [], fixes: [], regressed: [], heardAt_ms: now_ms };
    target.position = position;
    target.state = update.properties;
    target.heardAt_ms = now_ms;
    if (update.properties.restarted) target.trail = [];
    push(target.trail, position);
    if (update.fused?.gnss) {
      target.latestFix = update.fused.gnss;
      push(target.fixes, update.fused.gnss);
    }
    if (update.fused?.regressed) push(target.regressed, update.fused.regressed);
    if (update.bounding_box) target.box = update.bounding_box;
    if (update.fused) target.latest = update.fused;
    this.#targets.set(id, target);
    this.events += 1;
    this.#publish();
  }

  #forget(): void {
    const now_ms = Date.now();
    for (const [id, target] of this.#targets) {
      if (now_ms - target.heardAt_ms > FORGET_AFTER_MS) this.#targets.delete(id);
    }
    this.#publish();
  }

  /** Once per frame, however many events come. */
  #publish(): void {
    cancelAnimationFrame(this.#frame);
    this.#frame = requestAnimationFrame(() => {
      this.targets = [...this.#targets.values()].sort((a, b) => BY_NUMBER.compare(a.id, b.id));
    });
  }
}

function push(trail: Position[], position: Position): void {
  trail.push(position);
  if (trail.length > TRAIL_POINTS) trail.shift();
}
