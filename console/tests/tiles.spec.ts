// Map tiles from a local file.
import { mkdtempSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { expect, test } from './fixtures';
import { pmtilesFile } from './pmtiles';
import { addCamera, simulate } from './world';

const FILE = join(mkdtempSync(join(tmpdir(), 'sightfix-tiles-')), 'area.pmtiles');
writeFileSync(FILE, pmtilesFile());

test.describe('a server with a file of tiles', () => {
  test.use({ settings: { SIGHTFIX_CONSOLE__TILE_FILE: FILE, SIGHTFIX_CONSOLE__TILE_ATTRIBUTION: 'the survey of the town' } });

  test('the map shows them in the colours of the theme, closer than they were made', async ({ console: page, server }) => {
    await addCamera(server, 'gate', 'Gate', simulate(1));
    const [ranges, scripts]: [string[], string[]] = [[], []];
    page.on('response', (response) => {
      const { pathname } = new URL(response.url());
      if (pathname === '/v1/tiles') ranges.push(`${response.status()} ${response.headers()['content-range'] ?? ''}`);
      if (pathname.endsWith('.js')) scripts.push(pathname);
    });
    await page.reload();
    await expect(page.getByText('the survey of the town')).toBeVisible();
    // The colour in the middle of the tiles, and that of water in the theme.
    const colors = (): Promise<string[]> =>
      page.evaluate(() => {
        const hex = getComputedStyle(document.documentElement).getPropertyValue('--map-water').trim();
        const water = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)).join(' ');
        const canvases = [...document.querySelectorAll<HTMLCanvasElement>('.leaflet-tile-pane canvas')];
        return [water, ...canvases.map((canvas) => [...canvas.getContext('2d')!.getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data.slice(0, 3)].join(' '))];
      });
    const areWater = async (): Promise<boolean> => {
      const [water, ...tiles] = await colors();
      return tiles.length > 0 && tiles.every((color) => color === water);
    };
    await expect.poll(areWater).toBe(true);
    const [before] = await colors();
    await page.getByRole('button', { name: 'Switch between light and dark' }).click();
    await expect.poll(areWater).toBe(true);
    expect((await colors())[0]).not.toBe(before);
    expect(ranges.length).toBeGreaterThan(0);
    expect(ranges.every((range) => /^206 bytes \d+-\d+\/\d+$/.test(range)), ranges.join(', ')).toBe(true);
    expect(scripts.some((path) => path.includes('tile_layer'))).toBe(true);
  });
});

test('without a file nothing of it is loaded, and the map shows the outlines of the world', async ({ console: page, server }) => {
  const paths: string[] = [];
  page.on('request', (request) => paths.push(new URL(request.url()).pathname));
  await page.goto('about:blank');
  await page.goto(server.url);
  await expect(page.getByRole('application')).toBeVisible();
  await expect.poll(() => paths.some((path) => path.includes('leaflet-src'))).toBe(true);
  await expect(page.locator('.plane-canvas')).toBeAttached();
  const landShare = (): Promise<number> =>
    page.locator('.world-canvas').evaluate((element) => {
      const canvas = element as HTMLCanvasElement;
      const { data } = canvas.getContext('2d')!.getImageData(0, 0, canvas.width, canvas.height);
      return data.filter((value, at) => at % 4 === 3 && value > 0).length / (data.length / 4);
    });
  // Land is three tenths of the earth, and more of a Mercator map, which shows the north larger.
  await expect.poll(landShare).toBeGreaterThan(0.2);
  expect(await landShare()).toBeLessThan(0.6);
  expect(paths.filter((path) => /tile_layer|\/v1\/tiles/.test(path))).toEqual([]);
});

test.describe('tiles of another server', () => {
  test.use({ allowed: /foreign request: https:\/\/tile\.openstreetmap\.org\// });

  test('are asked for once the user agrees, and no more once the map is switched off', async ({ console: page, server }) => {
    let asked = 0;
    await page.route('https://tile.openstreetmap.org/**', (route) => {
      asked += 1;
      expect(new URL(route.request().headers().referer ?? 'http://none').origin).toBe(server.url);
      return route.fulfill({ path: 'node_modules/leaflet/dist/images/marker-icon.png' });
    });
    const button = page.getByRole('button', { name: 'Map of OpenStreetMap' });
    await expect(button).toBeVisible();
    page.once('dialog', (dialog) => void dialog.dismiss());
    await button.click();
    expect(asked).toBe(0);
    page.once('dialog', (dialog) => void dialog.accept());
    await button.click();
    await expect(page.getByText('OpenStreetMap contributors')).toBeVisible();
    await expect.poll(() => asked).toBeGreaterThan(0);
    await button.click();
    await page.reload();
    await expect(button).toHaveAttribute('aria-pressed', 'false');
    asked = 0;
    await page.getByRole('button', { name: 'Zoom in' }).click();
    await expect(page.locator('.world-canvas')).toBeAttached();
    expect(asked).toBe(0);
  });
});
