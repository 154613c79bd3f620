// Plane geometry about a reference position, and figures of it. Enough for drawing within some kilometres.
import type { Position } from './types';

export interface EastNorth {
  east_m: number;
  north_m: number;
}

const METRES_PER_DEGREE = 111_319.490793; // of longitude at the equator, WGS 84

/** Outlines of the world are off by a kilometre or two, which is seen beyond this zoom. */
export const CLOSEST_OUTLINES_ZOOM = 11;

/** Equirectangular projection about a reference. */
export function toPlane(reference: Position, position: Position): EastNorth {
  const scale = Math.cos((reference.latitude_deg * Math.PI) / 180);
  return {
    east_m: (position.longitude_deg - reference.longitude_deg) * METRES_PER_DEGREE * scale,
    north_m: (position.latitude_deg - reference.latitude_deg) * METRES_PER_DEGREE,
  };
}

export function toPosition(reference: Position, point: EastNorth): Position {
  const scale = Math.cos((reference.latitude_deg * Math.PI) / 180);
  return {
    longitude_deg: reference.longitude_deg + point.east_m / (METRES_PER_DEGREE * scale),
    latitude_deg: reference.latitude_deg + point.north_m / METRES_PER_DEGREE,
  };
}

/** Metres in a CSS pixel of the web's Mercator projection with tiles of 256 px. */
export function metresPerPixel(latitude_rad: number, zoom: number): number {
  return (METRES_PER_DEGREE * 360 * Math.cos(latitude_rad)) / (256 * 2 ** zoom);
}

export function distance_m(a: Position, b: Position): number {
  const { east_m, north_m } = toPlane(a, b);
  return Math.hypot(east_m, north_m);
}

/** A click is at a target within this distance. */
export const PICK_PX = 20;

/** The item that is nearest to a position, if one is within a distance. */
export function nearestWithin<T extends { position: Position }>(items: T[], position: Position, most_m: number): T | undefined {
  const distances = items.map((item) => distance_m(position, item.position));
  const least_m = Math.min(...distances);
  return least_m < most_m ? items[distances.indexOf(least_m)] : undefined;
}

export interface Bounds {
  west: number;
  south: number;
  east: number;
  north: number;
}

export function boundsOf(positions: Iterable<Position>): Bounds | undefined {
  let bounds: Bounds | undefined;
  for (const { longitude_deg: x, latitude_deg: y } of positions) {
    bounds ??= { west: x, east: x, south: y, north: y };
    bounds.west = Math.min(bounds.west, x);
    bounds.east = Math.max(bounds.east, x);
    bounds.south = Math.min(bounds.south, y);
    bounds.north = Math.max(bounds.north, y);
  }
  return bounds;
}

/** The longer side of a rectangle, m. */
export function sideOf({ west, south, east, north }: Bounds): number {
  const corner = toPlane({ longitude_deg: west, latitude_deg: south }, { longitude_deg: east, latitude_deg: north });
  return Math.max(corner.east_m, corner.north_m);
}

export function centroid(positions: Position[]): Position | undefined {
  if (positions.length === 0) return undefined;
  const sum = positions.reduce((a, b) => ({
    longitude_deg: a.longitude_deg + b.longitude_deg,
    latitude_deg: a.latitude_deg + b.latitude_deg,
  }));
  return {
    longitude_deg: sum.longitude_deg / positions.length,
    latitude_deg: sum.latitude_deg / positions.length,
  };
}

/** True if a position is inside a ring, by the number of sides to its east. */
export function isInside(ring: Position[], { longitude_deg: x, latitude_deg: y }: Position): boolean {
  let isInside = false;
  ring.forEach((a, at) => {
    const b = ring[(at + 1) % ring.length]!;
    if (a.latitude_deg > y === b.latitude_deg > y) return;
    if (x < a.longitude_deg + ((y - a.latitude_deg) / (b.latitude_deg - a.latitude_deg)) * (b.longitude_deg - a.longitude_deg)) isInside = !isInside;
  });
  return isInside;
}

/** Distance of a position from a line, m. */
export function distanceToLine_m(line: Position[], position: Position): number {
  let least_m = Infinity;
  for (let at = 1; at < line.length; at++) {
    const [a, b] = [toPlane(position, line[at - 1]!), toPlane(position, line[at]!)];
    const [east, north] = [b.east_m - a.east_m, b.north_m - a.north_m];
    const along = Math.min(Math.max(-(a.east_m * east + a.north_m * north) / (east * east + north * north || 1), 0), 1);
    least_m = Math.min(least_m, Math.hypot(a.east_m + along * east, a.north_m + along * north));
  }
  return least_m;
}

/** The largest of 1, 2, 5 times a power of ten that is at most `most`. */
export function roundLength(most: number): number {
  const power = 10 ** Math.floor(Math.log10(most));
  const factor = most / power;
  return (factor >= 5 ? 5 : factor >= 2 ? 2 : 1) * power;
}

/** A round length of a scale bar, from centimetres to thousands of kilometres. */
export function roundLengthText(length_m: number): string {
  if (length_m < 1) return `${Math.round(length_m * 100)} cm`;
  return length_m < 1000 ? `${Math.round(length_m)} m` : `${Math.round(length_m / 1000)} km`;
}
