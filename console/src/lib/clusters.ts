// Cameras that lie on each other at the map's scale, drawn as one mark with their number.
import type { Pixel } from './draw';

const CELL_PX = 44;

export interface Cluster<T> {
  at: Pixel;
  members: T[];
}

/** Groups what falls into the same cell of a grid that moves with the map, so that panning regroups nothing. */
export function clustersOf<T>(items: Iterable<T>, pixelOf: (item: T) => Pixel, origin: Pixel): Cluster<T>[] {
  const cells = new Map<string, Cluster<T>>();
  for (const item of items) {
    const { x, y } = pixelOf(item);
    const key = `${Math.floor((x - origin.x) / CELL_PX)}:${Math.floor((y - origin.y) / CELL_PX)}`;
    const cell = cells.get(key) ?? { at: { x: 0, y: 0 }, members: [] };
    cells.set(key, cell);
    cell.members.push(item);
    // The running mean of the members' places.
    cell.at = { x: cell.at.x + (x - cell.at.x) / cell.members.length, y: cell.at.y + (y - cell.at.y) / cell.members.length };
  }
  return [...cells.values()];
}
