// Points of the ground whose place is known, stated by a click on the picture.
import { expect, test } from './fixtures';
import type { Camera } from '../src/lib/types';

/** A PNG of one red pixel. */
const PIXEL = Buffer.from('iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mP8z8BQDwAEhQGAhKmMIQAAAABJRU5ErkJggg==', 'base64');

test('a click on the picture begins a known point, and the profile keeps it', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate', image_size: { width_px: 1280, height_px: 720 } });
  await fetch(`${server.url}/v1/cameras/gate/picture`, { method: 'PUT', headers: { 'content-type': 'image/png' }, body: PIXEL });
  await page.goto(`${server.url}/#/cameras/gate/profile`);
  await page.getByLabel('Picture of the camera: click a point of the ground').click();
  // The middle of the picture is that of the image, to the pixels of the screen.
  await expect(page.getByLabel('Point 1: from the left, px')).toHaveValue(/^6(39|40)/);
  await page.getByLabel('Point 1: from the left, px').fill('640');
  await page.getByLabel('From the top, px').fill('355.5');
  const fields = page.getByRole('group', { name: 'Known points' });
  await fields.getByLabel('Longitude, degrees').fill('24.7453');
  await fields.getByLabel('Latitude, degrees').fill('59.4368');
  await page.getByRole('button', { name: 'Save' }).click();
  await expect(page.getByText('Saved')).toBeVisible();
  const point = { x_px: 640, y_px: 355.5, position: { longitude_deg: 24.7453, latitude_deg: 59.4368 }, sigma_m: 0.5 };
  expect((await server.request<Camera>('GET', '/v1/cameras/gate')).known_points).toEqual([point]);

  await page.getByRole('button', { name: 'Remove point 1' }).click();
  await page.getByRole('button', { name: 'Save' }).click();
  await expect(page.getByLabel('Point 1: from the left, px')).toHaveCount(0);
  await expect.poll(async () => (await server.request<Camera>('GET', '/v1/cameras/gate')).known_points).toEqual([]);
});
