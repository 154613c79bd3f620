// The cameras of a site are trained together.
import { mkdirSync } from 'node:fs';
import { resolve } from 'node:path';
import type { Page } from '@playwright/test';
import type { SiteTrainingRun } from '../src/lib/types';
import { accessibilityFindings, expect, test } from './fixtures';
import { simulateSite } from './world';
import type { Server } from './server';

const RUNS = '/v1/sites/street/training-runs';
const PICTURES = process.env.CONSOLE_PICTURES ? resolve('../docs/console') : undefined;

async function addSite(server: Server, samples: Record<string, string>): Promise<void> {
  await server.request('POST', '/v1/sites', { id: 'street', display_name: 'Street' });
  for (const [camera, csv] of Object.entries(samples)) {
    await server.request('POST', '/v1/cameras', { id: camera, display_name: `Camera ${camera}`, site: 'street', image_size: { width_px: 1280, height_px: 720 } });
    await server.request('POST', `/v1/cameras/${camera}/samples`, csv, 'text/csv');
  }
}

const activeModels = async (server: Server): Promise<(number | undefined)[]> =>
  Promise.all(['c1', 'c2'].map(async (camera) => (await server.request<{ active_model?: number }>('GET', `/v1/cameras/${camera}`)).active_model));

const runsOf = async (server: Server): Promise<SiteTrainingRun[]> => (await server.request<{ items: SiteTrainingRun[] }>('GET', RUNS)).items;

/** What the page says of a run whose versions were no better than the active ones; the server words the reason so. */
async function showNotActivated(page: Page, { id, report }: SiteTrainingRun): Promise<void> {
  const outcome = 'no version became active: of camera c2: 3.100 m from 80 held-out fixes against 2.900 m of version 1; activate them camera by camera if they are the better';
  await page.route(`**${RUNS}?*`, (route) => route.fulfill({ json: { items: [{ id, site_id: 'street', seed: 3, state: 'succeeded', progress: { epoch: 69, epochs: 69 }, outcome, report: { ...report, is_activated: false, disagreement_m: undefined }, created_at: '2026-01-05T09:00:00Z' }] } }));
  await page.reload();
  await expect(page.locator('.content .notice.warning')).toHaveText(/^The versions are stored, but none became active\. of camera c2: 3\.100 m from 80 .* if they are the better$/);
  await expect(page.getByText('How far the cameras disagree could not be measured')).toBeVisible();
  expect(await accessibilityFindings(page), 'not activated').toEqual([]);
  await page.unroute(`**${RUNS}?*`);
}

