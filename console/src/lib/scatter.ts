// The positions of one method in the plane, under the truth.
import { drawCircle, drawEllipse, drawLine, fade, type Context, type Palette, type Pixel } from './draw';
import type { PlaneSquare, TruthShape } from './evaluation';
import { roundLength, toPlane } from './geo';
import type { EvaluatedPosition, Position } from './types';

/** Stated 95 % radii that are drawn as circles; more would hide the positions. */
const MOST_CIRCLES = 14;

export interface Scatter {
  positions: EvaluatedPosition[];
  truth: TruthShape;
  square: PlaneSquare;
  color: keyof Palette;
}

export function drawScatter(context: Context, colors: Palette, size_px: { width: number; height: number }, { positions, truth, square, color }: Scatter): void {
  const px_per_m = Math.min(size_px.width, size_px.height) / square.side_m;
  const at = (position: Position): Pixel => {
    const { east_m, north_m } = toPlane(square.reference, position);
    return { x: size_px.width / 2 + (east_m - square.centre.east_m) * px_per_m, y: size_px.height / 2 - (north_m - square.centre.north_m) * px_per_m };
  };
  drawGrid(context, colors, size_px, px_per_m);
  const step = Math.max(1, Math.ceil(positions.length / MOST_CIRCLES));
  positions.forEach((position, index) => {
    if (index % step !== 0 || position.r95_m === undefined) return;
    drawEllipse(context, at(position), { a_m: position.r95_m, b_m: position.r95_m, angle_rad: 0 }, px_per_m, { stroke: fade(colors[color], 0.3), width: 1 });
  });
  for (const position of positions) drawCircle(context, at(position), 2, { fill: fade(colors[color], 0.65) });
  const corners = truth.points.map(at);
  if (truth.isLine) corners.slice(1).forEach((corner, index) => drawLine(context, corners[index]!, corner, { stroke: colors.text, width: 2 }));
  else for (const corner of corners) drawCircle(context, corner, corners.length === 1 ? 5 : 1, { fill: colors.text });
}

function drawGrid(context: Context, colors: Palette, { width, height }: { width: number; height: number }, px_per_m: number): void {
  const step_px = gridStep_m(px_per_m) * px_per_m;
  for (let x = width / 2 - Math.floor(width / 2 / step_px) * step_px; x < width; x += step_px) drawLine(context, { x, y: 0 }, { x, y: height }, { stroke: colors.grid, width: 1 });
  for (let y = height / 2 - Math.floor(height / 2 / step_px) * step_px; y < height; y += step_px) drawLine(context, { x: 0, y }, { x: width, y }, { stroke: colors.grid, width: 1 });
}

/** Metres between two lines of the grid. */
export function gridStep_m(px_per_m: number): number {
  return roundLength(90 / px_per_m);
}
