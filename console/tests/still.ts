// A still image of a simulated camera for the pictures of the documentation: its ground, paved, as its boxes show it.
import type { Page } from '@playwright/test';
import { toPlane } from '../src/lib/geo';
import type { ImageSize, Position } from '../src/lib/types';
import type { Row } from './world';

/** From the ground to homogeneous pixels, row by row; the last element is 1. */
type Homography = number[];

/** Least squares of the projective map from ground positions to foot points. */
function homography(points: { east: number; north: number; x: number; y: number }[]): Homography {
  const normal = Array.from({ length: 8 }, () => new Array<number>(9).fill(0));
  const add = (row: number[], value: number): void => {
    row.forEach((a, i) => {
      row.forEach((b, j) => (normal[i]![j]! += a * b));
      normal[i]![8]! += a * value;
    });
  };
  for (const { east: e, north: n, x, y } of points) {
    add([e, n, 1, 0, 0, 0, -e * x, -n * x], x);
    add([0, 0, 0, e, n, 1, -e * y, -n * y], y);
  }
  for (let at = 0; at < 8; at++) {
    const pivot = normal.slice(at).reduce((best, row, index) => (Math.abs(row[at]!) > Math.abs(normal[best]![at]!) ? at + index : best), at);
    [normal[at], normal[pivot]] = [normal[pivot]!, normal[at]!];
    for (let other = 0; other < 8; other++) {
      if (other === at) continue;
      const factor = normal[other]![at]! / normal[at]![at]!;
      for (let column = at; column < 9; column++) normal[other]![column]! -= factor * normal[at]![column]!;
    }
  }
  return [...normal.map((row, at) => row[8]! / row[at]!), 1];
}

/** A PNG of what the camera would see. */
export async function stillOf(page: Page, rows: Row[], size: ImageSize): Promise<Buffer> {
  const seen = rows.flatMap(({ truth, box }) => (truth ? [{ truth, x: box.left_px + box.width_px / 2, y: box.top_px + box.height_px }] : []));
  const reference: Position = seen[0]!.truth;
  // Scaled, so that all terms of the normal equations are about one.
  const [ground_m, image_px] = [20, size.width_px / 2];
  const points = seen.map(({ truth, x, y }) => {
    const { east_m, north_m } = toPlane(reference, truth);
    return { east: east_m / ground_m, north: north_m / ground_m, x: x / image_px, y: y / image_px };
  });
  const url = await page.evaluate(drawStill, { map: homography(points), ground_m, image_px, ...size });
  return Buffer.from(url.split(',')[1]!, 'base64');
}

/** Runs in the page. */
function drawStill({ map, ground_m, image_px, width_px, height_px }: { map: number[]; ground_m: number; image_px: number } & ImageSize): string {
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [width_px, height_px];
  const context = canvas.getContext('2d')!;
  let state = 7;
  const random = (): number => (state = (state * 16807) % 2147483647) / 2147483647;
  const project = (east_m: number, north_m: number): { x: number; y: number; w: number } => {
    const [e, n] = [east_m / ground_m, north_m / ground_m];
    const w = map[6]! * e + map[7]! * n + map[8]!;
    return { x: (image_px * (map[0]! * e + map[1]! * n + map[2]!)) / w, y: (image_px * (map[3]! * e + map[4]! * n + map[5]!)) / w, w };
  };
  // The horizon is the image of the line at infinity; directions to both sides of the view are enough to find it.
  const far = [0, 1, 2, 3, 4, 5, 6, 7].map((turn) => project(1e6 * Math.cos((turn * Math.PI) / 4), 1e6 * Math.sin((turn * Math.PI) / 4))).filter(({ w }) => w > 0);
  const horizon = Math.min(height_px * 0.4, Math.max(60, far.reduce((sum, { y }) => sum + y, 0) / Math.max(far.length, 1)));

  const sky = context.createLinearGradient(0, 0, 0, horizon);
  sky.addColorStop(0, '#7f95a3');
  sky.addColorStop(1, '#c3ccd0');
  context.fillStyle = sky;
  context.fillRect(0, 0, width_px, height_px);
  context.fillStyle = '#8b8f8c';
  context.fillRect(0, horizon, width_px, height_px);
  const paving_m = 2;
  for (let east = -90; east < 90; east += paving_m) {
    for (let north = -90; north < 90; north += paving_m) {
      const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([a, b]) => project(east + a! * paving_m, north + b! * paving_m));
      const shade = 128 + 26 * random() + ((east + north) % 8 === 0 ? 10 : 0);
      if (corners.some(({ x, y, w }) => w <= 0.02 || Math.abs(x) > 4 * width_px || y < horizon - 2 || y > 4 * height_px)) continue;
      context.beginPath();
      corners.forEach(({ x, y }, at) => (at === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
      context.closePath();
      context.fillStyle = `rgb(${shade} ${shade} ${shade - 7})`;
      context.fill();
    }
  }
  for (let x = -40; x < width_px; ) {
    const [wide, high] = [90 + 120 * random(), (0.45 + 0.5 * random()) * horizon];
    const shade = 86 + 50 * random();
    context.fillStyle = `rgb(${shade} ${shade - 4} ${shade - 10})`;
    context.fillRect(x, horizon - high, wide, high + 6);
    context.fillStyle = `rgb(${shade - 26} ${shade - 26} ${shade - 22})`;
    for (let row = 10; row < high - 14; row += 24) for (let column = 10; column < wide - 14; column += 22) context.fillRect(x + column, horizon - high + row, 11, 14);
    x += wide + 3;
  }
  const light = context.createRadialGradient(width_px * 0.6, height_px * 0.5, height_px * 0.2, width_px * 0.5, height_px * 0.55, width_px * 0.7);
  light.addColorStop(0, 'rgb(0 0 0 / 4%)');
  light.addColorStop(1, 'rgb(0 0 0 / 34%)');
  context.fillStyle = light;
  context.fillRect(0, 0, width_px, height_px);
  return canvas.toDataURL('image/png');
}
