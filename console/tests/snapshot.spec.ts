// A still picture that the server fetches from the camera, as its profile says.
import { createServer } from 'node:http';
import type { AddressInfo } from 'node:net';
import { expect, test } from './fixtures';
import { simulate } from './world';

/** A PNG of one red pixel. */
const PIXEL = Buffer.from('iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mP8z8BQDwAEhQGAhKmMIQAAAABJRU5ErkJggg==', 'base64');

test('the console has the server fetch a still from the address of the profile', async ({ console: page, server }) => {
  const asked: (string | undefined)[] = [];
  const camera = createServer((request, response) => {
    asked.push(`${request.url} ${request.headers.authorization}`);
    if (request.headers.authorization) response.writeHead(200, { 'content-type': 'image/png' }).end(PIXEL);
    else response.writeHead(401, { 'www-authenticate': 'Basic realm="gate"' }).end();
  });
  await new Promise<void>((done) => camera.listen(0, '127.0.0.1', done));
  const { port } = camera.address() as AddressInfo;

  await server.request('POST', '/v1/cameras', { id: 'gate', image_size: { width_px: 1280, height_px: 720 } });
  await server.request('POST', '/v1/cameras/gate/samples', simulate(4).csv, 'text/csv');
  await page.goto(`${server.url}/#/cameras/gate/profile`);
  await page.getByLabel('Address (http:, https: or onvif:), which the server asks').fill(`http://127.0.0.1:${port}/api/gate/latest.jpg`);
  await page.getByLabel('User name').fill('viewer');
  await page.getByLabel('Password').fill('s3cret');
  await page.getByRole('button', { name: 'Save' }).click();
  await expect(page.getByText('Saved')).toBeVisible();
  await expect(page.getByLabel('Password')).toHaveValue('');

  const fetched = page.waitForResponse((response) => response.request().method() === 'POST' && response.url().endsWith('/picture'));
  await page.getByRole('link', { name: 'Scene' }).click();
  expect((await fetched).status()).toBe(200);
  const basic = `Basic ${Buffer.from('viewer:s3cret').toString('base64')}`;
  expect(asked).toEqual(['/api/gate/latest.jpg undefined', `/api/gate/latest.jpg ${basic}`]);
  camera.close();
});
