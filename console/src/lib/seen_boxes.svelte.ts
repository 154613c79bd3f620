// The boxes of one camera as they come, with or without a position.
import { cameraPath } from './api';
import { listen } from './events';
import type { BoundingBox, SeenBox, TrackUpdate } from './types';

/** A detector such as Frigate does not report every frame. */
const SHOWN_MS = 4_000;
const SWEEP_MS = 500;

export interface ShownBox {
  id: string;
  box: BoundingBox;
  class?: string;
  score?: number;
  heardAt_ms: number;
}

export class SeenBoxes {
  shown = $state.raw<ShownBox[]>([]);
  count = $state(0);
  /** Every class that was seen. */
  classes = $state.raw<string[]>([]);
  readonly #boxes = new Map<string, ShownBox>();
  readonly #stop: () => void;
  readonly #sweep: ReturnType<typeof setInterval>;
  #frame = 0;

  constructor(camera: string) {
    this.#stop = listen(cameraPath(camera, 'events'), {
      on: {
        box: (data) => {
          const { target_id, tracker_id, bounding_box, ...label } = data as SeenBox;
          this.#take(target_id ?? tracker_id ?? '', bounding_box, label);
        },
        track: (data) => {
          const { properties, bounding_box } = data as TrackUpdate;
          if (bounding_box) this.#take(properties.target_id, bounding_box, {});
        },
      },
      state: () => undefined,
    });
    this.#sweep = setInterval(() => this.#forget(), SWEEP_MS);
  }

  close(): void {
    this.#stop();
    clearInterval(this.#sweep);
    cancelAnimationFrame(this.#frame);
  }

  #take(id: string, box: BoundingBox, label: { class?: string; score?: number }): void {
    this.#boxes.set(id, { id, box, heardAt_ms: Date.now(), ...(label.class ? { class: label.class } : {}), ...(label.score === undefined ? {} : { score: label.score }) });
    this.count += 1;
    if (label.class && !this.classes.includes(label.class)) this.classes = [...this.classes, label.class].sort();
    this.#publish();
  }

  #forget(): void {
    const since_ms = Date.now() - SHOWN_MS;
    for (const [id, { heardAt_ms }] of this.#boxes) if (heardAt_ms < since_ms) this.#boxes.delete(id);
    if (this.#boxes.size !== this.shown.length) this.#publish();
  }

  /** Once per frame, however many boxes come. */
  #publish(): void {
    cancelAnimationFrame(this.#frame);
    this.#frame = requestAnimationFrame(() => (this.shown = [...this.#boxes.values()]));
  }
}
