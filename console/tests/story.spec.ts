// What an operator does with a new camera, from the drop of a file to live targets.
import { execFileSync } from 'node:child_process';
import { existsSync, readFileSync } from 'node:fs';
import { resolve } from 'node:path';
import { distance_m, toPlane } from '../src/lib/geo';
import type { FusedFix, Position } from '../src/lib/types';
import { expect, test } from './fixtures';
import { rowsOf, simulate, walk } from './world';

const SQUARE = resolve('../../shared/data/square');

/** From a position to a walked line, m. */
function toLine(position: Position, line: [number, number][]): number {
  const corners = line.map(([longitude_deg, latitude_deg]) => toPlane(position, { longitude_deg, latitude_deg }));
  const distances = corners.slice(1).map((to, at) => {
    const from = corners[at]!;
    const [e, n] = [to.east_m - from.east_m, to.north_m - from.north_m];
    const share = Math.min(1, Math.max(0, -(from.east_m * e + from.north_m * n) / (e * e + n * n)));
    return Math.hypot(from.east_m + share * e, from.north_m + share * n);
  });
  return Math.min(...distances);
}

const mean = (values: number[]): number => values.reduce((a, b) => a + b, 0) / values.length;

test('the real square: drop, map, train, look, try, live', async ({ console: page, server }) => {
  // Training runs at the lowest priority: on a busy machine it takes as long as it takes.
  test.setTimeout(1_200_000);
  test.skip(!existsSync(SQUARE), 'the real square is not on this machine');
  const [head, ...lines] = readFileSync(`${SQUARE}/training.csv`, 'utf8').trim().split('\n');
  // The last recording is judged on; it is not among what is dropped.
  const isLast = (line: string): boolean => line >= '2020-12-15T15:00';
  const learned = lines.filter((line) => !isLast(line));
  const judged = rowsOf([head, ...lines.filter(isLast)].join('\n'));
  expect(learned.length).toBeGreaterThan(5000);

  await page.getByRole('button', { name: 'Add camera' }).first().click();
  const dialog = page.getByRole('dialog');
  await dialog.getByRole('button', { name: /^A file/ }).click();
  await dialog.getByLabel('Name').fill('City square');
  await expect(dialog.locator('input[required]')).toHaveValue('city-square');
  await page.getByRole('button', { name: 'Create camera' }).click();
  await expect(page.getByRole('heading', { name: 'City square' })).toBeVisible();

  await page.locator('input[type=file]').setInputFiles({ name: 'training.csv', mimeType: 'text/csv', buffer: Buffer.from([head, ...learned].join('\n')) });
  await expect(page.getByText('Columns of training.csv, separated by “,”')).toBeVisible();
  await page.getByRole('button', { name: 'Import', exact: true }).click();
  await expect(page.getByText(`${learned.length.toLocaleString('en-GB')} samples stored`)).toBeVisible();
  await page.getByRole('link', { name: 'Next: train the camera' }).click();

  await page.getByLabel('Recipe').selectOption('projective');
  await page.getByRole('button', { name: 'Start training' }).click();
  await expect(page.getByRole('progressbar', { name: 'Progress of the training run' })).toBeVisible();
  await expect(page.getByText('Version 1 (projective) was fitted')).toBeVisible({ timeout: 1_000_000 });

  await page.getByRole('link', { name: 'Look at the scene' }).click();
  await expect(page.getByText(/From the regressed position to the fix: mean/)).toBeVisible();
  await page.getByRole('link', { name: 'Try it' }).click();
  await expect(page.getByText('with 95 % probability')).toBeVisible();
  await expect(page.getByText('sightfix.v1.FusionService/Fuse')).toBeVisible();
  // The line for a shell gives the answer that the page shows.
  const command = (await page.locator('pre', { hasText: /^curl / }).textContent())!;
  const { items } = JSON.parse(execFileSync('sh', ['-c', command], { encoding: 'utf8' })) as { items: FusedFix[] };
  await expect(page.locator('.position')).toHaveText(`${items[0]!.fused.latitude_deg.toFixed(7)}, ${items[0]!.fused.longitude_deg.toFixed(7)}`);

  await page.getByRole('link', { name: 'Live', exact: true }).click();
  await expect(page.getByRole('status').getByText('Live')).toBeVisible();
  const line = (JSON.parse(readFileSync(`${SQUARE}/truth_line.geojson`, 'utf8')) as { features: { geometry: { coordinates: [number, number][] } }[] }).features[0]!.geometry.coordinates;
  const errors = { fix: [] as number[], regressed: [] as number[] };
  for (const row of judged.filter((_, at) => at % 4 === 0).slice(0, 400)) {
    const observation = { time: row.time, target_id: row.target_id, bounding_box: row.box, fix: row.fix };
    const answer = await server.request<{ items: { fused: FusedFix }[] }>('POST', '/v1/cameras/city-square/tracks', observation);
    errors.fix.push(toLine(row.fix!, line));
    errors.regressed.push(toLine(answer.items[0]!.fused.regressed!, line));
  }
  await expect(page.getByRole('button', { name: 'person-1' })).toBeVisible();
  await expect(page.getByText(/^[3-4]\d\d events$/)).toBeVisible();
  const [fix_m, regressed_m] = [mean(errors.fix), mean(errors.regressed)];
  console.log(`mean distance to the surveyed line: fixes ${fix_m.toFixed(2)} m, regressed ${regressed_m.toFixed(2)} m`);
  // From the box alone on a recording that the model has not seen: clearly better than the receiver.
  expect(regressed_m).toBeLessThan(0.8 * fix_m);
});

