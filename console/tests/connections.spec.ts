// Connections with other systems, against peers of the test's own.
import { createServer as createHttpServer, type Server as HttpServer } from 'node:http';
import { createServer, type AddressInfo, type Server as TcpServer, type Socket } from 'node:net';
import type { Locator, Page } from '@playwright/test';
import { accessibilityFindings, expect, test } from './fixtures';

async function portOf(server: TcpServer | HttpServer): Promise<number> {
  await new Promise<void>((done) => server.listen(0, '127.0.0.1', done));
  return (server.address() as AddressInfo).port;
}

/** A GGA sentence of now, with its checksum. */
function gga(): string {
  const clock = new Date().toISOString().replace(/[-:]/g, '').slice(9, 15);
  const body = `GPGGA,${clock}.00,4800.0000,N,01100.0000,E,4,12,0.6,500.0,M,46.0,M,,`;
  const sum = [...body].reduce((xor, letter) => xor ^ letter.charCodeAt(0), 0);
  return `$${body}*${sum.toString(16).toUpperCase().padStart(2, '0')}\r\n`;
}

async function newConnection(page: Page, kind: string): Promise<Locator> {
  await page.getByRole('button', { name: 'New connection' }).click();
  const dialog = page.getByRole('dialog', { name: 'New connection' });
  await dialog.getByRole('button', { name: kind, exact: true }).click();
  return dialog;
}

const card = (page: Page, name: string): Locator => page.getByRole('article', { name, exact: true });
const figure = (of: Locator, name: string): Locator => of.locator('dl div', { has: of.page().getByText(name, { exact: true }) }).locator('dd');

test('a receiver over TCP is connected, watched, tried, paused, resumed and deleted', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  const sockets = new Set<Socket>();
  const receiver = createServer((socket) => {
    sockets.add(socket.on('error', () => undefined).on('close', () => sockets.delete(socket)));
  });
  const port = await portOf(receiver);
  const talk = setInterval(() => sockets.forEach((socket) => socket.write(gga())), 300);

  await page.goto(`${server.url}/#/settings/connections`);
  await expect(page.getByText('No other system is connected.')).toBeVisible();
  const dialog = await newConnection(page, 'NMEA receiver or AIS');
  expect(await accessibilityFindings(page)).toEqual([]);
  await dialog.getByLabel(/^Name/).fill('Patrol boat');
  await dialog.getByLabel('Address').fill(`tcp://127.0.0.1:${port}`);
  await dialog.getByLabel(/^Receiver whose/).fill('boat');
  await dialog.getByRole('button', { name: 'Connect' }).click();

  const boat = card(page, 'Patrol boat');
  await expect(boat).toContainText('Running');
  await expect(figure(boat, 'Items')).not.toHaveText('0');
  await expect(figure(boat, 'Lag')).toHaveText(/ s$/);
  await expect(boat).toContainText(`tcp://127.0.0.1:${port}`);
  await boat.getByText(/^Last message/).click();
  await expect(boat.locator('pre')).toContainText('$GPGGA');
  await boat.getByRole('button', { name: 'Try it' }).click();
  await expect(boat.getByRole('status')).toContainText('The latest message and what was read from it');
  await expect(boat.getByRole('status').getByRole('list', { name: 'What was read' })).toContainText('camera gate: fix of the connection');
  const tracks = await server.request<{ features: { properties: { target_id: string } }[] }>('GET', '/v1/cameras/gate/tracks');
  expect(tracks.features.map((feature) => feature.properties.target_id)).toEqual(['boat']);
  expect(await accessibilityFindings(page)).toEqual([]);

  await boat.getByRole('button', { name: 'Pause' }).click();
  await expect(boat).toContainText('Paused');
  await boat.getByRole('button', { name: 'Resume' }).click();
  await expect(boat).toContainText('Running');

  // The peer goes.
  clearInterval(talk);
  receiver.close();
  sockets.forEach((socket) => socket.destroy());
  await expect(boat).toContainText('Failed, trying again');
  await expect(boat.locator('.notice.error [lang=en]')).not.toBeEmpty();
  page.once('dialog', (question) => void question.accept());
  await boat.getByRole('button', { name: 'Delete' }).click();
  await expect(page.getByText('No other system is connected.')).toBeVisible();
});

