// What the list and the map of all cameras say.
import type { Page } from '@playwright/test';
import type { CameraStatus } from '../src/lib/types';
import { expect, test } from './fixtures';
import { addCamera, simulate, walk } from './world';

type Change = (status: CameraStatus) => CameraStatus;

/** Changes what the server says of cameras whose state takes long to come about. */
async function change(page: Page, changes: Record<string, Change>): Promise<void> {
  await page.route('**/v1/camera-statuses?*', async (route) => {
    const response = await route.fetch();
    const answer = (await response.json()) as { items: CameraStatus[] };
    answer.items = answer.items.map((status) => changes[status.camera.id]?.(status) ?? status);
    await route.fulfill({ response, json: answer });
  });
}

test('every state is told from the others, with its numbers', async ({ console: page, server }) => {
  const world = simulate(6, [0, 0], 300);
  await server.request('POST', '/v1/cameras', { id: 'empty', labels: { site: 'roof' } });
  await server.request('POST', '/v1/cameras', { id: 'ready' });
  await server.request('POST', '/v1/cameras/ready/samples', world.csv, 'text/csv');
  await addCamera(server, 'live', 'live', world, { site: 'gate' });
  const model = await server.request<{ items: CameraStatus[] }>('GET', '/v1/camera-statuses');
  const trained = model.items.find(({ camera }) => camera.id === 'live')!;
  for (const id of ['moved', 'stale', 'idle', 'fault', 'training']) await server.request('POST', '/v1/cameras', { id });
  const ago = (minutes: number): string => new Date(Date.now() - minutes * 60_000).toISOString();
  const like = (status: CameraStatus): CameraStatus => ({ ...status, model: trained.model!, camera: { ...status.camera, active_model: 1, samples: 300 } });
  await change(page, {
    moved: (status) => {
      const it = like(status);
      return { ...it, camera: { ...it.camera, moved: { model_version: 1, onset_at: ago(9), raised_at: ago(8), shift_east_m: 3, shift_north_m: 4, statistic: 30, targets: 4 } } };
    },
    stale: (status) => ({ ...like(status), last_observed_at: ago(16) }),
    idle: (status) => ({ ...like(status), last_observed_at: ago(3), streams: 2 }),
    fault: (status) => {
      const it = like(status);
      return { ...it, camera: { ...it.camera, model_fault: 'the file is damaged' } };
    },
    training: (status) => ({ ...like(status), latest_run: { id: 'x', state: 'running' } }),
  });
  const stop = walk(server, 'live', world.live);
  await page.reload();
  const row = (id: string): ReturnType<Page['locator']> => page.locator(`a.camera[href="#/cameras/${id}"]`);
  const states = { moved: 'Camera moved', fault: 'Model fault', training: 'Training', live: 'Live', stale: 'Stale', idle: 'Trained', ready: 'Ready to train', empty: 'No samples' };
  for (const [id, state] of Object.entries(states)) await expect(row(id).locator('.badge'), id).toHaveText(state);
  // By state: what needs somebody comes first.
  expect(await page.locator('a.camera .name strong').allTextContents()).toEqual(Object.keys(states));
  await expect(row('live')).toContainText('2 targets');
  await expect(row('idle')).toContainText('2 streams');
  await expect(row('idle')).toContainText('3 min ago');
  await expect(row('live')).toContainText(/[\d.]+ m\s*r95 [\d.]+ m/);
  await expect(row('ready')).toContainText('300');

  await page.getByRole('button', { name: 'Samples', exact: true }).click();
  await expect(page.locator('a.camera').last()).toContainText('empty');
  await page.getByRole('button', { name: 'Samples', exact: true }).click();
  await expect(page.locator('a.camera').first()).toContainText('empty');
  await page.getByRole('group', { name: 'Filter by state' }).getByRole('button', { name: /Stale/ }).click();
  await expect(page.locator('a.camera')).toHaveCount(1);
  await page.getByRole('button', { name: 'All', exact: true }).click();
  await page.getByLabel('Filter by label').selectOption('site=gate');
  await expect(page.locator('a.camera')).toHaveCount(1);
  // Its view area alone is on the map now, in the colour of its state.
  const colored = (): Promise<number> =>
    page.locator('.plane-canvas').evaluate((element) => {
      const canvas = element as HTMLCanvasElement;
      const hex = getComputedStyle(document.documentElement).getPropertyValue('--fused').trim();
      const color = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
      const { data } = canvas.getContext('2d')!.getImageData(0, 0, canvas.width, canvas.height);
      let count = 0;
      for (let at = 0; at < data.length; at += 4) if (data[at + 3]! > 200 && color.every((value, channel) => Math.abs(value - data[at + channel]!) < 12)) count += 1;
      return count;
    });
  await expect.poll(colored).toBeGreaterThan(100);
  await page.getByLabel('Filter by label').selectOption('site=roof');
  await expect.poll(colored).toBe(0);
  stop();
});