test('two files recorded apart are mapped, paired, trained and followed', async ({ console: page, server }) => {
  const world = simulate(3, [0, 0], 300);
  const rows = rowsOf(world.csv);
  // As a German spreadsheet and another detector would write them: separators, names, corners.
  const detections = ['Zeit;Track_ID;X1;Y1;X2;Y2;Extra', ...rows.map((it) => [it.time, it.target_id, it.box.left_px, it.box.top_px, it.box.left_px + it.box.width_px, it.box.top_px + it.box.height_px, 'x'].join(';'))].join('\r\n');
  const fixes = ['TIMESTAMP,LON,LAT,RECEIVER_ID', ...rows.map((it) => [it.time, it.fix!.longitude_deg, it.fix!.latitude_deg, it.target_id].join(','))].join('\n');

  await server.request('POST', '/v1/cameras', { id: 'gate', image_size: { width_px: 1280, height_px: 720 } });
  await page.goto(`${server.url}/#/cameras/gate/data`);
  await page.locator('input[type=file]').setInputFiles([
    { name: 'boxes.csv', mimeType: 'text/csv', buffer: Buffer.from(detections) },
    { name: 'fixes.csv', mimeType: 'text/csv', buffer: Buffer.from(fixes) },
  ]);
  await expect(page.getByLabel('Boxes are')).toHaveValue('corners');
  await page.getByRole('button', { name: 'Pair and import' }).click();
  await expect(page.getByText(/\d+ samples stored, 0 stored before, 0 rows rejected/)).toBeVisible();
  await expect(page.getByText(/pairs from 300 detections and 300 fixes/)).toBeVisible();
  // The server's samples have the boxes that the corners meant.
  const page_of_samples = await server.request<{ items: { time: string; target_id: string; bounding_box: { width_px: number } }[] }>('GET', '/v1/cameras/gate/samples?limit=1');
  const stored = page_of_samples.items[0]!;
  const meant = rows.find((it) => it.target_id === stored.target_id && Date.parse(it.time) === Date.parse(stored.time))!;
  expect(stored.bounding_box.width_px).toBeCloseTo(meant.box.width_px, 2);

  await server.train('gate', { recipe: 'projective', epochs: 20 });
  await page.goto(`${server.url}/#/cameras/gate/live`);
  const stop = walk(server, 'gate', world.live);
  await expect(page.getByRole('button', { name: 'person-2' })).toBeVisible();
  await expect(page.getByText('gnss_denied')).toBeVisible();
  stop();
  await page.goto(`${server.url}/#/cameras/gate/models`);
  await expect(page.getByText('active', { exact: true })).toBeVisible();
});

test('picking a sample in the image shows it on the map and in numbers', async ({ console: page, server }) => {
  const world = simulate(4);
  await server.request('POST', '/v1/cameras', { id: 'gate', image_size: { width_px: 1280, height_px: 720 } });
  await server.request('POST', '/v1/cameras/gate/samples', world.csv, 'text/csv');
  await server.train('gate', { recipe: 'projective', epochs: 20 });
  await page.goto(`${server.url}/#/cameras/gate/scene`);
  await expect(page.getByText(/400 of 400 samples/)).toBeVisible();
  const panel = page.locator('section', { has: page.getByRole('heading', { name: 'Selected sample' }) });
  const before = await panel.locator('dl').textContent();
  await page.getByRole('button', { name: 'Next sample' }).click();
  await expect(panel.locator('dl')).not.toHaveText(before!);
  const canvas = page.getByRole('img', { name: /Image plane with the foot points/ });
  const area = (await canvas.boundingBox())!;
  // The foot point of the first sample, in the picture's place on the canvas.
  const sample = rowsOf(world.csv)[0]!;
  const scale = Math.min((area.width - 20) / 1280, (area.height - 20) / 720);
  const x = (area.width - 1280 * scale) / 2 + (sample.box.left_px + sample.box.width_px / 2) * scale;
  const y = (area.height - 720 * scale) / 2 + (sample.box.top_px + sample.box.height_px) * scale;
  await canvas.click({ position: { x, y } });
  await expect(panel.getByText('Regressed to fix')).toBeVisible();
  const shown = await panel.locator('dd').nth(3).textContent();
  const [latitude_deg, longitude_deg] = shown!.split(',').map(Number) as [number, number];
  expect(distance_m({ latitude_deg, longitude_deg }, sample.fix!)).toBeLessThan(15);
});
