// Where an aerial image lies on the earth, as files state it.
import type { Position } from './types';

/** The upper left, upper right, lower right and lower left corner of an image. */
export type Corners = [Position, Position, Position, Position];

/** The position of coordinates of a file. */
export type ToPosition = (x: number, y: number) => Position;

/** x = a column + c row + e, y = b column + d row + f; column and row count from the upper left corner. */
export interface Affine {
  a: number;
  b: number;
  c: number;
  d: number;
  e: number;
  f: number;
}

/** The six lines of a world file, whose last two are the middle of the upper left pixel; undefined if it is none. */
export function readWorldFile(text: string): Affine | undefined {
  const numbers = text.trim().split(/\s+/).map(Number);
  if (numbers.length !== 6 || !numbers.every(Number.isFinite)) return undefined;
  const [a, b, c, d, x, y] = numbers as [number, number, number, number, number, number];
  return { a, b, c, d, e: x - (a + c) / 2, f: y - (b + d) / 2 };
}

/** The corners of an image of that size, whose coordinates `toPosition` converts; undefined if they are outside of the earth. */
export function cornersOf({ a, b, c, d, e, f }: Affine, width_px: number, height_px: number, toPosition: ToPosition): Corners | undefined {
  const at = (column: number, row: number): Position => toPosition(a * column + c * row + e, b * column + d * row + f);
  const positions: Corners = [at(0, 0), at(width_px, 0), at(width_px, height_px), at(0, height_px)];
  // A map in Mercator's projection ends there; numbers that are none are not on the earth either.
  const areOnEarth = positions.every(({ longitude_deg, latitude_deg }) => Math.abs(longitude_deg) <= 180 && Math.abs(latitude_deg) <= 85.06);
  return areOnEarth ? positions : undefined;
}
