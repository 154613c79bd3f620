// Every view, light and dark, wide and narrow, in both languages: accessible, without overflow; and its picture.
import { mkdirSync } from 'node:fs';
import { resolve } from 'node:path';
import type { Page } from '@playwright/test';
import { accessibilityFindings, expect, test } from './fixtures';
import { boundsOf } from '../src/lib/geo';
import { stillOf } from './still';
import { addCamera, rowsOf, simulate, walk, type SimulatedCamera } from './world';
import type { Server } from './server';

/** Pictures for the documentation are taken on request, so that a run of the tests changes no file. */
const PICTURES = process.env.CONSOLE_PICTURES ? resolve('../docs/console') : undefined;
if (PICTURES) mkdirSync(PICTURES, { recursive: true });

const TOWN: [id: string, name: string, zone: string, east_deg: number, north_deg: number][] = [
  ['north-gate', 'North gate', 'gate', 0, 0],
  ['tram-stop', 'Tram stop', 'plaza', -0.0021, 0.0003],
  ['fountain', 'Fountain', 'plaza', 0.0012, 0.0006],
  ['market-hall', 'Market hall', 'plaza', -0.0011, -0.0006],
  ['south-gate', 'South gate', 'gate', 0.0016, -0.0005],
];

const VIEWS: [name: string, path: string, ready: (page: Page) => Promise<void>][] = [
  ['overview', '#/cameras', (page) => expect(page.getByText('North gate').first()).toBeVisible()],
  ['setup', '#/cameras/north-gate/setup', (page) => expect(page.getByText(/Model version \d+ answers|Modellversion \d+ antwortet/)).toBeVisible()],
  ['scene', '#/cameras/north-gate/scene', (page) => expect(page.getByText(/mean [\d.]+ m|Mittel [\d,]+ m/)).toBeVisible()],
  ['live', '#/cameras/north-gate/live', (page) => expect(page.getByRole('button', { name: 'person-1' })).toBeVisible()],
  ['places', '#/cameras/north-gate/places', chooseSquare],
  ['place-form', '#/cameras/north-gate/places', openSquare],
  ['history', '#/cameras/north-gate/history', (page) => expect(page.getByRole('slider')).toBeVisible()],
  ['data', '#/cameras/north-gate/data', (page) => expect(page.locator('.notice').first()).toBeVisible()],
  ['training', '#/cameras/north-gate/training', (page) => expect(page.locator('table')).toBeVisible()],
  ['models', '#/cameras/north-gate/models', (page) => expect(page.locator('table').first()).toBeVisible()],
  ['evaluation', '#/cameras/north-gate/evaluation', (page) => expect(page.locator('table').first()).toBeVisible()],
  ['try-it', '#/cameras/north-gate/try', (page) => expect(page.locator('.weights')).toBeVisible()],
  ['profile', '#/cameras/north-gate/profile', (page) => expect(page.getByText('north-gate').first()).toBeVisible()],
  ['site', '#/sites/old-town', (page) => expect(page.locator('.targets tbody tr').first()).toBeVisible({ timeout: 60_000 })],
  ['site-places', '#/sites/old-town/places', (page) => expect(page.getByRole('listitem')).toHaveCount(1)],
  ['site-history', '#/sites/old-town/history', (page) => expect(page.getByRole('slider')).toBeVisible()],
  ['site-training', '#/sites/old-town/training', (page) => expect(page.locator('main .panel').first()).toBeVisible()],
  ['site-profile', '#/sites/old-town/profile', (page) => expect(page.getByRole('checkbox')).toBeVisible()],
  ['settings', '#/settings/health', (page) => expect(page.getByText('/metrics')).toBeVisible()],
  ['connections', '#/settings/connections', (page) => expect(page.getByRole('article')).toHaveCount(3)],
  ['keys', '#/settings/keys', (page) => expect(page.locator('main .panel')).toBeVisible()],
  ['audit', '#/settings/audit', (page) => expect(page.locator('main tbody tr').first()).toBeVisible()],
  ['limits', '#/settings/limits', (page) => expect(page.getByText('page_items')).toBeVisible()],
  ['walk', 'walk#camera=north-gate&receiver=phone-1', (page) => expect(page.locator('.record')).toBeVisible()],
];

async function chooseSquare(page: Page): Promise<void> {
  await page.getByRole('button', { name: 'Square', exact: true }).click();
  await expect(page.getByRole('img', { name: /Targets per interval|Ziele je Intervall/ })).toBeVisible();
}

async function openSquare(page: Page): Promise<void> {
  await page.getByRole('button', { name: /^(Edit Square|Square bearbeiten)$/ }).click();
  await expect(page.getByRole('button', { name: /^(Corner|Ecke) 4$/ })).toBeVisible();
}

interface Town {
  /** The world of the camera that is looked at. */
  world: SimulatedCamera;
  stop: () => void;
}

