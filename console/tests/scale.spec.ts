// Two thousand cameras, ten thousand, and two hundred targets.
import { spawn } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import type { Locator, Page } from '@playwright/test';
import type { CameraStatus, Page as ApiPage } from '../src/lib/types';
import { expect, test } from './fixtures';
import { BINARY } from './server';
import { addCamera, simulate, walk } from './world';

const CAMERAS = 2000;
const ROW_PX = 54;
/** Rows that are kept above and below the view. */
const BEYOND = 8;

/** The statuses of two thousand cameras that look at squares of a town: read once, so that nothing changes meanwhile. */
async function townOf(page: Page): Promise<void> {
  let pages = 0;
  await page.route('**/v1/camera-statuses?*', async (route) => {
    pages += 1;
    if (pages > CAMERAS / 1000) return;
    const response = await route.fetch();
    const answer = (await response.json()) as ApiPage<CameraStatus>;
    answer.items = answer.items.map((status) => {
      const number = Number(status.camera.id.split('-')[1]);
      const [west, south] = [11 + (number % 50) * 0.002, 48 + Math.floor(number / 50) * 0.0015];
      const corners = [[0, 0], [0.0009, 0], [0.0009, 0.0006], [0, 0.0006]] as const;
      const view_area = corners.map(([east, north]) => ({ longitude_deg: west + east, latitude_deg: south + north }));
      return { ...status, model: { held_out_mean_to_fix_m: 1 + (number % 9) / 4, median_r95_m: 3, view_area }, camera: { ...status.camera, active_model: 1 } };
    });
    await route.fulfill({ response, json: answer });
  });
}

/** Frames that the page draws while something goes on: a second, and the longest, ms. For information: this machine may be busy. */
async function frames(page: Page, during: () => Promise<void>): Promise<string> {
  await page.evaluate(() => {
    const frames_ms: number[] = [];
    Object.assign(window, { frames_ms });
    const measure = (before_ms: number) => (now_ms: number) => {
      frames_ms.push(now_ms - before_ms);
      requestAnimationFrame(measure(now_ms));
    };
    requestAnimationFrame(measure(performance.now()));
  });
  await during();
  const taken = await page.evaluate(() => (window as unknown as { frames_ms: number[] }).frames_ms);
  const total_ms = taken.reduce((sum, frame) => sum + frame, 0);
  return `${((1000 * taken.length) / total_ms).toFixed(0)} frames a second, longest ${Math.max(...taken).toFixed(0)} ms`;
}

/** A recording of targets that walk in circles, each with a fix at every instant, as CSV. */
function recordingOf(targets: number, seconds: number, rate_hz: number): string {
  const start_ms = Date.UTC(2026, 0, 5, 8);
  const rows = ['time,target_id,longitude,latitude'];
  for (let at = 0; at < seconds * rate_hz; at++) {
    const time = new Date(start_ms + (1000 * at) / rate_hz).toISOString();
    for (let n = 0; n < targets; n++) {
      const angle = (at / rate_hz) * 0.2 + n;
      const radius_deg = 0.0001 + (n % 20) * 0.00002;
      rows.push(`${time},walker-${n},${(24.745 + radius_deg * 2 * Math.cos(angle)).toFixed(7)},${(59.437 + radius_deg * Math.sin(angle)).toFixed(7)}`);
    }
  }
  return rows.join('\n') + '\n';
}

interface Counted {
  /** Rows that were put into the list, and taken out of it. */
  added: number;
  removed: number;
  /** Times that the map was drawn. */
  paints: number;
}

/** Counts from now on what the page changes. */
async function count(page: Page, list: Locator): Promise<() => Promise<Counted>> {
  await list.evaluate((viewport) => {
    const counted: Counted = { added: 0, removed: 0, paints: 0 };
    const rows = (nodes: NodeList): number => [...nodes].filter((node) => (node as Element).getAttribute?.('role') === 'listitem').length;
    new MutationObserver((changes) => {
      for (const change of changes) {
        counted.added += rows(change.addedNodes);
        counted.removed += rows(change.removedNodes);
      }
    }).observe(viewport, { childList: true, subtree: true });
    const { clearRect } = CanvasRenderingContext2D.prototype;
    CanvasRenderingContext2D.prototype.clearRect = function (...area) {
      if (this.canvas.classList.contains('plane-canvas')) counted.paints += 1;
      clearRect.apply(this, area);
    };
    Object.assign(window, { counted });
  });
  return () =>
    page.evaluate(async () => {
      // What a frame asks for is drawn in the next.
      for (let frame = 0; frame < 3; frame++) await new Promise(requestAnimationFrame);
      const { counted } = window as unknown as { counted: Counted };
      const taken = { ...counted };
      Object.assign(counted, { added: 0, removed: 0, paints: 0 });
      return taken;
    });
}

