// A camera of every source, the filter of its boxes, and phones of every application.
import type { Locator, Page } from '@playwright/test';
import { accessibilityFindings, expect, test } from './fixtures';

async function choose(page: Page, source: RegExp, name: string): Promise<Locator> {
  await page.getByRole('button', { name: 'Add camera' }).first().click();
  const dialog = page.getByRole('dialog', { name: 'Add camera' });
  await dialog.getByRole('button', { name: source }).click();
  await dialog.getByLabel('Name', { exact: true }).fill(name);
  return dialog;
}

async function setSize(dialog: Locator): Promise<void> {
  await dialog.getByLabel('Image width, px').fill('1280');
  await dialog.getByLabel('Image height, px').fill('720');
}

test('boxes of any JSON are found in a message, drawn as they come, and filtered', async ({ console: page, server }) => {
  const detected = (id: number, label: string, confidence: number, foot_px: number): object => ({ id, label, confidence, box: [600, foot_px - 100, 640, foot_px] });
  const dialog = await choose(page, /^Any JSON/, 'Gate');
  await dialog.getByLabel(/^Address/).fill('push:');
  await expect(dialog.getByText('/v1/connections/json-gate/messages')).toBeVisible();
  await dialog.getByLabel(/^A message of the detector/).fill('{"count": 3}');
  await expect(dialog.getByText('This is no JSON object with a box')).toBeVisible();
  await dialog.getByLabel(/^A message of the detector/).fill(JSON.stringify({ camera: 'c1', objects: [detected(7, 'person', 0.9, 500)] }));
  await expect(dialog.getByLabel('Id of the tracker')).toHaveValue('/id');
  await expect(dialog.getByLabel('Class')).toHaveValue('/label');
  await setSize(dialog);
  expect(await accessibilityFindings(page)).toEqual([]);
  await dialog.getByRole('button', { name: 'Connect and look at the boxes' }).click();
  await expect(page.getByRole('heading', { level: 1, name: 'Gate' })).toBeVisible();
  await expect(page.getByText('Running').first()).toBeVisible();
  const { source } = await server.request<{ source: object }>('GET', '/v1/connections/json-gate');
  expect(source).toMatchObject({ format: 'json', mapping: { items: '/objects', target: '/id', class: '/label', score: '/confidence', camera: '/camera', bounding_box: { form: 'corners', unit: 'px' } } });

  const send = (): Promise<unknown> => server.request('POST', '/v1/connections/json-gate/messages', { camera: 'c1', objects: [detected(7, 'person', 0.9, 500), detected(8, 'car', 0.9, 500), detected(9, 'person', 0.3, 500), detected(10, 'person', 0.9, 200)] });
  const picture = page.getByRole('img', { name: /^Picture with/ });
  await expect(async () => {
    await send();
    await expect(picture).toHaveAccessibleName('Picture with 4 boxes as they come', { timeout: 1000 });
  }).toPass();
  // A change is shown before it is saved.
  await page.getByRole('button', { name: 'person', exact: true }).click();
  await page.getByLabel(/^Least score/).fill('0.5');
  await page.getByText(/^Corners of the area/).click();
  await page.getByLabel(/^x and y in px/).fill('0 360\n1280 360\n1280 720\n0 720');
  await page.getByLabel(/^x and y in px/).blur();
  await send();
  await expect(page.getByText(/1 of the 4 in the picture would be taken/)).toBeVisible();
  expect(await accessibilityFindings(page)).toEqual([]);
  await page.getByRole('button', { name: 'Save the filter' }).click();
  await expect(page.getByText('The filter is saved')).toBeVisible();
  await expect.poll(async () => (await server.request<{ status: { connects: number } }>('GET', '/v1/connections/json-gate')).status.connects).toBe(2);
  const before = await server.request<{ status: { items: number; skipped: number } }>('GET', '/v1/connections/json-gate');
  await send();
  const after = await server.request<typeof before>('GET', '/v1/connections/json-gate');
  expect([after.status.items - before.status.items, after.status.skipped - before.status.skipped]).toEqual([1, 3]);

  await page.getByText(/^Why 3 messages or parts/).click();
  await expect(page.getByText("1 the class car is not among the source's classes")).toBeVisible();

  // Nothing was kept until now.
  const learning = (): Promise<{ boxes: number; state: string }> => server.request('GET', '/v1/cameras/gate/learning');
  expect(await learning()).toMatchObject({ boxes: 0, state: 'off' });
  await page.getByRole('button', { name: /start learning/ }).click();
  await expect.poll(async () => (await learning()).state).toBe('recording');
  await send();
  await expect.poll(async () => (await learning()).boxes).toBe(1);
});

