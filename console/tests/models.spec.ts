// Versions of a camera's model, and what happened to them.
import { readFileSync } from 'node:fs';
import { expect, test } from './fixtures';
import { addCamera, simulate } from './world';

test('versions are activated, rolled back, downloaded, uploaded and deleted, and the audit log says so', async ({ console: page, server }) => {
  await addCamera(server, 'gate', 'Gate', simulate(9, [0, 0], 300));
  await page.goto(`${server.url}/#/cameras/gate/models`);
  const versions = page.locator('section', { has: page.getByRole('heading', { name: 'Model versions' }) });
  const row = (version: string): ReturnType<typeof versions.locator> => versions.getByRole('row').filter({ has: page.getByRole('button', { name: version, exact: true }) });
  await expect(row('v1')).toContainText('active');

  const downloading = page.waitForEvent('download');
  await row('v1').getByRole('link', { name: 'Download' }).click();
  const download = await downloading;
  expect(download.suggestedFilename()).toBe('gate-1.safetensors');
  const file = readFileSync(await download.path());
  await page.locator('input[type=file]').setInputFiles({ name: 'copy.safetensors', mimeType: 'application/octet-stream', buffer: file });
  await expect(row('v2')).toContainText('imported');

  const active = async (): Promise<number | undefined> => (await server.request<{ active_model?: number }>('GET', '/v1/cameras/gate')).active_model;
  await row('v2').getByRole('button', { name: 'Activate' }).click();
  await expect(row('v2')).toContainText('active');
  expect(await active()).toBe(2);
  await page.getByRole('button', { name: 'Roll back' }).click();
  await expect(row('v1')).toContainText('active');
  expect(await active()).toBe(1);
  page.once('dialog', (dialog) => void dialog.accept());
  await row('v2').getByRole('button', { name: 'Delete' }).click();
  await expect(row('v2')).toHaveCount(0);

  await page.goto(`${server.url}/#/settings/audit`);
  const log = page.locator('section', { has: page.getByRole('heading', { name: 'Audit log' }) });
  await expect(log.getByRole('row').nth(1)).toContainText(/delete/i);
  await expect(log.getByRole('row').nth(1)).toContainText('gate');
});

test('each version is shown beside GNSS, IMM-UKF and homography, from an evaluation that the page starts', async ({ console: page, server }) => {
  await addCamera(server, 'gate', 'Gate', simulate(11, [0, 0], 300));
  await server.train('gate', { recipe: 'hybrid', epochs: 20, seed: 1 });
  await page.goto(`${server.url}/#/cameras/gate/models`);
  const compared = page.locator('section', { has: page.getByRole('heading', { name: /against GNSS, IMM-UKF and homography$/ }) });
  const report = async (recipe: string): Promise<void> => {
    await compared.getByRole('button', { name: `Evaluate ${recipe}` }).click();
    await expect(compared.getByRole('row')).toHaveCount(5, { timeout: 300_000 });
    for (const method of ['gnss', 'imm_ukf', 'homography.denied', `${recipe}.two_step`]) await expect(compared.getByRole('img', { name: new RegExp(`positions of ${method.replace('.', '\\.')} around the truth$`) })).toBeVisible();
    await expect(compared.getByRole('img', { name: 'Cumulative share of errors by method' })).toBeVisible();
    await expect(compared.getByRole('img', { name: /^Calibration/ })).toBeVisible();
  };
  await page.getByRole('button', { name: 'v1', exact: true }).click();
  await expect(compared.getByRole('heading', { name: 'Version 1 against' })).toBeVisible();
  await expect(compared).toContainText('cannot be judged on the samples that it has learnt from');
  await report('projective');
  await expect(compared).toContainText('the recipe of version 1 (projective), fitted to the earlier samples alone');

  // The other version has its own.
  await page.getByRole('button', { name: 'v2', exact: true }).click();
  await expect(compared.getByRole('heading', { name: 'Version 2 against' })).toBeVisible();
  await expect(compared.getByRole('row')).toHaveCount(0);
  await report('hybrid');
  await page.getByRole('button', { name: 'v1', exact: true }).click();
  await expect(compared.getByRole('img', { name: /positions of projective\.two_step/ })).toBeVisible();
});

test('two runs are compared, and their reports are in words', async ({ console: page, server }) => {
  await addCamera(server, 'gate', 'Gate', simulate(10, [0, 0], 300));
  await page.goto(`${server.url}/#/cameras/gate/training`);
  const run = page.locator('section', { has: page.getByRole('heading', { name: 'Training run', exact: true }) });
  await expect(run.getByText(/Version 1 \(projective\) was fitted in .* to 300 samples/)).toBeVisible();
  await expect(run.getByRole('heading', { name: 'What would help' })).toBeVisible();
  await expect(run.getByRole('listitem').filter({ hasText: 'on another day' })).toBeVisible();

  await page.getByLabel('Recipe').selectOption('hybrid');
  await page.getByText('More settings').click();
  await page.getByLabel('Epochs').fill('30');
  await page.getByLabel('Seed').fill('5');
  await page.getByRole('button', { name: 'Start training' }).click();
  await expect(run.getByRole('progressbar')).toBeVisible();
  await expect(run.locator('.state')).toHaveText('succeeded', { timeout: 300_000 });
  await expect(run.getByRole('img', { name: 'Errors by epoch' })).toBeVisible();
  const compared = page.locator('section', { has: page.getByRole('heading', { name: 'Runs compared' }) });
  await expect(compared.getByRole('row')).toHaveCount(3);
  await expect(compared.getByRole('row').nth(1)).toContainText('hybrid');
  await compared.getByRole('row').nth(2).getByRole('button').first().click();
  await expect(run.getByText('Version 1 (projective)')).toBeVisible();
});
