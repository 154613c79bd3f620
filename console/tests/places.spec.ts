// Places of a camera: drawn with a mouse and by the keyboard, crossed by targets, counted; events before and after a restart.
import { readFileSync } from 'node:fs';
import type { Locator, Page } from '@playwright/test';
import { paintedPixels } from './canvas';
import { accessibilityFindings, expect, test } from './fixtures';
import type { Server } from './server';
import { addCamera, simulate, walk } from './world';

interface EventPage {
  items: { id: string; kind: string; place_id: string }[];
}

const eventsOf = async (server: Server, query: string): Promise<EventPage['items']> => (await server.request<EventPage>('GET', `/v1/place-events?limit=1000&${query}`)).items;

async function openPlaces(page: Page, server: Server, camera: string): Promise<Locator> {
  await page.goto(`${server.url}/#/cameras/${camera}/places`);
  const map = page.getByRole('application');
  await expect(map.locator('canvas').first()).toBeVisible();
  await expect(page.getByRole('status').getByText('Live')).toBeVisible();
  return map;
}

/** Clicks points of the map, by their shares of its width and height. */
async function clickAt(map: Locator, shares: [number, number][]): Promise<void> {
  const { width, height } = (await map.boundingBox())!;
  for (const [x, y] of shares) await map.click({ position: { x: x * width, y: y * height } });
}

test('an area and a line are drawn with a mouse, and targets that walk through them are reported and counted', async ({ console: page, server }) => {
  const world = simulate(13, [0, 0], 300);
  await addCamera(server, 'gate', 'Gate', world);
  const map = await openPlaces(page, server, 'gate');
  await expect(page.getByText('No place yet.')).toBeVisible();

  await page.getByRole('button', { name: 'New area' }).click();
  await clickAt(map, [[0.1, 0.1], [0.5, 0.1], [0.5, 0.9], [0.2, 0.9]]);
  // The last corner is dragged to the left.
  const corner = page.getByRole('button', { name: 'Corner 4', exact: true });
  const before = await page.getByLabel('Longitude of corner 4').inputValue();
  const { x, y } = (await corner.boundingBox())!;
  await page.mouse.move(x + 12, y + 12);
  await page.mouse.down();
  await page.mouse.move(x - 50, y + 12, { steps: 5 });
  await page.mouse.up();
  expect(Number(await page.getByLabel('Longitude of corner 4').inputValue())).toBeLessThan(Number(before));
  await expect(page.getByLabel(/^Longitude of corner/)).toHaveCount(4);
  await page.getByLabel('Name', { exact: true }).fill('West half');
  expect(await accessibilityFindings(page)).toEqual([]);
  await page.getByRole('button', { name: 'Save' }).click();
  await expect(page.getByRole('button', { name: 'West half', exact: true })).toBeVisible();

  await page.getByRole('button', { name: 'New line' }).click();
  await clickAt(map, [[0.5, 0.95], [0.5, 0.05]]);
  await page.getByLabel('Name', { exact: true }).fill('Middle');
  await page.getByRole('button', { name: 'Save' }).click();
  await expect(page.getByRole('button', { name: 'Middle', exact: true })).toBeVisible();
  const { items } = await server.request<{ items: { id: string; camera_id: string; geometry: { type: string } }[] }>('GET', '/v1/places?camera=gate');
  expect(items.map(({ id, camera_id, geometry }) => [id, camera_id, geometry.type])).toEqual([['middle', 'gate', 'LineString'], ['west-half', 'gate', 'Polygon']]);

  await page.getByRole('combobox', { name: 'Place', exact: true }).selectOption({ label: 'All' });
  const marked = page.locator('.mark-canvas');
  expect(await paintedPixels(marked)).toBe(0);
  const stop = walk(server, 'gate', world.live);
  await expect.poll(() => paintedPixels(marked), { timeout: 90_000, intervals: [200] }).toBeGreaterThan(50);
  const rows = page.locator('section', { has: page.getByRole('heading', { name: 'Events' }) }).locator('tbody tr');
  await expect(rows.filter({ hasText: 'Entered' }).first()).toBeVisible({ timeout: 90_000 });
  await expect(rows.filter({ hasText: 'Crossed' }).first()).toBeVisible({ timeout: 90_000 });
  await expect(rows.filter({ hasText: 'Crossed' }).first()).toHaveText(/±.*(left to right|right to left).*Middle.*\d %/);
  await page.getByRole('combobox', { name: 'Event', exact: true }).selectOption('cross');
  await expect(rows.filter({ hasText: 'Entered' })).toHaveCount(0);
  await expect(rows.filter({ hasText: 'Crossed' }).first()).toBeVisible();

  await expect(page.getByRole('heading', { name: 'Counts of Middle' })).toBeVisible();
  stop();
  const crossed = (await eventsOf(server, 'place=middle&kind=cross')).length;
  const counted = async (): Promise<number> => {
    const figures = await page.locator('section', { has: page.getByRole('heading', { name: 'Counts of Middle' }) }).locator('dd').allTextContents();
    return figures.slice(0, 2).reduce((sum, text) => sum + parseInt(text, 10), 0);
  };
  await expect.poll(counted, { timeout: 30_000 }).toBe(crossed);
  expect(await accessibilityFindings(page)).toEqual([]);
  const download = page.waitForEvent('download');
  await page.getByRole('button', { name: 'CSV' }).click();
  const [head, ...lines] = readFileSync(await (await download).path(), 'utf8').trim().split('\r\n').map((line) => line.split(','));
  expect(lines).toHaveLength(60);
  const sum = (name: string): number => lines.reduce((total, cells) => total + Number(cells[head!.indexOf(`"${name}"`)]), 0);
  expect(sum('left_to_right_count') + sum('right_to_left_count')).toBe(crossed);
});