/** A town with trained cameras, one without samples, one ready to train, and an evaluation. */
async function buildTown(server: Server): Promise<Town> {
  const town = PICTURES ? TOWN : TOWN.slice(0, 1);
  const worlds = town.map(([, , , east, north], at) => simulate(at + 1, [east, north], 300));
  for (const [at, [id, name, zone]] of town.entries()) await addCamera(server, id, name, worlds[at]!, { zone });
  if (PICTURES) await server.train('north-gate', { recipe: 'hybrid', epochs: 60, seed: 1 });
  await server.request('POST', '/v1/cameras', { id: 'roof-east', display_name: 'Roof east', labels: { zone: 'roof' } });
  await server.request('POST', '/v1/cameras', { id: 'car-park', display_name: 'Car park', labels: { zone: 'parking' } });
  await server.request('POST', '/v1/cameras/car-park/samples', worlds[0]!.csv, 'text/csv');
  const { id } = await server.request<{ id: string }>('POST', '/v1/evaluations', {
    camera_id: 'north-gate',
    methods: ['gnss', 'imm_ukf', 'homography.denied', ...(PICTURES ? ['projective.two_step'] : [])],
  });
  await expect.poll(async () => (await server.request<{ state: string }>('GET', `/v1/evaluations/${id}`)).state, { timeout: 600_000 }).toBe('succeeded');
  await connect(server);
  await server.request('POST', '/v1/sites', { id: 'old-town', display_name: 'Old town' });
  for (const [camera] of town.slice(0, 3)) await server.request('PATCH', `/v1/cameras/${camera}`, { site: 'old-town' }, 'application/merge-patch+json', { 'if-match': '*' });
  await addPlaces(server, worlds[0]!);
  const stops = town.slice(0, 3).map(([camera], at) => walk(server, camera, worlds[at]!.live, 2 * at + 1));
  return { world: worlds[0]!, stop: () => stops.forEach((stop) => stop()) };
}

/** The square's western half, for a camera and for the site, and a line across the square. */
async function addPlaces(server: Server, { live }: SimulatedCamera): Promise<void> {
  const positions = live.flatMap(({ truth }) => (truth ? [truth] : []));
  const bounds = boundsOf(positions)!;
  const middle_deg = (bounds.west + bounds.east) / 2;
  const ring = [[bounds.west, bounds.south], [middle_deg, bounds.south], [middle_deg, bounds.north], [bounds.west, bounds.north], [bounds.west, bounds.south]];
  const area = { display_name: 'Square', geometry: { type: 'Polygon', coordinates: [ring] }, probability: 0.8, rules: [{ id: 'enter', kind: 'enter' }, { id: 'leave', kind: 'leave' }] };
  const line = { type: 'LineString', coordinates: [[middle_deg, bounds.south], [middle_deg, bounds.north]] };
  await server.request('POST', '/v1/places', { ...area, id: 'square', camera_id: 'north-gate' });
  await server.request('POST', '/v1/places', { ...area, id: 'old-square', site_id: 'old-town' });
  await server.request('POST', '/v1/places', { id: 'line', display_name: 'Line', camera_id: 'north-gate', geometry: line, rules: [{ id: 'cross', kind: 'cross' }] });
}

/** A source that has taken a message, one whose peer is away, and a sink. */
async function connect(server: Server): Promise<void> {
  const create = (id: string, display_name: string, settings: object): Promise<unknown> => server.request('POST', '/v1/connections', { id, display_name, ...settings });
  await create('entrance', 'Frigate at the entrance', { source: { address: 'push:', format: 'frigate', cameras: { front_door: { camera_id: 'car-park' } } } });
  const after = { id: '1607123955.475377-mxklsc', camera: 'front_door', frame_time: Date.now() / 1000, label: 'person', false_positive: false, score: 0.88, box: [432, 296, 544, 500] };
  await server.request('POST', '/v1/connections/entrance/messages', { type: 'new', after });
  await create('patrol-boat', 'Patrol boat', { source: { address: 'tcp://127.0.0.1:9', format: 'nmea', camera_ids: ['north-gate'], receiver_id: 'boat' } });
  await create('dispatch', 'Positions for dispatch', { sink: { address: 'udp://127.0.0.1:6969', format: 'cot', camera_ids: ['north-gate'] } });
}

/** A still image behind the foot points of the camera that is looked at. */
async function setStill(page: Page, server: Server, { csv }: SimulatedCamera): Promise<void> {
  const buffer = await stillOf(page, rowsOf(csv), { width_px: 1280, height_px: 720 });
  await page.goto(`${server.url}/#/cameras/north-gate/scene`);
  await page.locator('.still input').setInputFiles({ name: 'still.png', mimeType: 'image/png', buffer });
  await expect(page.getByText('Everybody who may see this camera sees it.')).toBeVisible();
}

type Theme = 'dark' | 'light';

async function look(page: Page, server: Server, path: string, ready: (page: Page) => Promise<void>, theme: Theme): Promise<void> {
  await page.goto('about:blank');
  await page.goto(`${server.url}/${path}`);
  await ready(page);
  // The emulated preference may reach a new page after its first view; colours that change meanwhile have no contrast.
  await expect(page.locator('html')).toHaveAttribute('data-theme', theme);
  // Transitions to the colours of the theme begin with the next frame.
  await page.evaluate(async () => {
    for (let frame = 0; frame < 2; frame += 1) await new Promise(requestAnimationFrame);
    await Promise.all(document.getAnimations().filter(({ effect }) => Number.isFinite(effect?.getComputedTiming().endTime)).map(({ finished }) => finished.catch(() => undefined)));
  });
}