test('each source makes a camera, and in German, too', async ({ console: page, server }) => {
  await page.getByRole('button', { name: 'Deutsch' }).click();
  await page.getByRole('button', { name: 'Kamera hinzufügen' }).first().click();
  await expect(page.getByRole('dialog')).toContainText('Woher kommen die Boxen der Kamera?');
  await page.getByRole('button', { name: 'Abbrechen' }).or(page.getByRole('button', { name: 'Schließen' })).first().click();
  await page.getByRole('button', { name: 'English' }).click();
  for (const [source, format] of [['Frigate', 'frigate'], ['ONVIF camera', 'onvif'], ['Axis camera', 'json'], ['DeepStream', 'deepstream']] as const) {
    await page.goto(`${server.url}/#/cameras`);
    const dialog = await choose(page, new RegExp(`^${source}`), source);
    // Nobody answers there.
    await dialog.getByLabel(/^Address/).fill('mqtt://127.0.0.1:9');
    await dialog.getByLabel(/^Topics/).fill('site/boxes');
    await setSize(dialog);
    await dialog.getByRole('button', { name: 'Connect and look at the boxes' }).click();
    await expect(page.getByRole('heading', { level: 1, name: source })).toBeVisible();
    const { items } = await server.request<{ items: { source: { format: string; topics: string[]; cameras: object } }[] }>('GET', '/v1/connections');
    const id = source.toLowerCase().replace(' ', '-');
    expect(items.find((it) => JSON.stringify(it.source.cameras).includes(`"${id}"`))?.source).toMatchObject({ format, topics: ['site/boxes'] });
  }
  await page.goto(`${server.url}/#/cameras`);
  const stream = await choose(page, /^ONVIF camera/, 'Stream');
  await expect(stream.getByLabel(/^Address/)).toHaveValue(/^rtsp:/);
  await expect(stream.getByLabel(/^Topics/)).toBeHidden();
  await stream.getByLabel(/^Address/).fill('rtsp://127.0.0.1:9/metadata');
  await stream.getByLabel('User', { exact: true }).fill('operator');
  await stream.getByLabel('Password').fill('secret');
  await setSize(stream);
  await stream.getByRole('button', { name: 'Connect and look at the boxes' }).click();
  await expect(page.getByRole('heading', { level: 1, name: 'Stream' })).toBeVisible();
  expect(await server.request('GET', '/v1/connections/onvif-stream')).toMatchObject({ source: { format: 'onvif', address: 'rtsp://127.0.0.1:9/metadata', username: 'operator' }, secret_names: ['password'] });
  await page.goto(`${server.url}/#/cameras`);
  const dialog = await choose(page, /^Edge client/, 'Yard');
  await dialog.getByRole('button', { name: 'Create camera' }).click();
  await expect(page.getByText('sightfix-edge --source')).toContainText('--camera yard');
  expect(await accessibilityFindings(page)).toEqual([]);
});

test('each application of phones gets settings that the server takes, and its fix is on the map', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate', image_size: { width_px: 1280, height_px: 720 } });
  const { secret } = await server.request<{ secret: string }>('POST', '/v1/keys', { name: 'first', role: 'admin', camera_ids: [] });
  await page.goto('about:blank');
  await page.context().request.post(`${server.url}/v1/session`, { data: { key: secret } });
  await page.goto(`${server.url}/#/cameras/gate/setup`);
  const [lat, lon, acc] = [48, 11, 5];
  const now_s = (): number => Math.floor(Date.now() / 1000);
  // Bodies as the applications send them (docs/howto/integrations.md).
  const bodies: Record<string, (receiver: string) => string | undefined> = {
    OwnTracks: (receiver) => JSON.stringify({ _type: 'location', lat, lon, acc, tst: now_s(), topic: `owntracks/anna/${receiver}` }),
    'Traccar Client': (receiver) => JSON.stringify({ location: { timestamp: new Date().toISOString(), coords: { latitude: lat, longitude: lon, accuracy: acc } }, device_id: receiver }),
    GPSLogger: () => undefined,
    Overland: (receiver) => JSON.stringify({ locations: [{ type: 'Feature', geometry: { type: 'Point', coordinates: [lon, lat] }, properties: { timestamp: new Date().toISOString(), horizontal_accuracy: acc, device_id: receiver } }] }),
    'Sensor Logger': (receiver) => JSON.stringify({ deviceId: receiver, payload: [{ name: 'location', time: Date.now() * 1_000_000, values: { latitude: lat, longitude: lon, horizontalAccuracy: acc } }] }),
    'Home Assistant': () => JSON.stringify({ type: 'update_location', data: { gps: [lat, lon], gps_accuracy: acc } }),
  };
  for (const [application, body] of Object.entries(bodies)) {
    const receiver = application.toLowerCase().replace(' ', '-');
    await page.getByRole('button', { name: 'Add phone' }).first().click();
    const dialog = page.getByRole('dialog', { name: 'Add phone' });
    await dialog.getByLabel('Application').selectOption({ label: application });
    await dialog.getByLabel('Receiver').fill(receiver);
    await dialog.getByRole('button', { name: 'Make the settings' }).click();
    await expect(dialog.locator('dl')).toBeVisible();
    const names = await dialog.locator('dt').allTextContents();
    const values = await dialog.locator('dd').allTextContents();
    const setting = (name: string): string | undefined => values[names.indexOf(name)];
    const url = setting('URL')!.replace('%LAT', String(lat)).replace('%LON', String(lon)).replace('%ACC', String(acc)).replace('%TIMESTAMP', String(now_s()));
    const headers: Record<string, string> = {};
    if (setting('Password')) headers.authorization = `Basic ${Buffer.from(`${setting('User')}:${setting('Password')}`).toString('base64')}`;
    if (setting('Access token')) headers.authorization = `Bearer ${setting('Access token')}`;
    const content = body(receiver);
    const answer = await fetch(url, { method: 'POST', headers, ...(content === undefined ? {} : { body: content }) });
    expect(Math.floor(answer.status / 100), `${application}: ${answer.status} ${await answer.text()}`).toBe(2);
    if (application === 'OwnTracks') expect(await accessibilityFindings(page)).toEqual([]);
    await page.keyboard.press('Escape');
    await expect(page.getByRole('list', { name: 'Latest fixes' })).toContainText(`${receiver} within`);
  }
  await expect(page.getByText('This server’s page in the browser')).toHaveCount(0);
  expect(await accessibilityFindings(page)).toEqual([]);
});
