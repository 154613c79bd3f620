// Geometry of the image plane: foot points, the image's size, and where training has been.
import type { BoundingBox, Camera, ImageSize } from './types';

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

/** Parts of the image, a third of its width and height each, row by row. */
export const NINTHS = ['upperLeft', 'upper', 'upperRight', 'left', 'middle', 'right', 'lowerLeft', 'lower', 'lowerRight'] as const;
export type Ninth = (typeof NINTHS)[number];

/** The ninths of the image with hardly any foot point: what to walk next. */
export function emptyNinths(points: { foot: { x: number; y: number } }[], size: ImageSize): Ninth[] {
  const counts = new Array<number>(NINTHS.length).fill(0);
  const third = (value: number, extent: number): number => Math.min(2, Math.max(0, Math.floor((value / extent) * 3)));
  for (const { foot } of points) counts[third(foot.y, size.height_px) * 3 + third(foot.x, size.width_px)]! += 1;
  return NINTHS.filter((_, at) => counts[at]! < Math.max(5, points.length * 0.005));
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
