// Two thousand cameras.
import type { Locator, Page } from '@playwright/test';
import type { CameraStatus, Page as ApiPage } from '../src/lib/types';
import { expect, test } from './fixtures';
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
  await townOf(page);
  await page.reload();
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

  // Frames under the wheel, for information: this machine may be busy.
  await list.hover();
  await page.evaluate(() => {
    const frames: number[] = [];
    Object.assign(window, { frames });
    const measure = (before_ms: number) => (now_ms: number) => {
      frames.push(now_ms - before_ms);
      requestAnimationFrame(measure(now_ms));
    };
    requestAnimationFrame(measure(performance.now()));
  });
  await taken();
  for (let turn = 0; turn < 60; turn++) {
    await page.mouse.wheel(0, 240);
    await page.evaluate(() => new Promise(requestAnimationFrame));
  }
  // The camera under the mouse is another one again and again: it is marked above the map.
  expect((await taken()).paints, 'the map under the marks').toBe(0);
  const frames_ms = (await page.evaluate(() => (window as unknown as { frames: number[] }).frames)).sort((a, b) => a - b);
  const quantile = (share: number): string => `${frames_ms[Math.floor(share * (frames_ms.length - 1))]!.toFixed(1)} ms`;
  console.log(`frames while the wheel turns over ${CAMERAS} cameras: median ${quantile(0.5)}, 95th percentile ${quantile(0.95)}, longest ${quantile(1)} (${frames_ms.length} frames)`);

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

  // Frames while the map is dragged, for information: this machine may be busy.
  const area = (await page.getByRole('application').boundingBox())!;
  await page.mouse.move(area.x + area.width / 2, area.y + area.height / 2);
  await page.mouse.down();
  const frames_ms = await page.evaluate(() => {
    const frames: number[] = [];
    Object.assign(window, { frames });
    const measure = (before_ms: number) => (now_ms: number) => {
      frames.push(now_ms - before_ms);
      requestAnimationFrame(measure(now_ms));
    };
    requestAnimationFrame(measure(performance.now()));
    return frames.length;
  });
  for (let step = 1; step <= 60; step++) {
    await page.mouse.move(area.x + area.width / 2 + 3 * step, area.y + area.height / 2 + step);
    await page.evaluate(() => new Promise(requestAnimationFrame));
  }
  await page.mouse.up();
  const taken = (await page.evaluate(() => (window as unknown as { frames: number[] }).frames)).slice(frames_ms).sort((a, b) => a - b);
  const total_ms = taken.reduce((sum, frame) => sum + frame, 0);
  console.log(`frames while the map of ${many} cameras is dragged: ${((1000 * taken.length) / total_ms).toFixed(0)} a second, longest ${taken.at(-1)!.toFixed(0)} ms`);
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
