// What the drawing functions draw, by what they ask of a canvas.
import { expect, test } from '@playwright/test';
import { drawEllipse, drawPolygon, drawTrail, ellipseOf, r95Of, rampColor, type Palette } from '../src/lib/draw';
import { drawScatter } from '../src/lib/scatter';
import { roundLength, roundLengthText, toPlane, toPosition } from '../src/lib/geo';
import { coverageOf, emptyNinths, footOf, imageSizeOf } from '../src/lib/image';
import { drawVectorTile } from '../src/lib/vector_tile';
import { recorder } from './recorder';

test('an ellipse has the axes and the angle of its covariance', () => {
  // Standard deviations 3 m along 30 degrees from east, 1 m across.
  const [cos, sin] = [Math.cos(Math.PI / 6), Math.sin(Math.PI / 6)];
  const ellipse = ellipseOf(9 * cos ** 2 + sin ** 2, 9 * sin ** 2 + cos ** 2, (9 - 1) * cos * sin);
  expect(ellipse.a_m).toBeCloseTo(3 * 2.4477468, 6);
  expect(ellipse.b_m).toBeCloseTo(2.4477468, 6);
  expect(ellipse.angle_rad).toBeCloseTo(Math.PI / 6, 6);
  const { context, calls } = recorder();
  drawEllipse(context, { x: 5, y: 7 }, ellipse, 10, { stroke: 'red' });
  const [, x, y, a, b, angle] = calls.find(([name]) => name === 'ellipse')!;
  expect([x, y]).toEqual([5, 7]);
  expect(a).toBeCloseTo(73.432, 2);
  expect(b).toBeCloseTo(24.477, 2);
  // North is up and y points down.
  expect(angle).toBeCloseTo(-Math.PI / 6, 6);
});

test('a trail fades towards its oldest point', () => {
  const { context, calls, alphas } = recorder();
  drawTrail(context, [0, 1, 2, 3].map((x) => ({ x, y: 0 })), 'green');
  expect(calls.filter(([name]) => name === 'lineTo').map(([, x]) => x)).toEqual([1, 2, 3]);
  expect(alphas.slice(0, 3)).toEqual([...alphas.slice(0, 3)].sort((a, b) => a - b));
  expect(alphas.at(-1)).toBe(1);
});

test('a polygon is closed and filled', () => {
  const { context, calls } = recorder();
  drawPolygon(context, [{ x: 0, y: 0 }, { x: 1, y: 0 }, { x: 0, y: 1 }], { fill: 'blue' });
  expect(calls.map(([name]) => name)).toEqual(['beginPath', 'moveTo', 'lineTo', 'lineTo', 'closePath', 'fill']);
});

test('coverage counts foot points in their cells', () => {
  const size = { width_px: 400, height_px: 200 };
  const foot = footOf({ left_px: 0, top_px: 0, width_px: 100, height_px: 100 });
  expect(foot).toEqual({ x: 50, y: 100 });
  const coverage = coverageOf([{ foot }, { foot }, { foot: { x: 399, y: 200 } }, { foot: { x: 500, y: 10 } }], size, 4);
  expect([coverage.columns, coverage.rows]).toEqual([4, 2]);
  // A foot on the lower border belongs to the last row; one beyond the image to none.
  expect(coverage.counts).toEqual([0, 0, 0, 0, 2, 0, 0, 1]);
  expect(coverage.share).toBeCloseTo(2 / 8);
});

test('an unknown image size is what the boxes span', () => {
  expect(imageSizeOf(undefined, [{ left_px: 500, top_px: 300, width_px: 66, height_px: 255 }])).toEqual({ width_px: 580, height_px: 570 });
});

test('the plane and round lengths', () => {
  const here = { longitude_deg: 11, latitude_deg: 48 };
  const back = toPlane(here, toPosition(here, { east_m: 12, north_m: -7 }));
  expect(back.east_m).toBeCloseTo(12, 6);
  expect(back.north_m).toBeCloseTo(-7, 6);
  expect([0.9, 1, 3, 7, 49, 50].map(roundLength)).toEqual([0.5, 1, 2, 5, 20, 50]);
});

test('the radius of a covariance holds 95 % of its errors', () => {
  // Isotropic, on a line, and between: sqrt(-2 ln 0.05) and the normal quantile 1.96.
  expect(r95Of({ east_m2: 4, north_m2: 4, east_north_m2: 0 })).toBeCloseTo(2 * 2.4477, 3);
  expect(r95Of({ east_m2: 9, north_m2: 0, east_north_m2: 0 })).toBeCloseTo(3 * 1.96, 2);
  const [along, across] = [r95Of({ east_m2: 1, north_m2: 0.25, east_north_m2: 0 }), r95Of({ east_m2: 0.625, north_m2: 0.625, east_north_m2: 0.375 })];
  expect(along).toBeCloseTo(across, 6);
  // As the server has it.
  expect(along).toBeCloseTo(2.0359, 3);
});

