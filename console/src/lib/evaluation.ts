// Curves and extents of an evaluation's positions.
import type { Palette } from './draw';
import { toPlane, type EastNorth } from './geo';
import type { Recipe } from './recipes';
import type { EvaluatedPosition, Evaluation, Position } from './types';

/** The methods that a recipe is compared with: the receiver, a filter, and a plain homography. */
export function comparedMethods(recipe: Recipe): string[] {
  return ['gnss', 'imm_ukf', 'homography.denied', `${recipe}.two_step`];
}

/** A method keeps its colour from report to report; those of one source share its colour and differ by dashes. */
export function lineOf(method: string): { color: keyof Palette; dash?: number[] } {
  if (method === 'gnss') return { color: 'gnss' };
  if (method === 'imm_ukf') return { color: 'gnss', dash: [6, 4] };
  if (method.startsWith('homography')) return { color: 'muted' };
  if (method.startsWith('dnn')) return { color: 'danger' };
  if (method.startsWith('track')) return { color: 'text', ...(method === 'track' ? {} : { dash: [6, 4] }) };
  return method.endsWith('two_step') ? { color: 'fused' } : { color: 'camera' };
}

/** Error bounds between the smallest and the largest error, evenly spaced by their logarithm. */
export function errorBounds(errors_m: number[], count = 80): number[] {
  const positive = errors_m.filter((error) => error > 0);
  if (positive.length === 0) return [];
  // A few tiny errors would take half of the axis.
  const low = Math.log(Math.max(0.01, positive.reduce((a, b) => Math.min(a, b))));
  const high = Math.max(low + 1e-6, Math.log(positive.reduce((a, b) => Math.max(a, b))));
  // The last bound holds the largest error in spite of rounding.
  return Array.from({ length: count }, (_, at) => Math.exp(low + ((high - low) * at) / (count - 1)) * (1 + 1e-9));
}

/** Share of the errors within each of ascending bounds. */
export function cumulativeShare(errors_m: number[], bounds_m: number[]): number[] {
  const sorted = [...errors_m].sort((a, b) => a - b);
  let at = 0;
  return bounds_m.map((bound) => {
    while (at < sorted.length && sorted[at]! <= bound) at += 1;
    return at / Math.max(sorted.length, 1);
  });
}

/**
 * Share of true positions found within the radius of each stated share, `null` without a stated radius. The radius of a
 * share p of an isotropic normal distribution is `r95 sqrt(ln(1 - p) / ln 0.05)`.
 */
export function calibrationCurve(positions: EvaluatedPosition[], stated: number[]): number[] | null {
  const levels = positions.flatMap(({ error_m, r95_m }) => (error_m === undefined || r95_m === undefined ? [] : [1 - Math.exp(Math.log(0.05) * (error_m / r95_m) ** 2)]));
  return levels.length > 0 ? cumulativeShare(levels, stated) : null;
}

/** The form of the true positions: points, or the corners of a line. */
export interface TruthShape {
  points: Position[];
  isLine: boolean;
}

export function truthOf(evaluation: Evaluation): TruthShape {
  if (evaluation.truth_line) return { points: evaluation.truth_line.map(([longitude_deg, latitude_deg]) => ({ longitude_deg, latitude_deg })), isLine: true };
  if (evaluation.truth_point) return { points: [evaluation.truth_point], isLine: false };
  const [positions = []] = Object.values(evaluation.report?.positions ?? {});
  const points = positions.flatMap(({ truth_longitude_deg: longitude_deg, truth_latitude_deg: latitude_deg }) => (longitude_deg === undefined || latitude_deg === undefined ? [] : [{ longitude_deg, latitude_deg }]));
  return { points, isLine: false };
}

/** A square of the plane about a reference position. */
export interface PlaneSquare {
  reference: Position;
  centre: EastNorth;
  side_m: number;
}

/** The square that holds the truth and the central 90 % of all positions along each axis, with a margin. */
export function commonSquare(truth: Position[], positions: Position[]): PlaneSquare | undefined {
  const reference = truth[0] ?? positions[0];
  if (!reference) return undefined;
  const range = (axis: keyof EastNorth): [number, number] => {
    const values = positions.map((position) => toPlane(reference, position)[axis]).sort((a, b) => a - b);
    const tail = Math.floor(values.length / 20);
    const central = values.slice(tail, values.length - tail);
    const all = [...truth.map((position) => toPlane(reference, position)[axis]), ...central.slice(0, 1), ...central.slice(-1)];
    return [Math.min(...all), Math.max(...all)];
  };
  const [[west, east], [south, north]] = [range('east_m'), range('north_m')];
  return {
    reference,
    centre: { east_m: (west + east) / 2, north_m: (south + north) / 2 },
    side_m: 1.16 * Math.max(east - west, north - south, 1),
  };
}