test('two thousand cameras scroll with work for the rows that come alone, and the map is drawn once per change', async ({ console: page, server }) => {
  for (let from = 0; from < CAMERAS; from += 50) {
    const batch = Array.from({ length: 50 }, (_, at) => from + at);
    await Promise.all(batch.map((n) => server.request('POST', '/v1/cameras', { id: `camera-${n}`, display_name: `Camera ${String(n).padStart(4, '0')}`, labels: { site: `s${n % 7}` } })));
  }
  // The page that is open polls, and would take statuses that the next one needs.
  await page.goto('about:blank');
  await townOf(page);
  await page.goto(`${server.url}/`);
  await expect(page.getByRole('heading', { name: 'Cameras 2,000' })).toBeVisible();
  const list = page.getByRole('list', { name: 'Cameras' });
  const rows = list.getByRole('listitem');
  await expect(rows.first()).toBeVisible();
  await expect(page.locator('.plane-canvas')).toBeVisible();
  const height_px = await list.evaluate((viewport) => viewport.clientHeight);
  const mostRows = Math.ceil(height_px / ROW_PX) + 1 + 2 * BEYOND;
  expect(await rows.count()).toBeLessThanOrEqual(mostRows);

  // Scrolled by what a wheel gives at a time: rows that stay are not touched, nothing is drawn.
  const taken = await count(page, list);
  await list.evaluate((viewport, top) => (viewport.scrollTop = top), 40 * ROW_PX);
  await taken();
  for (const step_rows of [1, 3, 3, -2, 5, -5]) {
    await list.evaluate((viewport, by) => (viewport.scrollTop += by), step_rows * ROW_PX);
    const { added, removed, paints } = await taken();
    expect(added, `rows that came, scrolled by ${step_rows}`).toBe(Math.abs(step_rows));
    expect(removed).toBe(Math.abs(step_rows));
    expect(paints, 'the map, which shows the same').toBe(0);
    expect(await rows.count()).toBeLessThanOrEqual(mostRows);
  }
  // A second goes by in which ages grow, but no state changes.
  await page.waitForTimeout(1500);
  expect(await taken()).toEqual({ added: 0, removed: 0, paints: 0 });

  await list.hover();
  await taken();
  const turned = await frames(page, async () => {
    for (let turn = 0; turn < 60; turn++) {
      await page.mouse.wheel(0, 240);
      await page.evaluate(() => new Promise(requestAnimationFrame));
    }
  });
  // The camera under the mouse is another one again and again: it is marked above the map.
  expect((await taken()).paints, 'the map under the marks').toBe(0);
  console.log(`while the wheel turns over ${CAMERAS} cameras: ${turned}`);

  for (let turn = 0; turn < 10; turn++) {
    await page.mouse.wheel(0, 4000);
    // Wherever the wheel stops, the view is filled: no gap above or below.
    await expect
      .poll(() =>
        list.evaluate((viewport) => {
          const area = viewport.getBoundingClientRect();
          const items = [...viewport.querySelectorAll('[role=listitem]')].map((item) => item.getBoundingClientRect());
          return items.some((it) => it.top <= area.top + 1) && items.some((it) => it.bottom >= area.bottom - 1);
        }),
      )
      .toBe(true);
  }
  await list.evaluate((viewport) => (viewport.scrollTop = viewport.scrollHeight));
  await expect(page.getByText('Camera 1999')).toBeVisible();
  expect(await rows.count()).toBeLessThanOrEqual(mostRows);

  // The mouse away from list and map, so that nothing but the search changes what is drawn.
  await page.mouse.move(5, 5);
  await taken();
  await page.getByRole('searchbox').fill('1234');
  await expect(rows).toHaveCount(1);
  expect((await taken()).paints, 'one search, one drawing').toBe(1);
  await page.getByRole('searchbox').fill('');
  await page.getByLabel('Filter by label').selectOption('site=s3');
  await expect(page.getByText('Camera 0003')).toBeVisible();
  await expect(page.getByText('Camera 0004')).toBeHidden();
});

