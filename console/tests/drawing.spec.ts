// What the drawing functions draw, by what they ask of a canvas.
import { expect, test } from '@playwright/test';
import { drawEllipse, drawPolygon, drawTrail, ellipseOf, rampColor, type Context } from '../src/lib/draw';
import { roundLength, toPlane, toPosition } from '../src/lib/geo';
import { coverageOf, footOf, imageSizeOf } from '../src/lib/image';

type Call = [name: string, ...values: unknown[]];

/** A canvas that writes down what it is asked for. */
function recorder(): { context: Context; calls: Call[]; alphas: number[] } {
  const calls: Call[] = [];
  const alphas: number[] = [];
  const target: Record<string, unknown> = {};
  const context = new Proxy(target, {
    get: (_, name: string) => (name in target ? target[name] : (...values: unknown[]) => calls.push([name, ...values])),
    set: (_, name: string, value) => {
      if (name === 'globalAlpha') alphas.push(value as number);
      target[name] = value;
      return true;
    },
  });
  return { context: context as unknown as Context, calls, alphas };
}

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

test('the ramp goes from cold to hot and stays inside', () => {
  expect(rampColor(-1)).toBe(rampColor(0));
  expect(rampColor(2)).toBe(rampColor(1));
  expect(rampColor(0)).not.toBe(rampColor(1));
});
