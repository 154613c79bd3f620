// While somebody walks: the guide, and the still image behind the foot points.
import { expect, test } from './fixtures';
import { simulate } from './world';

const SIZE = { width_px: 1280, height_px: 720 };

test('the guide follows the walk, says what is missing, and when it is enough', async ({ console: page, server }) => {
  const [head, ...rows] = simulate(7, [0, 0], 400).csv.trim().split('\n');
  await server.request('POST', '/v1/cameras', { id: 'gate', image_size: SIZE });
  await page.goto(`${server.url}/#/cameras/gate/data`);
  const guide = page.locator('section', { has: page.getByRole('heading', { name: 'Recording guide' }) });
  await expect(guide.getByText('Not enough yet')).toBeVisible();
  const plane = guide.getByRole('img');
  await expect(plane).toHaveAccessibleName(/cover 0 %/);

  const store = (from: number, until: number): Promise<unknown> => server.request('POST', '/v1/cameras/gate/samples', [head, ...rows.slice(from, until)].join('\n'), 'text/csv');
  await store(0, 100);
  await expect(guide.getByText('100 samples have come since this view was opened')).toBeVisible();
  await expect(plane).not.toHaveAccessibleName(/cover 0 %/);
  await expect(guide.getByText('Training is possible')).toBeVisible();
  await expect(guide.getByRole('listitem').filter({ hasText: '100 samples with a fix (wanted: 300)' })).toContainText('not met');
  await expect(guide.getByText('Walk next:')).toBeVisible();
  await store(100, 400);
  await expect(guide.getByRole('listitem').filter({ hasText: '400 samples with a fix' })).toContainText('met:');
  // Why it is not enough yet, as long as it is not.
  const open = await guide.getByRole('listitem').filter({ hasText: 'not met' }).count();
  await expect(guide.getByText(open > 0 ? 'Training is possible' : 'Enough for a good model')).toBeVisible();
});

test('a picture that is dropped on the image plane is kept by the server', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate', image_size: SIZE });
  await server.request('POST', '/v1/cameras/gate/samples', simulate(8, [0, 0], 60).csv, 'text/csv');
  await page.goto(`${server.url}/#/cameras/gate/scene`);
  const plane = page.getByRole('region', { name: 'Image plane' });
  await expect(plane.getByRole('img')).toHaveAccessibleName(/60 boxes/);
  const dropped = await page.evaluateHandle(async () => {
    const canvas = document.createElement('canvas');
    [canvas.width, canvas.height] = [1280, 720];
    const context = canvas.getContext('2d')!;
    context.fillStyle = 'rgb(200 30 60)';
    context.fillRect(0, 0, 1280, 720);
    const blob = await new Promise<Blob>((done) => canvas.toBlob((it) => done(it!)));
    const transfer = new DataTransfer();
    transfer.items.add(new File([blob], 'still.png', { type: 'image/png' }));
    return transfer;
  });
  await plane.dispatchEvent('drop', { dataTransfer: dropped });
  await expect(page.getByText('Everybody who may see this camera sees it.')).toBeVisible();
  const redness = (): Promise<number> =>
    plane.locator('canvas').evaluate((element) => {
      const canvas = element as HTMLCanvasElement;
      // In the picture, beside the foot points.
      const [red, green] = canvas.getContext('2d')!.getImageData(canvas.width / 2, canvas.height / 2 - canvas.width * 0.25, 1, 1).data;
      return red! - green!;
    });
  await expect.poll(redness).toBeGreaterThan(80);
  await page.reload();
  await expect.poll(redness).toBeGreaterThan(80);
  const picture = await fetch(`${server.url}/v1/cameras/gate/picture`);
  expect([picture.status, picture.headers.get('content-type')]).toEqual([200, 'image/jpeg']);
  await page.getByRole('button', { name: 'Remove picture' }).click();
  await expect.poll(redness).toBeLessThan(20);
});

test('the code for a phone holds a key for this camera alone', async ({ console: page, server }) => {
  for (const id of ['gate', 'other']) await server.request('POST', '/v1/cameras', { id });
  const { secret } = await server.request<{ secret: string }>('POST', '/v1/keys', { name: 'first', role: 'admin', camera_ids: [] });
  await page.goto('about:blank');
  await page.context().request.post(`${server.url}/v1/session`, { data: { key: secret } });
  await page.goto(`${server.url}/#/cameras/gate/data`);
  await page.getByRole('button', { name: 'Add phone' }).click();
  const dialog = page.getByRole('dialog', { name: 'Add phone' });
  await expect(dialog.getByRole('img', { name: 'QR code of the phone page' })).toBeVisible();
  await dialog.getByLabel('Receiver').fill('phone-3');
  await dialog.getByRole('button', { name: 'Add a key for one day' }).click();
  await expect(dialog.getByText('expires in a day')).toBeVisible();
  const address = new URL((await dialog.locator('pre').textContent())!);
  const values = new URLSearchParams(address.hash.slice(1));
  expect([address.pathname, values.get('camera'), values.get('receiver')]).toEqual(['/walk', 'gate', 'phone-3']);
  const send = async (camera: string): Promise<number> => {
    const observation = { time: new Date().toISOString(), receiver_id: 'phone-3', fix: { longitude_deg: 11, latitude_deg: 48 } };
    const headers = { authorization: `Bearer ${values.get('key')}`, 'content-type': 'application/json' };
    return (await fetch(`${server.url}/v1/cameras/${camera}/tracks`, { method: 'POST', headers, body: JSON.stringify(observation) })).status;
  };
  expect(await send('gate')).toBe(200);
  expect(await send('other')).toBe(403);
});

test.describe('the phone page', () => {
  test.use({ allowed: /ERR_INTERNET_DISCONNECTED|ERR_FAILED/ });

  test('opens again without a network', async ({ console: page, server, context }) => {
    await page.goto(`${server.url}/walk#camera=gate`);
    await expect(page.getByRole('button', { name: 'Start recording' })).toBeVisible();
    await expect.poll(() => page.evaluate(async () => (await (await caches.open('sightfix-walk')).keys()).length)).toBeGreaterThan(3);
    await page.evaluate(() => navigator.serviceWorker.ready);
    await context.setOffline(true);
    await page.reload();
    await expect(page.getByRole('button', { name: 'Start recording' })).toBeVisible();
    await context.setOffline(false);
  });

  test('records nothing while it may not read the position', async ({ console: page, server, context }) => {
    await context.clearPermissions();
    await page.goto(`${server.url}/walk#camera=gate`);
    await page.getByRole('button', { name: 'Start recording' }).click();
    await expect(page.getByRole('alert')).toContainText('may not read the position');
    await expect(page.getByText('stopped')).toBeVisible();
    await expect(page.getByRole('button', { name: 'Start recording' })).toBeVisible();
  });
});
