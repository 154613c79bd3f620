// Where an aerial image lies on the earth, as files state it.
import type { Position } from './types';

/** The upper left, upper right, lower right and lower left corner of an image. */
export type Corners = [Position, Position, Position, Position];

/** x = a column + c row + e, y = b column + d row + f; column and row count from the upper left corner. */
export interface Affine {
  a: number;
  b: number;
  c: number;
  d: number;
  e: number;
  f: number;
}

/** Radius of the sphere of the web's Mercator projection, m. */
const MERCATOR_RADIUS_M = 6_378_137;

/** The six lines of a world file, whose last two are the middle of the upper left pixel; undefined if it is none. */
export function readWorldFile(text: string): Affine | undefined {
  const numbers = text.trim().split(/\s+/).map(Number);
  if (numbers.length !== 6 || !numbers.every(Number.isFinite)) return undefined;
  const [a, b, c, d, x, y] = numbers as [number, number, number, number, number, number];
  return { a, b, c, d, e: x - (a + c) / 2, f: y - (b + d) / 2 };
}

/**
 * The corners of an image of that size. Coordinates are degrees, or metres of the web's Mercator projection (EPSG:3857); undefined
 * if they are neither.
 */
export function cornersOf({ a, b, c, d, e, f }: Affine, width_px: number, height_px: number): Corners | undefined {
  const at = (column: number, row: number): [number, number] => [a * column + c * row + e, b * column + d * row + f];
  const points = [at(0, 0), at(width_px, 0), at(width_px, height_px), at(0, height_px)];
  const areDegrees = points.every(([x, y]) => Math.abs(x) <= 180 && Math.abs(y) <= 90);
  const positions = points.map(([x, y]) => (areDegrees ? { longitude_deg: x, latitude_deg: y } : ofMercator(x, y)));
  const areOnEarth = positions.every(({ longitude_deg, latitude_deg }) => Math.abs(longitude_deg) <= 180 && Math.abs(latitude_deg) <= 85.06);
  return areOnEarth ? (positions as Corners) : undefined;
}

function ofMercator(x_m: number, y_m: number): Position {
  const degrees = 180 / Math.PI;
  return {
    longitude_deg: (x_m / MERCATOR_RADIUS_M) * degrees,
    latitude_deg: (2 * Math.atan(Math.exp(y_m / MERCATOR_RADIUS_M)) - Math.PI / 2) * degrees,
  };
}
