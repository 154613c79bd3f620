// The history of a camera: kept once it is switched on, played back, and exported.
import { readFileSync } from 'node:fs';
import { paintedPixels } from './canvas';
import { accessibilityFindings, expect, test } from './fixtures';
import { addCamera, simulate, walk } from './world';

interface HistoryPage {
  items: { time: string; track_id: string }[];
}

test('finished tracks are kept, played back, and exported', async ({ console: page, server }) => {
  const world = simulate(13, [0, 0], 300);
  await addCamera(server, 'gate', 'Gate', world);
  await page.goto(`${server.url}/#/cameras/gate/history`);
  await expect(page.getByText('Finished tracks are not kept.')).toBeVisible();
  await page.getByRole('link', { name: 'Keep them from now on' }).click();
  await page.getByLabel('Keep the positions of finished tracks').check();
  await page.getByLabel('For days').fill('7');
  await page.getByRole('button', { name: 'Save', exact: true }).click();
  await expect(page.getByText('revision 2')).toBeVisible();
  expect((await server.request<{ history: object }>('GET', '/v1/cameras/gate')).history).toEqual({ keep_days: 7, max_bytes: 2 ** 30, coarsen_m: 0 });

  const stop = walk(server, 'gate', world.live);
  await page.waitForTimeout(12_000);
  stop();
  // A track has finished once its target was not seen for long.
  const kept = async (): Promise<HistoryPage['items']> => (await server.request<HistoryPage>('GET', '/v1/history?camera=gate&limit=1000')).items;
  await expect.poll(async () => new Set((await kept()).map(({ track_id }) => track_id)).size, { timeout: 240_000, intervals: [2000] }).toBeGreaterThanOrEqual(2);
  const stored = await kept();

  await page.goto('about:blank');
  await page.goto(`${server.url}/#/cameras/gate/history`);
  await page.getByRole('button', { name: /^Last 1 h/ }).click();
  await expect(page.getByText(`${stored.length} positions`)).toBeVisible();
  expect(await accessibilityFindings(page)).toEqual([]);

  const shown = page.locator('[data-time]');
  const time = async (): Promise<number> => Number(await shown.getAttribute('data-time'));
  const start_ms = Date.parse(stored[0]!.time);
  expect(Math.abs((await time()) - start_ms)).toBeLessThan(2);
  // Scrubbing by the keyboard, and by a jump to the middle.
  const line = page.getByRole('slider', { name: 'Time that is shown' });
  await line.focus();
  await page.keyboard.press('PageUp');
  expect(await time()).toBeGreaterThan(start_ms);
  const { width, height } = (await line.boundingBox())!;
  await line.click({ position: { x: width / 2, y: height / 2 } });
  await expect(page.getByText(/^[12] targets$/)).toBeVisible();
  const middle_ms = await time();
  await page.getByRole('button', { name: 'Play' }).click();
  await expect.poll(time).toBeGreaterThan(middle_ms + 1000);
  await expect(page.getByRole('button', { name: 'Play' })).toBeVisible({ timeout: 60_000 });
  expect(Math.abs((await time()) - Date.parse(stored.at(-1)!.time))).toBeLessThan(2);

  // Cells of the heat map are drawn under the tracks.
  const filled = (): Promise<number> => paintedPixels(page.locator('.plane-canvas'));
  const without = await filled();
  await page.getByLabel(/^Heat map/).check();
  await expect.poll(filled).toBeGreaterThan(without);

  for (const [name, ending] of [['CSV', 'csv'], ['GeoJSON', 'geojson'], ['GeoParquet', 'parquet']] as const) {
    const download = page.waitForEvent('download');
    await page.getByRole('link', { name, exact: true }).click();
    const file = await download;
    expect(file.suggestedFilename()).toMatch(new RegExp(`\\.${ending}$`));
    const content = readFileSync(await file.path());
    if (ending === 'csv') expect(content.toString().trim().split(/\r?\n/)).toHaveLength(stored.length + 1);
    if (ending === 'geojson') expect((JSON.parse(content.toString()) as { features: object[] }).features).toHaveLength(stored.length);
    if (ending === 'parquet') expect(content.subarray(0, 4).toString()).toBe('PAR1');
  }
});

test('the history of a site is switched on in its profile', async ({ console: page, server }) => {
  await server.request('POST', '/v1/sites', { id: 'plaza', display_name: 'Plaza' });
  await page.goto(`${server.url}/#/sites/plaza/profile`);
  await page.getByLabel('Name').fill('The plaza');
  await page.getByLabel('Keep the positions of finished tracks').check();
  await page.getByLabel('Move positions to a grid of').fill('5');
  await page.getByRole('button', { name: 'Save', exact: true }).click();
  await expect(page.getByText('revision 2')).toBeVisible();
  expect(await server.request('GET', '/v1/sites/plaza')).toMatchObject({ display_name: 'The plaza', history: { keep_days: 30, coarsen_m: 5 } });
  await page.getByLabel('Keep the positions of finished tracks').uncheck();
  await page.getByRole('button', { name: 'Save', exact: true }).click();
  await expect(page.getByText('revision 3')).toBeVisible();
  expect(await server.request('GET', '/v1/sites/plaza')).not.toHaveProperty('history');
});
