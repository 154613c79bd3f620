// What somebody sees who starts the program for the first time, and the moving picture of it in the documentation.
import { execFileSync } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import type { Page } from '@playwright/test';
import { accessibilityFindings, expect, test } from './fixtures';
import type { ServerInfo } from '../src/lib/types';

const PICTURES = process.env.CONSOLE_PICTURES ? resolve('../docs/console') : undefined;
/** Length of the moving picture, and least time from one of its frames to the next. */
const PICTURE_MS = 20_000;
const FRAME_MS = 250;

/** Writes what the page shows into files that are named by their times, ms. */
async function recordFrames(page: Page, folder: string): Promise<void> {
  const session = await page.context().newCDPSession(page);
  let latest_ms = 0;
  session.on('Page.screencastFrame', ({ data, sessionId, metadata }) => {
    void session.send('Page.screencastFrameAck', { sessionId });
    const time_ms = Math.round(1000 * metadata.timestamp!);
    if (time_ms - latest_ms < FRAME_MS) return;
    latest_ms = time_ms;
    writeFileSync(join(folder, `${time_ms}.png`), Buffer.from(data, 'base64'));
  });
  await session.send('Page.startScreencast', { format: 'png' });
  await page.waitForTimeout(PICTURE_MS);
  await session.send('Page.stopScreencast');
}

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
  const events = async (): Promise<unknown[]> => (await server.request<{ items: unknown[] }>('GET', '/v1/place-events?site=demo-square')).items;
  await expect.poll(async () => (await events()).length, { timeout: 120_000 }).toBeGreaterThan(0);
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
  await recordFrames(page, folder);
  // Python with Pillow joins the frames.
  execFileSync(process.env.PYTHON ?? 'python3', ['tests/moving_picture.py', folder, join(PICTURES!, 'demonstration.webp')]);
  rmSync(folder, { recursive: true });
});