test('a site is trained together: started, cancelled, started again, reported', async ({ console: page, server }) => {
  test.setTimeout(1_200_000);
  await addSite(server, simulateSite(14, 600));
  await page.goto(`${server.url}/#/sites/street/training`);
  await expect(page.getByRole('heading', { name: 'No training run of this site yet' })).toBeVisible();
  const start = page.getByRole('button', { name: 'Start training' });
  await start.click();
  await expect(page.getByRole('progressbar', { name: 'Progress of the training run' })).toBeVisible();
  await expect(start).toBeDisabled();
  await expect(page.getByText('One run per site at a time.')).toBeVisible();
  expect(await accessibilityFindings(page), 'running').toEqual([]);
  // Progress is read again and again: the first answer has none.
  await expect(page.getByText(/^[1-9]\d*\s?%$/)).toBeVisible({ timeout: 600_000 });
  const share = Number(await page.getByRole('progressbar').getAttribute('aria-valuenow'));
  expect(share).toBeGreaterThan(0);
  await page.getByRole('button', { name: 'Cancel' }).click();
  await expect(page.getByRole('status').getByText('cancelled')).toBeVisible({ timeout: 120_000 });
  expect(await activeModels(server)).toEqual([undefined, undefined]);

  // A part of the samples is fitted sooner.
  await page.getByText('More settings').click();
  await page.getByLabel('Seed').fill('3');
  await page.getByLabel('Until').fill('2026-01-05T08:00:40');
  await start.click();
  await expect(page.getByRole('status').getByText('succeeded')).toBeVisible({ timeout: 600_000 });
  const [run, cancelled] = await runsOf(server);
  expect([run!.seed, run!.until, cancelled!.state]).toEqual([3, '2026-01-05T08:00:40Z', 'cancelled']);
  const report = run!.report!;
  expect(report.is_activated).toBe(true);
  expect(await activeModels(server)).toEqual([1, 1]);

  await expect(page.getByText('The versions of all cameras became active together.')).toBeVisible();
  const [together, apart] = [report.disagreement_m!, report.disagreement_apart_m!].map((value) => `${value.toFixed(2)} m`);
  await expect(page.getByText(`one target are ${together} apart on average; where the cameras are trained one by one, ${apart}.`)).toBeVisible();
  const findings = page.getByRole('table', { name: 'What the run found out per camera' }).locator('tbody tr');
  await expect(findings).toHaveCount(2);
  for (const [at, finding] of report.cameras.entries()) {
    const cells = findings.nth(at).locator('td');
    await expect(cells).toHaveText([
      `Camera ${finding.camera_id}`,
      'v1 · active',
      finding.samples.toLocaleString('en-GB'),
      finding.held_out_apart_m === undefined ? '–' : `${finding.held_out_apart_m.toFixed(2)} m`,
      `${finding.held_out_m.toFixed(2)} m`,
      `${Math.round(finding.coverage95_of_fixes * 100)} %`,
      finding.comparison,
    ]);
  }

  // Past runs are looked at again.
  const past = page.locator('tbody tr:has(button[aria-pressed])');
  await expect(past).toHaveCount(2);
  await expect(past.first()).toContainText(`${apart} → ${together}`);
  await expect(past.first()).toContainText('Camera c1, Camera c2');
  await past.last().getByRole('button').click();
  await expect(findings).toHaveCount(0);
  await expect(page.getByRole('status').getByText('cancelled')).toBeVisible();
  await past.first().getByRole('button').click();
  await expect(findings).toHaveCount(2);

  for (const theme of ['dark', 'light'] as const) {
    await page.emulateMedia({ colorScheme: theme, reducedMotion: 'reduce' });
    await expect(page.locator('html')).toHaveAttribute('data-theme', theme);
    await page.evaluate(async () => {
      for (let frame = 0; frame < 2; frame += 1) await new Promise(requestAnimationFrame);
    });
    expect(await accessibilityFindings(page), theme).toEqual([]);
    if (!PICTURES) continue;
    mkdirSync(PICTURES, { recursive: true });
    await page.locator('.content').screenshot({ path: `${PICTURES}/site-training-${theme}.png` });
  }
  await showNotActivated(page, run!);
  await page.evaluate(() => localStorage.setItem('sightfix.language', 'de'));
  await page.setViewportSize({ width: 390, height: 844 });
  await page.reload();
  await expect(page.getByText('Die Versionen aller Kameras wurden gemeinsam aktiv.')).toBeVisible();
  expect(await accessibilityFindings(page), 'narrow').toEqual([]);
  const hidden = await page.locator('main').evaluate((main) => main.scrollWidth - main.clientWidth);
  expect(hidden, 'cut off at 390 px').toBeLessThanOrEqual(0);
});

test.describe('a refused run', () => {
  test.use({ allowed: /409 \(Conflict\)/ });

  test('of a site that cannot be trained says why', async ({ console: page, server }) => {
    const { c1, c2 } = simulateSite(8, 60) as { c1: string; c2: string };
    await addSite(server, { c1, c2: c2.split('\n').slice(0, 16).join('\n') });
    await page.goto(`${server.url}/#/sites/street/training`);
    const start = page.getByRole('button', { name: 'Start training' });
    await expect(page.getByText('Too few samples for a run, which needs at least 20 of each camera:')).toBeVisible();
    await expect(page.locator('.content').getByRole('link', { name: 'Camera c2' })).toHaveAttribute('href', '#/cameras/c2/data');
    await expect(start).toBeDisabled();
    await server.request('POST', '/v1/cameras/c2/samples', c2, 'text/csv');
    await expect(start).toBeEnabled();
    // Somebody else is faster: the page says so and shows that run.
    let isOther = false;
    await page.route(`**${RUNS}`, async (route) => {
      if (route.request().method() === 'POST' && !isOther) {
        isOther = true;
        await server.request('POST', RUNS, { seed: 7 });
      }
      await route.fallback();
    });
    await start.click();
    await expect(page.getByText('There is a training run that has not ended:')).toBeVisible();
    await expect(page.locator('tbody tr:has(button[aria-pressed])').locator('td').nth(1)).toHaveText('7');
    // A camera alone is not trained together with anything.
    for (const { id, state } of await runsOf(server)) if (state === 'queued' || state === 'running') await server.request('POST', `${RUNS}/${id}/cancel`).catch(() => undefined);
    await server.request('PATCH', '/v1/cameras/c2', { site: null }, 'application/merge-patch+json', { 'if-match': '*' });
    await expect(page.getByText('A site with two cameras or more can be trained together.')).toBeVisible();
    await expect(start).toBeDisabled();
  });
});
