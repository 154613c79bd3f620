// The filter of a source: which boxes it takes. The server applies it; here the effect of a change is shown before it is saved.
import { footOf } from './image';
import type { ConnectionSettings, ImagePoint } from './types';
import type { ShownBox } from './seen_boxes.svelte';

export interface BoxFilter {
  /** All where it is empty. */
  classes: string[];
  leastScore: number;
  /** Corners of the area in which the foot of a box must be; the whole image with fewer than three. */
  area: ImagePoint[];
}

/** Fewer corners surround nothing. */
const FEWEST_CORNERS = 3;
export const MOST_CORNERS = 64;

/** The filter of a stored source, for a camera. */
export function filterOf(source: ConnectionSettings | undefined, camera: string): BoxFilter {
  const mapping = Object.values(source?.cameras ?? {}).find(({ camera_id }) => camera_id === camera);
  return { classes: source?.classes ?? [], leastScore: source?.least_score ?? 0, area: mapping?.area ?? [] };
}

/** The change of a source that sets a filter (a merge patch). */
export function patchOf(filter: BoxFilter, source: ConnectionSettings, camera: string): object {
  const area = filter.area.length >= FEWEST_CORNERS ? filter.area : null;
  const names = Object.entries(source.cameras ?? {}).flatMap(([name, { camera_id }]) => (camera_id === camera ? [name] : []));
  return {
    source: {
      classes: filter.classes,
      least_score: filter.leastScore > 0 ? filter.leastScore : null,
      cameras: Object.fromEntries(names.map((name) => [name, { area }])),
    },
  };
}

function contains(area: ImagePoint[], { x, y }: { x: number; y: number }): boolean {
  let isInside = false;
  area.forEach((from, at) => {
    const to = area[(at + 1) % area.length]!;
    if (from.y_px > y !== to.y_px > y && x < from.x_px + ((y - from.y_px) / (to.y_px - from.y_px)) * (to.x_px - from.x_px)) isInside = !isInside;
  });
  return isInside;
}

/** True if a box passes; a class or a score that is not known does. */
export function isTaken(filter: BoxFilter, { box, class: own, score }: ShownBox): boolean {
  if (own && filter.classes.length > 0 && !filter.classes.some((it) => it.toLowerCase() === own.toLowerCase())) return false;
  if (score !== undefined && score < filter.leastScore) return false;
  return filter.area.length < FEWEST_CORNERS || contains(filter.area, footOf(box));
}

/** The corners as a text, one per line, and back. */
export const areaText = (area: ImagePoint[]): string => area.map(({ x_px, y_px }) => `${Math.round(x_px)} ${Math.round(y_px)}`).join('\n');
export function areaOf(text: string): ImagePoint[] {
  const corners = text.split('\n').map((line) => line.trim().split(/[\s,;]+/).map(Number));
  return corners.filter((it) => it.length === 2 && it.every(Number.isFinite)).slice(0, MOST_CORNERS).map(([x_px, y_px]) => ({ x_px: x_px!, y_px: y_px! }));
}