test('ten thousand cameras are drawn as clusters, whose numbers make ten thousand', async ({ console: page, server }) => {
  const many = 10_000;
  await server.request('POST', '/v1/cameras', { id: 'camera' });
  const { items } = await server.request<ApiPage<CameraStatus>>('GET', '/v1/camera-statuses');
  await page.route('**/v1/camera-statuses?*', async (route) => {
    const from = Number(new URL(route.request().url()).searchParams.get('cursor') ?? 0);
    const camera = (n: number): CameraStatus => {
      // Over a country of 4 by 4 degrees.
      const [west, south] = [9 + ((n * 37) % 1009) / 252, 47 + ((n * 61) % 997) / 249];
      const view_area = [[0, 0], [0.0009, 0], [0.0009, 0.0006], [0, 0.0006]].map(([east, north]) => ({ longitude_deg: west + east!, latitude_deg: south + north! }));
      return { ...items[0]!, model: { median_r95_m: 3, view_area }, camera: { ...items[0]!.camera, id: `camera-${n}`, display_name: `Camera ${n}`, active_model: 1 } };
    };
    const answer = { items: Array.from({ length: 1000 }, (_, at) => camera(from + at)), ...(from + 1000 < many ? { next_cursor: String(from + 1000) } : {}) };
    await route.fulfill({ json: answer });
  });
  await page.evaluate(() => {
    const { fillText } = CanvasRenderingContext2D.prototype;
    const { clearRect } = CanvasRenderingContext2D.prototype;
    const drawn: string[] = [];
    Object.assign(window, { drawn });
    CanvasRenderingContext2D.prototype.clearRect = function (...area) {
      if (this.canvas.classList.contains('plane-canvas')) drawn.length = 0;
      clearRect.apply(this, area);
    };
    CanvasRenderingContext2D.prototype.fillText = function (...text) {
      if (this.canvas.classList.contains('plane-canvas')) drawn.push(text[0]);
      fillText.apply(this, text);
    };
  });
  await page.evaluate(() => (location.hash = '#/settings/keys'));
  await page.evaluate(() => (location.hash = '#/cameras'));
  await expect(page.getByRole('heading', { name: 'Cameras 10,000' })).toBeVisible();
  const drawn = (): Promise<string[]> => page.evaluate(() => (window as unknown as { drawn: string[] }).drawn);
  const inClusters = (texts: string[]): number => texts.reduce((sum, text) => sum + (/^[\d,]+$/.test(text) ? Number(text.replace(',', '')) : 1), 0);
  await expect.poll(async () => inClusters(await drawn())).toBe(many);
  expect((await drawn()).length).toBeLessThan(1000);

  const area = (await page.getByRole('application').boundingBox())!;
  await page.mouse.move(area.x + area.width / 2, area.y + area.height / 2);
  await page.mouse.down();
  const dragged = await frames(page, async () => {
    for (let step = 1; step <= 60; step++) {
      await page.mouse.move(area.x + area.width / 2 + 3 * step, area.y + area.height / 2 + step);
      await page.evaluate(() => new Promise(requestAnimationFrame));
    }
  });
  await page.mouse.up();
  console.log(`while the map of ${many} cameras is dragged: ${dragged}`);
});

test('two hundred targets move at ten positions a second each', async ({ console: page, server }) => {
  const [targets, seconds, rate_hz] = [200, 20, 10];
  await server.request('POST', '/v1/cameras', { id: 'square', display_name: 'Square' });
  const folder = mkdtempSync(join(tmpdir(), 'sightfix-walkers-'));
  const file = join(folder, 'walkers.csv');
  writeFileSync(file, recordingOf(targets, seconds, rate_hz));
  await page.goto(`${server.url}/#/cameras/square/live`);
  await page.reload();
  const replay = spawn(BINARY, ['replay', file, '--server', server.url, '--camera', 'square', '--shift-to-now', '--quiet'], { stdio: 'ignore' });
  const ended = new Promise((done) => replay.once('exit', done));
  await expect(page.getByRole('button', { name: /^walker-/ })).toHaveCount(targets);
  const moving = await frames(page, () => page.waitForTimeout(8000));
  console.log(`while ${targets} targets move at ${rate_hz} Hz: ${moving}`);
  expect(await ended).toBe(0);
  rmSync(folder, { recursive: true });
});

test('targets of a live camera are on the map of all cameras', async ({ console: page, server }) => {
  const world = simulate(5, [0, 0], 300);
  await addCamera(server, 'gate', 'Gate', world);
  const stop = walk(server, 'gate', world.live);
  await page.reload();
  // Dots of targets are the only thing on the canvas above the map while nothing is pointed at.
  const marked = (): Promise<boolean> =>
    page.locator('.mark-canvas').evaluate((element) => {
      const canvas = element as HTMLCanvasElement;
      return canvas.getContext('2d')!.getImageData(0, 0, canvas.width, canvas.height).data.some((value) => value > 0);
    });
  await expect.poll(marked).toBe(true);
  stop();
});
