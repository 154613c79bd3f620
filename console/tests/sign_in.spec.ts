// Sign-in of people at a provider of OpenID Connect.
import { createServer, type AddressInfo } from 'node:net';
import type { Page } from '@playwright/test';
import { accessibilityFindings, expect, test as base } from './fixtures';
import { CLIENT_ID, OpenIdProvider } from './openid_provider';

async function freePort(): Promise<number> {
  const server = createServer();
  await new Promise<void>((done) => server.listen(0, '127.0.0.1', done));
  const { port } = server.address() as AddressInfo;
  await new Promise((done) => server.close(done));
  return port;
}

const test = base.extend<{ provider: OpenIdProvider }>({
  provider: async ({}, use) => {
    const provider = await OpenIdProvider.start();
    await use(provider);
    await provider.stop();
  },
  // The provider has to know where it leads people back to.
  listen: async ({}, use) => use(`127.0.0.1:${await freePort()}`),
  settings: async ({ provider, listen }, use) =>
    use({
      SIGHTFIX_OPENID__ISSUER: provider.url,
      SIGHTFIX_OPENID__CLIENT_ID: CLIENT_ID,
      SIGHTFIX_OPENID__CLIENT_SECRET: 's3cret',
      SIGHTFIX_OPENID__REDIRECT_URL: `http://${listen}/v1/session/openid/callback`,
      SIGHTFIX_OPENID__OPERATORS: 'site-operators',
    }),
});
// Without a session everything is refused; the provider's page is nobody's else.
test.use({ allowed: /status of 40[13]|^foreign request: http:\/\/127\.0\.0\.1:\d+\/authorize\?/ });

const cover = (page: Page): ReturnType<Page['getByRole']> => page.getByRole('dialog', { name: 'Sign in to sightfix' });

test('a person signs in at the provider, comes back to the view that they left, and signs out', async ({ console: page, server }) => {
  await page.goto(`${server.url}/#/settings/limits`);
  await expect(cover(page)).toBeVisible();
  expect(await accessibilityFindings(page)).toEqual([]);
  await cover(page).getByRole('link', { name: 'Sign in with your organisation' }).click();
  await page.getByRole('link', { name: 'I am Ada' }).click();
  await expect(page.getByRole('heading', { name: 'Limits' })).toBeVisible();
  await expect(cover(page)).toBeHidden();
  await expect(page.getByText('page_items')).toBeVisible();
  // No page learns the code.
  expect(page.url()).toBe(`${server.url}/#/settings/limits`);

  await page.getByRole('link', { name: 'Keys', exact: true }).click();
  await expect(page.getByText(/Signed in as user 7 \(ada\) \(operator\)/)).toBeVisible();
  await page.getByRole('button', { name: 'Sign out' }).click();
  await expect(cover(page)).toBeVisible();
});

test('who cancels, and who has no role, is told so in words, and may try again', async ({ console: page, server, provider }) => {
  await expect(cover(page)).toBeVisible();
  await cover(page).getByRole('link', { name: 'Sign in with your organisation' }).click();
  await page.getByRole('link', { name: 'Cancel' }).click();
  await expect(cover(page).getByRole('alert')).toContainText('The sign-in was cancelled');
  expect(page.url()).toBe(`${server.url}/#/sign-in/unauthenticated`);

  provider.groups = ['staff'];
  await cover(page).getByRole('link', { name: 'Sign in with your organisation' }).click();
  await page.getByRole('link', { name: 'I am Ada' }).click();
  await expect(cover(page).getByRole('alert')).toContainText('no role is given to you here');
  await page.evaluate(() => localStorage.setItem('sightfix.language', 'de'));
  await page.reload();
  await expect(page.getByRole('dialog').getByRole('alert')).toContainText('keine Rolle zugeteilt');
  expect(await accessibilityFindings(page)).toEqual([]);

  provider.groups = ['site-operators'];
  await page.getByRole('link', { name: 'Mit der Organisation anmelden' }).click();
  await page.getByRole('link', { name: 'I am Ada' }).click();
  await expect(page.getByRole('dialog')).toBeHidden();
  await expect(page.getByText('Noch keine Kamera')).toBeVisible();
});

test('a provider that does not answer is named as such', async ({ console: page, provider }) => {
  await expect(cover(page)).toBeVisible();
  await provider.stop();
  await cover(page).getByRole('link', { name: 'Sign in with your organisation' }).click();
  await expect(cover(page).getByRole('alert')).toContainText('The sign-in service gives no usable answer');
});