test('a webhook that refuses has dead letters, which are tried again; its secret is never shown', async ({ console: page, server }) => {
  const secret = `whsec_${Buffer.from('a secret of thirty-two bytes ...').toString('base64')}`;
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  let status = 200;
  const bodies: string[] = [];
  const hook = createHttpServer((request, response) => {
    let body = '';
    request.on('data', (part) => (body += String(part)));
    request.on('end', () => {
      if (status === 200) bodies.push(body);
      response.writeHead(status).end();
    });
  });
  const port = await portOf(hook);
  const shown: string[] = [];
  page.on('response', (response) => {
    if (response.url().includes('/v1/connections')) void response.text().then((text) => shown.push(text), () => undefined);
  });

  await page.goto(`${server.url}/#/settings/connections`);
  const dialog = await newConnection(page, 'Webhook');
  await dialog.getByLabel(/^Name/).fill('Dispatch');
  await dialog.getByLabel('Address').fill(`http://127.0.0.1:${port}/positions`);
  await dialog.getByLabel(/^Signing key/).fill(secret);
  await dialog.getByRole('button', { name: 'Connect' }).click();
  const dispatch = card(page, 'Dispatch');
  await expect(dispatch).toContainText('Secrets set: signing_key');
  await dispatch.getByRole('button', { name: 'Try it' }).click();
  await expect(dispatch.getByRole('status')).toContainText('A test position was sent');
  expect(bodies).toHaveLength(1);

  status = 400;
  const observe = (): Promise<unknown> => server.request('POST', '/v1/cameras/gate/tracks', { time: new Date().toISOString(), target_id: 'van', fix: { longitude_deg: 11, latitude_deg: 48, sigma_m: 2 } });
  await observe();
  await expect(figure(dispatch, 'Dead letters')).toHaveText('1');
  await dispatch.getByText(/^1 dead letter/).click();
  await expect(dispatch.locator('details li', { hasText: 'answered 400' }).filter({ has: page.locator('pre') })).toContainText('"target_id":"van"');
  expect(await accessibilityFindings(page)).toEqual([]);
  status = 200;
  await dispatch.getByRole('button', { name: 'Try all again' }).click();
  await expect(figure(dispatch, 'Dead letters')).toHaveText('0');
  await expect.poll(() => bodies.filter((body) => body.includes('"van"')).length).toBe(1);

  status = 400;
  await observe();
  await expect(figure(dispatch, 'Dead letters')).toHaveText('1');
  page.once('dialog', (question) => void question.accept());
  if (!(await dispatch.getByRole('button', { name: 'Delete all' }).isVisible())) await dispatch.getByText(/^1 dead letter/).click();
  await dispatch.getByRole('button', { name: 'Delete all' }).click();
  await expect(figure(dispatch, 'Dead letters')).toHaveText('0');
  expect(shown.length).toBeGreaterThan(3);
  expect(shown.join('')).not.toContain(secret);
  expect(await page.content()).not.toContain(secret);
  hook.close();
});

test.describe('every kind', () => {
  test.use({ allowed: /status of 422/ });

  test('has a form whose connection the server takes', async ({ console: page, server }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate', image_size: { width_px: 1280, height_px: 720 } });
    await page.goto(`${server.url}/#/settings/connections`);
    await page.getByRole('button', { name: 'New connection' }).click();
    const kinds = await page.getByRole('dialog').locator('.kinds button').allTextContents();
    expect(kinds.length).toBeGreaterThanOrEqual(10);
    await page.keyboard.press('Escape');
    for (const kind of kinds) {
      const dialog = await newConnection(page, kind);
      // Nobody answers there, and what is listened on is this machine's alone.
      const address = dialog.getByLabel('Address');
      const proposed = await address.inputValue();
      await address.fill(proposed.replace(/^(?!push:|udp:)(\w+):\/\/[^:/]+/, '$1://127.0.0.1').replace(/:\d+$/, ':9'));
      if (await dialog.getByLabel(/^Topics/).count()) await dialog.getByLabel(/^Topics/).fill('site/#');
      await dialog.getByRole('button', { name: 'Connect' }).click();
      await expect(dialog, kind).toBeHidden();
      await expect(card(page, kind), kind).toBeVisible();
    }
    const { items } = await server.request<{ items: { id: string; source?: object; sink?: object }[] }>('GET', '/v1/connections');
    expect(items).toHaveLength(kinds.length);
    expect(items.find(({ id }) => id === 'frigate')).toMatchObject({ source: { format: 'frigate', topics: ['site/#'], cameras: { '*': { camera_id: 'gate' } }, store_samples: true } });
    expect(items.find(({ id }) => id === 'webhook')).toMatchObject({ sink: { format: 'json', camera_ids: ['gate'] } });

    // A refusal names the field.
    const dialog = await newConnection(page, 'gpsd');
    await dialog.getByLabel(/^Name/).fill('Other');
    await dialog.getByLabel('Address').fill('ftp://somewhere');
    await dialog.getByRole('button', { name: 'Connect' }).click();
    await expect(dialog.getByRole('alert')).toContainText('source.address');
    await expect(dialog.getByRole('alert').locator('[lang=en]')).toContainText('must begin with');
  });
});

test('a sink of NATS over TLS asks for an authority and the certificate of the client', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  await page.goto(`${server.url}/#/settings/connections`);
  const dialog = await newConnection(page, 'NATS');
  const certificates = dialog.getByText('Certificates', { exact: true });
  await expect(certificates).toHaveCount(0);
  await dialog.getByLabel(/^Name/).fill('Bus');
  await dialog.getByLabel('Address').fill('natss://127.0.0.1:4222');
  await certificates.click();
  await expect(dialog.getByLabel(/^Authority of the peer/)).toBeVisible();
  await expect(dialog.getByLabel(/^Client certificate/)).toBeVisible();
  await dialog.getByLabel('Topic or subject').fill('site.{camera}');
  await dialog.getByRole('button', { name: 'Connect' }).click();
  await expect(card(page, 'Bus')).toContainText('natss://127.0.0.1:4222');
  const { items } = await server.request<{ items: { sink?: { address: string; topic?: string } }[] }>('GET', '/v1/connections');
  expect(items.map(({ sink }) => sink)).toMatchObject([{ address: 'natss://127.0.0.1:4222', topic: 'site.{camera}' }]);
});