test('every view is accessible, fits and can be shown', async ({ console: page, server }) => {
  test.setTimeout(1_200_000);
  const { world, stop } = await buildTown(server);
  if (PICTURES) await setStill(page, server, world);
  // Trails grow while other views are looked at.
  for (const theme of ['dark', 'light'] as const) {
    await page.emulateMedia({ colorScheme: theme, reducedMotion: 'reduce' });
    for (const [name, path, ready] of VIEWS) {
      const isLong = PICTURES && /^(evaluation|models|connections)$/.test(name);
      await page.setViewportSize(name === 'walk' ? { width: 390, height: 844 } : { width: 1440, height: isLong ? 1300 : 900 });
      await look(page, server, path, ready, theme);
      expect.soft(await accessibilityFindings(page), `${name}, ${theme}`).toEqual([]);
      if (PICTURES) {
        await page.waitForTimeout(name === 'live' ? 6000 : 1200);
        await page.screenshot({ path: `${PICTURES}/${name}-${theme}.png` });
      }
    }
  }
  await page.setViewportSize({ width: 390, height: 844 });
  await page.evaluate(() => localStorage.setItem('sightfix.language', 'de'));
  for (const [name, path, ready] of VIEWS) {
    await look(page, server, path, ready, 'light');
    expect.soft(await accessibilityFindings(page), `${name}, narrow`).toEqual([]);
    const overflow = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
    expect.soft(overflow, `${name} scrolls sideways at 390 px`).toBeLessThanOrEqual(0);
    const hidden = await page.locator('main').evaluate((main) => main.scrollWidth - main.clientWidth);
    expect.soft(hidden, `${name} is cut off at 390 px`).toBeLessThanOrEqual(0);
    if (PICTURES && (name === 'overview' || name === 'scene')) await page.screenshot({ path: `${PICTURES}/${name}-phone.png` });
  }
  stop();
});

test.describe('the description of the interface', () => {
  // The checks are run in the page, whose policy allows its own scripts alone.
  test.use({ bypassCSP: true });

  test('is accessible, also where an operation is open', async ({ console: page, server }) => {
    await page.goto(`${server.url}/docs/`);
    await expect(page.getByRole('button', { name: /^GET \/v1\/cameras( |$)/ })).toBeVisible();
    expect(await accessibilityFindings(page)).toEqual([]);
    await page.getByRole('button', { name: /\/v1\/cameras\/\S*fusions( |$)/ }).first().click();
    await expect(page.getByRole('heading', { name: 'Responses' })).toBeVisible();
    expect(await accessibilityFindings(page)).toEqual([]);
  });
});

test('the keyboard reaches a camera and its tabs', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate', display_name: 'Gate' });
  await page.reload();
  await expect(page.getByRole('link', { name: /^Gate/ })).toBeVisible();
  await page.keyboard.press('Tab');
  await expect(page.getByText('Skip to the content')).toBeFocused();
  await page.keyboard.press('Enter');
  for (let presses = 0; presses < 20; presses++) {
    await page.keyboard.press('Tab');
    if (await page.getByRole('link', { name: /^Gate/ }).evaluate((link) => link === document.activeElement)) break;
  }
  await page.keyboard.press('Enter');
  await expect(page.getByRole('heading', { name: 'Gate' })).toBeVisible();
  await page.getByRole('link', { name: 'Data', exact: true }).focus();
  await page.keyboard.press('Enter');
  await expect(page.getByText('Drop files here')).toBeVisible();
});

test('the first view is small, and the map comes later', async ({ console: page, server }) => {
  test.skip(!!process.env.CONSOLE_DIST, 'files of a folder are not compressed');
  // The fixture has loaded the page before, and its files are kept for a year.
  const session = await page.context().newCDPSession(page);
  await session.send('Network.enable');
  await session.send('Network.setCacheDisabled', { cacheDisabled: true });
  const sizes = new Map<string, number>();
  page.on('response', (response) => void response.request().sizes().then(({ responseBodySize }) => sizes.set(new URL(response.url()).pathname, responseBodySize)).catch(() => undefined));
  await page.goto('about:blank');
  await page.goto(server.url);
  await expect(page.getByText('No camera yet')).toBeVisible();
  await expect.poll(() => [...sizes.keys()].some((path) => path.includes('leaflet-src'))).toBe(true);
  const first = [...sizes].filter(([path]) => !path.includes('leaflet'));
  const bytes = first.reduce((sum, [, size]) => sum + size, 0);
  console.log(`first view without the map: ${Math.round(bytes / 1000)} kB compressed in ${first.length} files`);
  expect(bytes).toBeGreaterThan(50_000);
  expect(bytes).toBeLessThan(200_000);
});