test('lengths of the scale bar have the unit that fits', () => {
  expect([0.2, 5, 500, 5000, 2_000_000].map(roundLengthText)).toEqual(['20 cm', '5 m', '500 m', '5 km', '2000 km']);
});

test('the ramp goes from cold to hot and stays inside', () => {
  expect(rampColor(-1)).toBe(rampColor(0));
  expect(rampColor(2)).toBe(rampColor(1));
  expect(rampColor(0)).not.toBe(rampColor(1));
});

test('the ninths without foot points are named', () => {
  const size = { width_px: 300, height_px: 300 };
  const points = [0, 1, 2].flatMap((column) => [0, 1].flatMap((row) => Array.from({ length: 6 }, () => ({ foot: { x: column * 100 + 50, y: row * 100 + 50 } }))));
  // One foot point alone does not cover a ninth; one beyond the border belongs to the nearest.
  expect(emptyNinths([...points, { foot: { x: 150, y: 310 } }], size)).toEqual(['lowerLeft', 'lower', 'lowerRight']);
  expect(emptyNinths([], size)).toHaveLength(9);
});

test('a scatter plot shows every position at its place, the truth, and some radii', () => {
  const { context, calls } = recorder();
  const at = (north_m: number): { longitude_deg: number; latitude_deg: number } => ({ longitude_deg: 11, latitude_deg: 48 + north_m / 111_319.490793 });
  const positions = Array.from({ length: 100 }, (_, index) => ({ ...at(10), error_m: 10, ...(index < 50 ? { r95_m: 5 } : {}) }));
  const colors = new Proxy({}, { get: (_, name: string) => name }) as Palette;
  const square = { reference: at(0), centre: { east_m: 0, north_m: 0 }, side_m: 40 };
  drawScatter(context, colors, { width: 200, height: 200 }, { positions, truth: { points: [at(0)], isLine: false }, square, color: 'fused' });
  const circles = calls.filter(([name]) => name === 'arc');
  expect(circles).toHaveLength(101);
  // 10 m north at 5 px/m: 50 px above the middle.
  expect(circles[0]!.slice(1, 3).map((value) => Math.round((value as number) * 1000) / 1000)).toEqual([100, 50]);
  expect(circles.at(-1)!.slice(1, 3)).toEqual([100, 100]);
  const radii = calls.filter(([name]) => name === 'ellipse').map(([, , , a]) => Math.round(a as number));
  expect(radii).toEqual(new Array(7).fill(25));
});

test('a vector tile is drawn from the ground up, ways as wide as they are', () => {
  const { context, calls } = recorder();
  const layer = (type: number, properties: Record<string, unknown>): { length: number; extent: number; feature: () => { type: number; properties: Record<string, unknown>; loadGeometry: () => { x: number; y: number }[][] } } => ({
    length: 1,
    extent: 4096,
    feature: () => ({ type, properties, loadGeometry: () => [[{ x: 0, y: 0 }, { x: 4096, y: 0 }, { x: 4096, y: 4096 }]] }),
  });
  const layers = { buildings: layer(3, {}), roads: layer(2, { kind: 'major_road' }), pois: layer(1, {}), water: layer(3, {}), landuse: layer(3, { kind: 'park' }) };
  const widths: number[] = [];
  const fills: string[] = [];
  const watched = new Proxy(context, {
    set: (target, name, value) => {
      if (name === 'lineWidth') widths.push(value as number);
      if (name === 'fillStyle') fills.push(value as string);
      return Reflect.set(target, name, value);
    },
  });
  drawVectorTile(watched, { layers }, { water: 'water', green: 'green', building: 'building', road: 'road' }, { x: -256, y: 0, size_px: 512, px_per_m: 2 });
  expect(fills).toEqual(['green', 'water', 'building']);
  expect(widths).toEqual([20]);
  expect(calls.filter(([name]) => name === 'moveTo')).toEqual(new Array(4).fill(['moveTo', -256, 0]));
  expect(calls.filter(([name]) => name === 'lineTo').slice(0, 2)).toEqual([['lineTo', 256, 0], ['lineTo', 256, 512]]);
  // Polygons are closed, ways are not.
  expect(calls.filter(([name]) => name === 'closePath')).toHaveLength(3);
});
