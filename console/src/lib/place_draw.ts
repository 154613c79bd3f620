// Places on a map, the direction of lines, and events where they happened.
import { drawCircle, drawLabel, drawLine, drawPath, fade, type Context, type Pixel } from './draw';
import { centroid } from './geo';
import { cornersOf } from './place_draft';
import type { PlaneView } from './plane_layer';
import type { PlaceEvent, PlaceGeometry } from './types';

/** How long an event is marked on the map. */
export const FLASH_MS = 4000;

export interface Flash {
  event: PlaceEvent;
  heardAt_ms: number;
}

const ARROW_PX = 9;
/** How far the arrow across a line reaches to either side. */
const ACROSS_PX = 15;

export interface DrawnPlace {
  geometry: PlaceGeometry;
  radius_m?: number | null;
  name: string;
}

export function drawPlace({ context, colors, px_per_m, at }: PlaneView, { geometry, radius_m, name }: DrawnPlace, isChosen: boolean): void {
  const color = isChosen ? colors.accent : colors.text;
  const style = { stroke: fade(color, isChosen ? 1 : 0.7), width: isChosen ? 2.5 : 1.5 };
  const corners = cornersOf(geometry).map(at);
  if (geometry.type === 'LineString') {
    drawPath(context, [corners], false, style);
    drawDirection(context, corners, color);
  } else if (geometry.type === 'Polygon') {
    const rings = geometry.coordinates.map((ring) => ring.map(([longitude_deg, latitude_deg]) => at({ longitude_deg, latitude_deg })));
    drawPath(context, rings, true, { ...style, fill: fade(color, 0.1) });
  } else if (corners[0]) {
    drawCircle(context, corners[0], (radius_m ?? 0) * px_per_m, { ...style, fill: fade(color, 0.1) });
  }
  const middle = geometry.type === 'LineString' ? cornersOf(geometry)[0] : centroid(cornersOf(geometry));
  if (middle && name) drawLabel(context, name, shifted(at(middle), geometry.type === 'LineString' ? 18 : 0), colors, 'center');
}

const shifted = ({ x, y }: Pixel, down_px: number): Pixel => ({ x, y: y + down_px });

/** Arrows: at the line's end along it, and across its middle from its left to its right, which is the allowed direction. */
export function drawDirection(context: Context, points: Pixel[], color: string): void {
  const [from, to] = [points.at(-2), points.at(-1)];
  if (!from || !to) return;
  drawArrowHead(context, from, to, color);
  const [before, after] = middleSegment(points);
  const length = Math.hypot(after.x - before.x, after.y - before.y);
  if (length === 0) return;
  const middle = { x: (before.x + after.x) / 2, y: (before.y + after.y) / 2 };
  // The right-hand side of a direction, where y points down.
  const right = { x: -((after.y - before.y) / length) * ACROSS_PX, y: ((after.x - before.x) / length) * ACROSS_PX };
  const start = { x: middle.x - right.x, y: middle.y - right.y };
  const end = { x: middle.x + right.x, y: middle.y + right.y };
  drawLine(context, start, end, { stroke: color, width: 2 });
  drawArrowHead(context, start, end, color);
}

function middleSegment(points: Pixel[]): [Pixel, Pixel] {
  const at = Math.floor((points.length - 1) / 2);
  return points.length % 2 === 0 ? [points[at]!, points[at + 1]!] : [points[at - 1]!, points[at]!];
}

function drawArrowHead(context: Context, from: Pixel, to: Pixel, color: string): void {
  const angle = Math.atan2(to.y - from.y, to.x - from.x);
  const wing = (turn: number): Pixel => ({ x: to.x - ARROW_PX * Math.cos(angle + turn), y: to.y - ARROW_PX * Math.sin(angle + turn) });
  drawPath(context, [[wing(0.45), to, wing(-0.45)]], true, { fill: color });
}

/** A ring about each event, which widens and fades. */
export function drawFlashes({ context, colors, at }: PlaneView, flashes: Flash[], nameOf: (flash: Flash) => string, now_ms: number): void {
  for (const flash of flashes) {
    const age = Math.min(Math.max((now_ms - flash.heardAt_ms) / FLASH_MS, 0), 1);
    const here = at(flash.event);
    drawCircle(context, here, 8 + 22 * age, { stroke: fade(colors.danger, 1 - age), fill: fade(colors.danger, 0.25 * (1 - age)), width: 3 });
    drawLabel(context, nameOf(flash), { x: here.x, y: here.y - 14 - 22 * age }, colors, 'center');
  }
}
