// The samples of one camera with what its active model answers for them.
import { cameraPath, get, getAll, messageOf, post } from './api';
import { distance_m } from './geo';
import type { BoundingBox, Camera, FusedFix, ImageSize, Sample } from './types';

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

/** The lower middle of a box, where its target stands. */
export function footOf(box: BoundingBox): { x: number; y: number } {
  return { x: box.left_px + box.width_px / 2, y: box.top_px + box.height_px };
}

/** The camera's image, or what the boxes span where its size is unknown. */
export function imageSizeOf(camera: Camera | undefined, boxes: BoundingBox[]): ImageSize {
  if (camera?.image_size) return camera.image_size;
  let [width_px, height_px] = [0, 0];
  for (const box of boxes) {
    width_px = Math.max(width_px, box.left_px + box.width_px);
    height_px = Math.max(height_px, box.top_px + box.height_px);
  }
  const round = (value: number, least: number): number => Math.ceil(Math.max(value * 1.02, least) / 10) * 10;
  return boxes.length > 0 ? { width_px: round(width_px, 10), height_px: round(height_px, 10) } : { width_px: 1280, height_px: 720 };
}

export class Scene {
  points = $state.raw<ScenePoint[]>([]);
  total = $state(0);
  loading = $state(true);
  error = $state('');
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
    this.error = '';
    const signal = this.#abort.signal;
    try {
      const path = cameraPath(this.#camera, 'samples');
      this.total = (await get<{ count: number }>(`${path}/count`, { signal })).count;
      const samples = await getAll<Sample>(path, MOST_SAMPLES, signal);
      this.points = samples.map((sample) => ({ sample, foot: footOf(sample.bounding_box) }));
      if (hasModel) await this.#answer(signal);
    } catch (error) {
      if (!signal.aborted) this.error = messageOf(error);
    } finally {
      this.loading = false;
    }
  }

  /** Asks the active model for evenly chosen samples, with their fixes. */
  async #answer(signal: AbortSignal): Promise<void> {
    const step = Math.max(1, Math.ceil(this.points.length / MOST_ANSWERS));
    const chosen = this.points.filter((_, at) => at % step === 0);
    for (let from = 0; from < chosen.length; from += BATCH) {
      const batch = chosen.slice(from, from + BATCH);
      const observations = batch.map(({ sample }) => ({
        time: sample.time,
        target_id: sample.target_id,
        bounding_box: sample.bounding_box,
        fix: { longitude_deg: sample.fix.longitude_deg, latitude_deg: sample.fix.latitude_deg, ...(sample.fix.sigma_m ? { sigma_m: sample.fix.sigma_m } : {}) },
      }));
      const { items } = await post<{ items: FusedFix[] }>(cameraPath(this.#camera, 'fusions'), { observations }, { signal });
      items.forEach((answer, at) => {
        const point = batch[at]!;
        point.answer = answer;
        if (answer.regressed) point.distance_m = distance_m(answer.regressed, point.sample.fix);
      });
      this.points = [...this.points];
    }
  }
}

export interface Coverage {
  columns: number;
  rows: number;
  counts: number[];
  most: number;
  /** Occupied cells among all. */
  share: number;
}

/** Counts foot points in cells of the image. */
export function coverageOf(points: { foot: { x: number; y: number } }[], size: ImageSize, columns = 24): Coverage {
  const rows = Math.max(1, Math.round((columns * size.height_px) / size.width_px));
  const counts = new Array<number>(columns * rows).fill(0);
  for (const { foot } of points) {
    const column = Math.floor((foot.x / size.width_px) * columns);
    const row = Math.floor((Math.min(foot.y, size.height_px - 1e-6) / size.height_px) * rows);
    if (column >= 0 && column < columns && row >= 0 && row < rows) counts[row * columns + column]! += 1;
  }
  const occupied = counts.filter((count) => count > 0).length;
  return { columns, rows, counts, most: Math.max(1, ...counts), share: occupied / counts.length };
}
