// From an empty environment to targets that move: the wheel is installed, its program started, its page opened.
import { execFileSync } from 'node:child_process';
import { mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { expect, test } from '@playwright/test';
import { Server } from './server';

test('the wheel is installed, and its demonstration moves in the browser', async ({ page }) => {
  const wheel = process.env.WHEEL;
  test.skip(!wheel, 'WHEEL names no wheel');
  const folder = mkdtempSync(join(tmpdir(), 'sightfix-installed-'));
  const begin_ms = Date.now();
  const times: string[] = [];
  const done = (step: string): void => void times.push(`${step} ${((Date.now() - begin_ms) / 1000).toFixed(1)} s`);

  execFileSync(process.env.PYTHON ?? 'python3', ['-m', 'venv', folder]);
  execFileSync(join(folder, 'bin/pip'), ['install', '--quiet', '--disable-pip-version-check', wheel!]);
  done('installed after');
  const server = await Server.start({}, '', '127.0.0.1:0', ['--demo'], join(folder, 'bin/sightfix'));
  done('the server listens after');
  await page.goto(server.url);
  await expect(page.getByRole('link', { name: /^Square, middle/ })).toBeVisible();
  done('the page shows the cameras after');
  await page.goto(`${server.url}/#/cameras/demo-middle/live`);
  const targets = page.getByRole('row').filter({ hasText: /tracker:\d/ });
  await expect(targets.first()).toBeVisible({ timeout: 120_000 });
  done('targets are seen after');
  const seen = await targets.allInnerTexts();
  await expect.poll(() => targets.allInnerTexts()).not.toEqual(seen);
  done('they move after');
  console.log(times.join(', '));
  await server.stop();
  rmSync(folder, { recursive: true });
});