test.describe('a form that is refused', () => {
  test.use({ allowed: /status of 4/ });

  test('a place is made, changed and refused by the keyboard alone, exported and imported', async ({ console: page, server }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate', display_name: 'Gate', location: { longitude_deg: 11, latitude_deg: 48 } });
    await openPlaces(page, server, 'gate');
    const press = async (name: string): Promise<void> => {
      await page.getByRole('button', { name, exact: true }).focus();
      await page.keyboard.press('Enter');
    };
    const type = async (label: string, text: string): Promise<void> => {
      await page.getByLabel(label, { exact: true }).focus();
      await page.keyboard.press('Control+A');
      await page.keyboard.type(text);
      await page.keyboard.press('Tab');
    };
    await press('New area');
    await type('Name', 'Yard');
    for (const [at, [longitude, latitude]] of [[11, 48], [11.001, 48.001], [11.001, 48], [11, 48.001]].entries()) {
      await press('Add corner');
      await type(`Longitude of corner ${at + 1}, degrees`, String(longitude));
      await type(`Latitude of corner ${at + 1}, degrees`, String(latitude));
    }
    await press('Save');
    // The border crosses itself: the refusal is at the corners.
    const corners = page.getByRole('group', { name: 'Corners' });
    await expect(corners.getByRole('alert')).toBeVisible();
    await type('Latitude of corner 2, degrees', '48');
    await type('Latitude of corner 3, degrees', '48.001');
    await page.getByRole('button', { name: 'Corner 3', exact: true }).focus();
    const before = Number(await page.getByLabel('Latitude of corner 3').inputValue());
    await page.keyboard.press('Shift+ArrowUp');
    expect(Number(await page.getByLabel('Latitude of corner 3').inputValue())).toBeGreaterThan(before);
    await press('Add rule');
    await page.getByRole('combobox', { name: 'Event', exact: true }).nth(2).selectOption('speed_above');
    await press('Save');
    const speed = page.getByLabel('Speed, m/s');
    await expect(speed).toHaveAttribute('aria-invalid', 'true');
    await expect(speed).toHaveAccessibleDescription(/is needed/);
    await speed.fill('3');
    await press('Save');
    await expect(page.getByRole('button', { name: 'Yard', exact: true })).toBeVisible();
    type Stored = { id: string; geometry: { coordinates: number[][][] }; rules: { kind: string; speed_mps?: number }[] };
    const stored = await server.request<Stored>('GET', '/v1/places/yard');
    expect(stored.rules.map(({ kind, speed_mps }) => [kind, speed_mps])).toEqual([['enter', undefined], ['leave', undefined], ['speed_above', 3]]);
    expect(stored.geometry.coordinates[0]!.slice(0, 2)).toEqual([[11, 48], [11.001, 48]]);

    const download = page.waitForEvent('download');
    await press('Export GeoJSON');
    const file = await (await download).path();
    page.on('dialog', (dialog) => void dialog.accept());
    await press('Delete Yard');
    await expect(page.getByText('No place yet.')).toBeVisible();
    const wrong = { type: 'FeatureCollection', features: [...(JSON.parse(readFileSync(file, 'utf8')) as { features: object[] }).features, { type: 'Feature', properties: { name: 'Many' }, geometry: { type: 'MultiPoint', coordinates: [[11, 48]] } }] };
    await page.getByLabel('Import GeoJSON').setInputFiles({ name: 'places.geojson', mimeType: 'application/geo+json', buffer: Buffer.from(JSON.stringify(wrong)) });
    await expect(page.getByText('1 places imported, 1 refused')).toBeVisible();
    await expect(page.getByText('many')).toBeVisible();
    expect((await server.request<Stored>('GET', '/v1/places/yard')).geometry).toEqual(stored.geometry);
    expect(await accessibilityFindings(page)).toEqual([]);
  });
});

test.describe('a server that is gone for a while', () => {
  test.use({ allowed: /ERR_|Failed to load|EventSource|reach/ });

  test('leaves no event out of the list and none twice', async ({ console: page, server }) => {
    const world = simulate(13, [0, 0], 300);
    await addCamera(server, 'gate', 'Gate', world);
    const middle = world.live.flatMap(({ truth }) => (truth ? [truth] : []))[0]!;
    await server.request('POST', '/v1/places', { id: 'here', camera_id: 'gate', geometry: { type: 'Point', coordinates: [middle.longitude_deg, middle.latitude_deg] }, radius_m: 8, probability: 0.7, rules: [{ id: 'enter', kind: 'enter' }, { id: 'leave', kind: 'leave' }, { id: 'appeared', kind: 'appeared' }] });
    await openPlaces(page, server, 'gate');
    let stop = walk(server, 'gate', world.live);
    const rows = page.locator('section', { has: page.getByRole('heading', { name: 'Events' }) }).locator('tbody tr');
    await expect(rows.first()).toBeVisible({ timeout: 90_000 });
    stop();
    await server.kill();
    await expect(page.getByText('The server cannot be reached.')).toBeVisible();
    await server.restart();
    const before = (await eventsOf(server, 'camera=gate')).length;
    stop = walk(server, 'gate', world.live);
    await expect.poll(async () => (await eventsOf(server, 'camera=gate')).length, { timeout: 90_000 }).toBeGreaterThan(before);
    stop();
    await expect.poll(async () => (await eventsOf(server, 'camera=gate')).length === (await rows.count()), { timeout: 30_000 }).toBe(true);
  });
});
