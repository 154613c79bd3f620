// What somebody sees who starts the program for the first time, and the moving picture of it in the documentation.
import { execFileSync } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { accessibilityFindings, expect, test } from './fixtures';
import type { ServerInfo } from '../src/lib/types';

const PICTURES = process.env.CONSOLE_PICTURES ? resolve('../docs/console') : undefined;
/** Frames of the moving picture, and the time from one to the next. */
const FRAMES = 40;
const FRAME_MS = 500;

test.use({ flags: ['--demo'] });

test('the demonstration moves, says that it is simulated, and ends by its button', async ({ console: page, server }) => {
  await expect.poll(async () => (await server.request<ServerInfo>('GET', '/v1/server')).demonstration, { timeout: 120_000 }).toBe(true);
  await page.reload();
  const bar = page.getByRole('complementary', { name: 'Demonstration' });
  await expect(bar).toContainText('Everything here is simulated');
  for (const name of ['Square, west', 'Square, middle', 'Square, east', 'Yard', 'Ramp']) await expect(page.getByRole('link', { name: new RegExp(`^${name}`) })).toBeVisible();

  // The ship has no box; a camera with a dozen people sees some of them.
  const world = async (): Promise<{ target_id?: string }[]> => (await server.request<{ items: { target_id?: string }[] }>('GET', '/v1/sites/demo-square/tracks')).items;
  await expect.poll(async () => (await world()).map((track) => track.target_id), { timeout: 60_000 }).toContain('276000001');
  await page.goto(`${server.url}/#/cameras/demo-middle/live`);
  await expect(page.getByRole('button', { name: /^tracker:\d/ }).first()).toBeVisible();
  expect(await accessibilityFindings(page)).toEqual([]);

  await bar.getByRole('button').click();
  await expect(bar).toBeHidden();
  await expect(page.getByText('Demonstration', { exact: true })).toBeHidden();
  expect((await server.request<{ items: unknown[] }>('GET', '/v1/cameras')).items).toEqual([]);
  expect((await server.request<{ items: unknown[] }>('GET', '/v1/connections')).items).toEqual([]);
});

test('the moving picture of the documentation', async ({ console: page, server }) => {
  test.skip(!PICTURES, 'pictures are taken on request');
  await page.setViewportSize({ width: 1120, height: 700 });
  await expect.poll(async () => (await server.request<ServerInfo>('GET', '/v1/server')).demonstration, { timeout: 120_000 }).toBe(true);
  await page.goto(`${server.url}/#/cameras/demo-middle/live`);
  await page.reload();
  await expect(page.getByRole('button', { name: /^tracker:\d/ }).nth(3)).toBeVisible();
  const folder = mkdtempSync(join(tmpdir(), 'sightfix-frames-'));
  const started_ms = Date.now();
  for (let frame = 0; frame < FRAMES; frame++) {
    await page.waitForTimeout(Math.max(0, started_ms + frame * FRAME_MS - Date.now()));
    writeFileSync(join(folder, `${String(frame).padStart(3, '0')}.png`), await page.screenshot());
  }
  // Python with Pillow joins the frames.
  execFileSync(process.env.PYTHON ?? 'python3', ['tests/moving_picture.py', folder, join(PICTURES!, 'demonstration.webp'), String(FRAME_MS)]);
  rmSync(folder, { recursive: true });
});
