// Methods side by side: the curves, and an evaluation that the page starts.
import { calibrationCurve, commonSquare, cumulativeShare, errorBounds, truthOf } from '../src/lib/evaluation';
import { distance_m } from '../src/lib/geo';
import type { Evaluation } from '../src/lib/types';
import { accessibilityFindings, expect, test } from './fixtures';
import { simulate } from './world';

test('bounds span the errors, and the shares within them rise to all', () => {
  const errors = [0, 0.5, 4, 1, 2];
  const bounds = errorBounds(errors, 20);
  expect(bounds).toHaveLength(20);
  expect(bounds[0]).toBeCloseTo(0.5);
  expect(bounds.at(-1)).toBeCloseTo(4);
  const shares = cumulativeShare(errors, bounds);
  expect([shares[0], shares.at(-1)]).toEqual([0.4, 1]);
  expect(shares).toEqual([...shares].sort((a, b) => a - b));
  expect(errorBounds([])).toEqual([]);
});

test('the calibration of a radius that is right lies on the diagonal', () => {
  // Quantiles of a Rayleigh distribution, whose 95 % radius is known.
  const positions = Array.from({ length: 1000 }, (_, at) => ({ longitude_deg: 0, latitude_deg: 0, error_m: Math.sqrt(-2 * Math.log(1 - (at + 0.5) / 1000)), r95_m: 2.4477468 }));
  const stated = [0.1, 0.5, 0.95];
  calibrationCurve(positions, stated)!.forEach((found, at) => expect(found).toBeCloseTo(stated[at]!, 2));
  // A radius that is half as long as it should be contains too few.
  const short = positions.map((it) => ({ ...it, r95_m: it.r95_m / 2 }));
  expect(calibrationCurve(short, [0.95])![0]).toBeCloseTo(1 - 0.05 ** 0.25, 2);
  expect(calibrationCurve(positions.map(({ r95_m: _, ...it }) => it), stated)).toBeNull();
});

test('all plots share a square that holds the truth but not every outlier', () => {
  const truth = [{ longitude_deg: 11, latitude_deg: 48 }];
  const near = Array.from({ length: 99 }, (_, at) => ({ longitude_deg: 11 + at * 1e-6, latitude_deg: 48 }));
  const square = commonSquare(truth, [...near, { longitude_deg: 12, latitude_deg: 48 }])!;
  expect(square.side_m).toBeLessThan(15);
  expect(commonSquare([], [])).toBeUndefined();
  const evaluation = { truth_line: [[11, 48], [11, 49]] } as unknown as Evaluation;
  expect(truthOf(evaluation)).toEqual({ points: [{ longitude_deg: 11, latitude_deg: 48 }, { longitude_deg: 11, latitude_deg: 49 }], isLine: true });
  expect(distance_m(truth[0]!, truthOf(evaluation).points[0]!)).toBe(0);
});

test('an evaluation that the page starts is stored, and shown again after a reload', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate', display_name: 'Gate', recipe: 'projective', image_size: { width_px: 1280, height_px: 720 } });
  await server.request('POST', '/v1/cameras/gate/samples', simulate(5, [0, 0], 300).csv, 'text/csv');
  await page.goto(`${server.url}/#/cameras/gate/evaluation`);
  await expect(page.getByText('No evaluation yet.')).toBeVisible();
  for (const method of ['gnss', 'imm_ukf', 'homography.denied', 'projective.two_step']) await expect(page.getByLabel(method, { exact: true })).toBeChecked();
  await page.getByRole('button', { name: 'Start evaluation' }).click();
  const report = page.locator('section', { has: page.getByRole('heading', { name: 'Report' }) });
  await expect(report.getByRole('row')).toHaveCount(5, { timeout: 300_000 });

  // Nothing is left in memory after this.
  await page.reload();
  await expect(report.getByRole('row')).toHaveCount(5);
  for (const method of ['gnss', 'imm_ukf', 'homography.denied', 'projective.two_step']) {
    // A fifth of the samples, and those of the same time.
    const plot = report.getByRole('img', { name: new RegExp(`^6\\d positions of ${method.replace('.', '\\.')} around the truth$`) });
    await expect(plot).toBeVisible();
    // The positions are drawn in the method's colour.
    const drawn = await plot.evaluate((element) => {
      const canvas = element as HTMLCanvasElement;
      const { data } = canvas.getContext('2d')!.getImageData(0, 0, canvas.width, canvas.height);
      let opaque = 0;
      for (let at = 3; at < data.length; at += 4) if (data[at]! > 120) opaque += 1;
      return opaque;
    });
    expect(drawn, method).toBeGreaterThan(100);
  }
  await expect(report.getByRole('img', { name: 'Cumulative share of errors by method' })).toBeVisible();
  await expect(report.getByRole('img', { name: /^Calibration/ })).toBeVisible();
  expect(await accessibilityFindings(page)).toEqual([]);
});
