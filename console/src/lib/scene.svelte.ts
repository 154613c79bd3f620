// The samples of one camera with what its active model answers for them.
import { cameraPath, get, getAll, post } from './api';
import { distance_m } from './geo';
import { footOf } from './image';
import { failureOf, type Failure } from './failure';
import type { FusedFix, Sample } from './types';

/** Samples that are read for drawing; cameras with more are shown in part. */
export const MOST_SAMPLES = 12_000;
/** Samples that the model is asked for. */
const MOST_ANSWERS = 1_500;
const BATCH = 500;

export interface ScenePoint {
  sample: Sample;
  foot: { x: number; y: number };
  answer?: FusedFix;
  /** From the regressed position to the fix, m. */
  distance_m?: number;
}

export class Scene {
  points = $state.raw<ScenePoint[]>([]);
  total = $state(0);
  loading = $state(true);
  error = $state.raw<Failure>();
  readonly #camera: string;
  readonly #abort = new AbortController();

  constructor(camera: string) {
    this.#camera = camera;
  }

  close(): void {
    this.#abort.abort();
  }

  async load(hasModel: boolean): Promise<void> {
    this.loading = true;
    this.error = undefined;
    const signal = this.#abort.signal;
    try {
      const path = cameraPath(this.#camera, 'samples');
      this.total = (await get<{ count: number }>(`${path}/count`, { signal })).count;
      const samples = await getAll<Sample>(path, MOST_SAMPLES, signal);
      this.points = samples.map((sample) => ({ sample, foot: footOf(sample.bounding_box) }));
      if (hasModel) await this.#answer(signal);
    } catch (error) {
      if (!signal.aborted) this.error = failureOf(error);
    } finally {
      this.loading = false;
    }
  }

  /** Adds samples that were stored since, those of the last minute included: pairs are complete some seconds late. */
  async loadNewer(): Promise<void> {
    const newest = this.points.at(-1)?.sample.time;
    const query = newest ? `?from=${encodeURIComponent(new Date(Date.parse(newest) - 60_000).toISOString())}` : '';
    const path = cameraPath(this.#camera, 'samples') + query;
    const known = new Set(this.points.map(({ sample }) => keyOf(sample)));
    try {
      const samples = await getAll<Sample>(path, MOST_SAMPLES, this.#abort.signal);
      const added = samples.filter((sample) => !known.has(keyOf(sample)));
      if (added.length > 0) this.points = [...this.points, ...added.map((sample) => ({ sample, foot: footOf(sample.bounding_box) }))];
    } catch (error) {
      if (!this.#abort.signal.aborted) this.error = failureOf(error);
    }
  }

  /** Asks the active model for evenly chosen samples, with the fixes that they have. */
  async #answer(signal: AbortSignal): Promise<void> {
    const step = Math.max(1, Math.ceil(this.points.length / MOST_ANSWERS));
    const chosen = this.points.filter((_, at) => at % step === 0);
    for (let from = 0; from < chosen.length; from += BATCH) {
      const batch = chosen.slice(from, from + BATCH);
      const observations = batch.map(({ sample }) => ({
        time: sample.time,
        target_id: sample.target_id,
        bounding_box: sample.bounding_box,
        ...(sample.fix ? { fix: sample.fix } : {}),
      }));
      const { items } = await post<{ items: FusedFix[] }>(cameraPath(this.#camera, 'fusions'), { observations }, { signal });
      items.forEach((answer, at) => {
        const point = batch[at]!;
        point.answer = answer;
        if (answer.regressed && point.sample.fix) point.distance_m = distance_m(answer.regressed, point.sample.fix);
      });
      this.points = [...this.points];
    }
  }
}

function keyOf({ time, target_id }: Sample): string {
  return `${time} ${target_id}`;
}
