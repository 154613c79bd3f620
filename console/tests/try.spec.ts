// The lines for a shell that ask the same as the try-it form.
import { execFileSync } from 'node:child_process';
import { resolve } from 'node:path';
import type { FusedFix } from '../src/lib/types';
import { expect, test } from './fixtures';
import { addCamera, simulate } from './world';

/** grpcurl itself, or its stand-in. */
const PATH = `${process.env.PATH}:${resolve('tests/bin')}`;
const run = (line: string, environment: Record<string, string> = {}): string => execFileSync('sh', ['-c', line], { encoding: 'utf8', env: { ...process.env, PATH, ...environment } });

test('the lines of curl and grpcurl, run as they are written, give the answer of the page (grpcurl may be a stand-in with server reflection)', async ({ console: page, server }) => {
  await addCamera(server, 'gate', "Ada's gate", simulate(12, [0, 0], 300));
  await page.goto(`${server.url}/#/cameras/gate/try`);
  const position = page.locator('.position');
  await expect(position).toBeVisible();
  const shown = (fused: FusedFix['fused']): string => `${fused.latitude_deg.toFixed(7)}, ${fused.longitude_deg.toFixed(7)}`;

  const curl = (await page.locator('pre', { hasText: /^curl / }).textContent())!;
  const rest = JSON.parse(run(curl)) as { items: FusedFix[] };
  await expect(position).toHaveText(shown(rest.items[0]!.fused));
  const grpcurl = (await page.locator('pre', { hasText: /^grpcurl / }).textContent())!;
  // JSON as protobuf writes it.
  const grpc = JSON.parse(run(grpcurl)) as { fusions: { fused: { longitudeDeg: number; latitudeDeg: number } }[] };
  const { longitudeDeg: longitude_deg, latitudeDeg: latitude_deg } = grpc.fusions[0]!.fused;
  await expect(position).toHaveText(shown({ longitude_deg, latitude_deg }));
});

test.describe('with keys', () => {
  test.use({ allowed: /status of 401/ });

  test('both lines take the key from the shell', async ({ console: page, server }) => {
    await addCamera(server, 'gate', 'Gate', simulate(12, [0, 0], 300));
    const { secret } = await server.request<{ secret: string }>('POST', '/v1/keys', { name: 'first', role: 'admin', camera_ids: [] });
    await page.goto(`${server.url}/#/cameras/gate/try`);
    await page.getByLabel('Key').fill(secret);
    await page.getByRole('button', { name: 'Sign in' }).click();
    const lines = page.locator('pre');
    await expect(lines.first()).toContainText('$SIGHTFIX_KEY');
    for (const line of await lines.allTextContents()) {
      expect(line).not.toContain(secret);
      expect(run(line, { SIGHTFIX_KEY: secret })).toContain('fused');
    }
  });
});
