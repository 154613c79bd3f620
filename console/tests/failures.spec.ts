// Failures as a person meets them.
import { readFileSync } from 'node:fs';
import { expect, test } from './fixtures';
import { addCamera, rowsOf, simulate, walk } from './world';

const header = 'time,target_id,left,top,width,height,longitude,latitude';

test.describe('the server goes and comes back', () => {
  test.use({ allowed: /Failed to load resource|ERR_CONNECTION/ });

  test('the page says so, and goes on by itself', async ({ console: page, server }) => {
    const world = simulate(1);
    await addCamera(server, 'gate', 'Gate', world);
    await page.goto(`${server.url}/#/cameras/gate/live`);
    await expect(page.getByRole('status').getByText('Live')).toBeVisible();
    await server.kill();
    await expect(page.getByText('Connection lost. What is shown is old.')).toBeVisible();
    await expect(page.getByRole('alert').getByText('The server cannot be reached')).toBeVisible();
    await server.restart();
    await expect(page.getByRole('alert').getByText('The server cannot be reached')).toBeHidden();
    await expect(page.getByRole('status').getByText('Live')).toBeVisible();
    const stop = walk(server, 'gate', world.live);
    await expect(page.getByRole('button', { name: 'person-1' })).toBeVisible();
    stop();
  });
});

test.describe('addresses', () => {
  // There is no camera of that name.
  test.use({ allowed: /404 \(Not Found\)/ });

  test('an address whose percent signs are no escapes shows a page', async ({ console: page, server }) => {
    await page.goto(`${server.url}/#/%`);
    await expect(page.getByRole('navigation').first()).toBeVisible();
    // A page that is open follows the changed address.
    await page.goto(`${server.url}/#/settings/connections`);
    await page.evaluate(() => (location.hash = '#/cameras/%zz'));
    await expect(page.getByRole('navigation').first()).toBeVisible();
    await page.evaluate(() => (location.hash = '#/settings/connections'));
    await expect(page.getByRole('heading', { name: 'Connections' })).toBeVisible();
  });
});

test('swapped columns are told with the remedy', async ({ console: page, server }) => {
  // The simulated camera is in Europe, where both orders are positions.
  const rows = simulate(1).csv.trim().split(/\r?\n/);
  const swapped = [rows[0]!.replace(/(longitude|latitude)/g, (name) => (name === 'longitude' ? 'latitude' : 'longitude')), ...rows.slice(1)].join('\n');
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  await page.goto(`${server.url}/#/cameras/gate/data`);
  await page.locator('input[type=file]').setInputFiles({ name: 'swapped.csv', mimeType: 'text/csv', buffer: Buffer.from(swapped) });
  await page.getByRole('button', { name: 'Import', exact: true }).click();
  await expect(page.getByText(/swap the two columns/)).toBeVisible();
});

test('bad rows are named with their lines, and can be downloaded', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  await page.goto(`${server.url}/#/cameras/gate/data`);
  const csv = [
    header,
    '2026-01-01T00:00:00Z,a,10,20,30,40,11.0,48.0',
    '2026-01-01T00:00:01Z,a,ten,20,30,40,11.0,48.0',
    '2026-01-01T00:00:02Z,a,10,20,30,40,11.0,480.0',
    '"2026-01-01T00:00:03Z","a",10,20,30,40,11.0,48.0',
    'yesterday,a,10,20,30,40,11.0,48.0',
  ].join('\n');
  await page.locator('input[type=file]').setInputFiles({ name: 'bad.csv', mimeType: 'text/csv', buffer: Buffer.from(csv) });
  await page.getByRole('button', { name: 'Import', exact: true }).click();
  await expect(page.getByText('2 samples stored, 0 stored before, 3 rows rejected.')).toBeVisible();
  const lines = await page.locator('table').last().locator('tbody tr td:first-child').allTextContents();
  expect(lines).toEqual(['3', '4', '6']);
  const downloading = page.waitForEvent('download');
  await page.getByRole('button', { name: 'Download as CSV' }).click();
  const saved = readFileSync(await (await downloading).path(), 'utf8').trim().split('\r\n');
  expect(saved[0]).toBe('part,line,field,reason');
  expect(saved).toHaveLength(4);
  expect(saved[2]).toMatch(/^"","4","latitude/);
});

test('a file of more than a part is sent as it is, and its rows keep their lines', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  await page.goto(`${server.url}/#/cameras/gate/data`);
  const count = 80_000;
  const rows = Array.from({ length: count }, (_, at) => {
    const time = new Date(Date.UTC(2026, 0, 1) + 1000 * at).toISOString().slice(0, 19).replace('T', ' ');
    return `${time};walker;${10 + (at % 900)};20;30;${at === 78_000 ? 'high' : 40};11,5;48,25`;
  });
  const csv = [`Time;Id;X;Y;W;H;Lon;Lat`, ...rows].join('\r\n');
  const parts: number[] = [];
  page.on('request', (request) => {
    if (request.method() === 'POST' && request.url().includes('/samples?')) parts.push(Number(new URL(request.url()).searchParams.get('timezone') === 'Asia/Tokyo'));
  });
  await page.locator('input[type=file]').setInputFiles({ name: 'long.csv', mimeType: 'text/csv', buffer: Buffer.from(csv) });
  await page.getByLabel('Time zone of the times without an offset').selectOption('Asia/Tokyo');
  await page.getByRole('button', { name: 'Import', exact: true }).click();
  await expect(page.getByText('79,999 samples stored, 0 stored before, 1 rows rejected.')).toBeVisible({ timeout: 60_000 });
  expect(parts).toEqual(new Array(Math.ceil(csv.length / (4 << 20))).fill(1));
  // After the header, counted from 1.
  await expect(page.locator('table').last().locator('tbody tr td:first-child')).toHaveText(['78002']);
  const { items } = await server.request<{ items: { time: string; fix: { longitude_deg: number } }[] }>('GET', '/v1/cameras/gate/samples?limit=1');
  expect([items[0]!.time, items[0]!.fix.longitude_deg]).toEqual(['2025-12-31T15:00:00Z', 11.5]);
});

test.describe('an import whose answer is lost', () => {
  test.use({ allowed: /ERR_FAILED/ });

  test('is sent again under its key, and counts as made once', async ({ console: page, server }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate' });
    await page.goto(`${server.url}/#/cameras/gate/data`);
    const keys: string[] = [];
    await page.route('**/v1/cameras/gate/samples?*', async (route) => {
      if (route.request().method() !== 'POST') return route.fallback();
      keys.push(route.request().headers()['idempotency-key']!);
      if (keys.length > 1) return route.fallback();
      expect((await route.fetch()).status()).toBe(200);
      return route.abort('failed');
    });
    const csv = [header, '2026-01-01T00:00:00Z,a,10,20,30,40,11.0,48.0', '2026-01-01T00:00:01Z,a,11,20,30,40,11.0,48.0'].join('\n');
    await page.locator('input[type=file]').setInputFiles({ name: 'walk.csv', mimeType: 'text/csv', buffer: Buffer.from(csv) });
    await page.getByRole('button', { name: 'Import', exact: true }).click();
    await expect(page.getByText('2 samples stored, 0 stored before, 0 rows rejected.')).toBeVisible();
    expect(keys).toHaveLength(2);
    expect(keys[0]).toBe(keys[1]);
  });
});

test('what is no table, and what has no fixes, is said before anything is sent', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  await page.goto(`${server.url}/#/cameras/gate/data`);
  await page.locator('input[type=file]').setInputFiles({ name: 'note.csv', mimeType: 'text/csv', buffer: Buffer.from('hello') });
  await expect(page.getByRole('alert')).toContainText('note.csv is not a table');
  const boxes = 'time,id,x,y,w,h\n2026-01-01T00:00:00Z,a,0.1,0.2,0.1,0.2\n';
  await page.locator('input[type=file]').setInputFiles({ name: 'boxes.csv', mimeType: 'text/csv', buffer: Buffer.from(boxes) });
  await expect(page.getByText('These are detections alone.')).toBeVisible();
  await expect(page.getByLabel('Normalised (0 to 1)')).toBeChecked();
  await expect(page.getByText('Normalised boxes need the image size')).toBeVisible();
  await expect(page.getByRole('button', { name: 'Import', exact: true })).toBeDisabled();
});

test('a run that fails says why', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  // A detector that was stuck for two thirds of the time.
  const rows = Array.from({ length: 60 }, (_, at) => {
    const step = Math.max(0, at - 40);
    return `2026-01-01T00:00:${String(at).padStart(2, '0')}Z,a,${10 + 9 * step},${20 + ((step * step) % 17)},30,40,${11 + 1e-5 * step},${48 + 1e-5 * ((step * 7) % 11)}`;
  });
  await server.request('POST', '/v1/cameras/gate/samples', [header, ...rows].join('\n'), 'text/csv');
  await page.goto(`${server.url}/#/cameras/gate/training`);
  await page.getByRole('button', { name: 'Start training' }).click();
  const run = page.locator('section', { has: page.getByRole('heading', { name: 'Training run', exact: true }) });
  await expect(run.locator('.state')).toHaveText('failed');
  await expect(run.locator('.notice.error')).toContainText(/repeat|same/);
});

test.describe('in German', () => {
  test.use({ allowed: /status of 4(04|22)/ });

  test('a refusal names its kind in German, and what the server words is marked as English', async ({ console: page, server }) => {
    await page.evaluate(() => localStorage.setItem('sightfix.language', 'de'));
    await page.goto(`${server.url}/#/cameras/nobody/scene`);
    await page.reload();
    const alert = page.getByRole('alert');
    await expect(alert).toContainText('Diese Kamera gibt es nicht:');
    await expect(alert.locator('[lang=en]')).toContainText('nobody');

    await server.request('POST', '/v1/cameras', { id: 'gate' });
    await server.request('POST', '/v1/cameras/gate/samples', simulate(2).csv, 'text/csv');
    await server.train('gate', { recipe: 'projective', epochs: 10 });
    await page.goto(`${server.url}/#/cameras/gate/training`);
    const advice = page.getByRole('listitem').filter({ hasText: 'on another day' });
    await expect(advice).toBeVisible();
    expect(await advice.evaluate((item) => item.closest('[lang]')!.getAttribute('lang'))).toBe('en');
    expect(await page.evaluate(() => document.documentElement.lang)).toBe('de');
  });
});

test('a run is cancelled, and the next may start', async ({ console: page, server }) => {
  await server.request('POST', '/v1/cameras', { id: 'gate' });
  await server.request('POST', '/v1/cameras/gate/samples', simulate(2, [0, 0], 2000).csv, 'text/csv');
  await page.goto(`${server.url}/#/cameras/gate/training`);
  await page.getByLabel('Recipe').selectOption('hybrid');
  await page.getByRole('button', { name: 'Start training' }).click();
  const run = page.locator('section', { has: page.getByRole('heading', { name: 'Training run', exact: true }) });
  await run.getByRole('button', { name: 'Cancel' }).click();
  await expect(run.locator('.state')).toHaveText('cancelled');
  await expect(page.getByRole('button', { name: 'Start training' })).toBeEnabled();
});

test.describe('a disk that is full', () => {
  test.use({ disk: '32m', settings: { SIGHTFIX_LIMITS__RESERVE_BYTES: '0' }, allowed: /507/ });

  test('refuses the import, and takes it again once there is room', async ({ console: page, server }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate' });
    await page.goto(`${server.url}/#/cameras/gate/data`);
    await page.locator('input[type=file]').setInputFiles({ name: 'walk.csv', mimeType: 'text/csv', buffer: Buffer.from(simulate(2, [0, 0], 3000).csv) });
    server.fillDisk();
    await page.getByRole('button', { name: 'Import', exact: true }).click();
    await expect(page.getByRole('alert')).toContainText(/disk|space/);
    // What was chosen is still there.
    server.emptyDisk();
    await page.getByRole('button', { name: 'Import', exact: true }).click();
    await expect(page.getByText('0 rows rejected')).toBeVisible();
    expect((await server.request<{ count: number }>('GET', '/v1/cameras/gate/samples/count')).count).toBe(3000);
  });
});

test.describe('a camera that holds all that it may', () => {
  test.use({ settings: { SIGHTFIX_LIMITS__SAMPLES_PER_CAMERA: '100' }, allowed: /507/ });

  test('refuses the import, and names the limit', async ({ console: page, server }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate' });
    await page.goto(`${server.url}/#/cameras/gate/data`);
    await page.locator('input[type=file]').setInputFiles({ name: 'many.csv', mimeType: 'text/csv', buffer: Buffer.from(simulate(2).csv) });
    await page.getByRole('button', { name: 'Import', exact: true }).click();
    await expect(page.getByRole('alert')).toContainText('limits.samples_per_camera');
  });
});

test.describe('a server with keys', () => {
  test.use({ allowed: /status of 40[13]/ });

  test('the first key closes it; sign-in, roles and revocation reach the page', async ({ console: page, server }) => {
    await page.goto(`${server.url}/#/settings/keys`);
    await expect(page.getByText('No key exists yet')).toBeVisible();
    const createKey = async (name: string, role?: string): Promise<string> => {
      await page.locator('main').getByLabel('Name').fill(name);
      if (role) await page.getByLabel('Role').selectOption(role);
      await page.getByRole('button', { name: 'Create key' }).click();
      await expect(page.getByRole('cell', { name, exact: true })).toBeVisible();
      return (await page.locator('.notice.good pre').textContent())!;
    };
    const admin = await createKey('first');
    expect(admin).toMatch(/^sf_[0-9A-Za-z]{36}$/);
    await expect(page.getByText('Signed in as first (admin)')).toBeVisible();
    const viewer = await createKey('guest', 'viewer');
    expect(viewer).not.toBe(admin);

    await page.getByRole('button', { name: 'Sign out' }).click();
    const signIn = page.getByRole('dialog', { name: 'Sign in to sightfix' });
    await signIn.getByLabel('Key').fill(`${viewer.slice(0, -1)}${viewer.endsWith('0') ? '1' : '0'}`);
    await signIn.getByRole('button', { name: 'Sign in' }).click();
    await expect(signIn.getByRole('alert')).toBeVisible();
    await signIn.getByLabel('Key').fill(viewer);
    await signIn.getByRole('button', { name: 'Sign in' }).click();
    await expect(signIn).toBeHidden();

    // A viewer may look, and is told what it may not.
    await page.goto(`${server.url}/#/cameras`);
    await page.getByRole('button', { name: 'Add camera' }).first().click();
    const dialog = page.getByRole('dialog', { name: 'Add camera' });
    await dialog.getByRole('button', { name: /^A file/ }).click();
    await dialog.getByLabel('Name').fill('Gate');
    await dialog.getByRole('button', { name: 'Create camera' }).click();
    await expect(dialog.getByRole('alert')).toContainText(/viewer|role/);
    await dialog.getByRole('button', { name: 'Cancel' }).click();

    const bearer = { authorization: `Bearer ${admin}` };
    const { items } = await server.request<{ items: { id: string; name: string }[] }>('GET', '/v1/keys', undefined, '', bearer);
    await server.request('DELETE', `/v1/keys/${items.find(({ name }) => name === 'guest')!.id}`, undefined, '', bearer);
    await expect(signIn).toBeVisible();
  });
});

test.describe('two operators', () => {
  test.use({ allowed: /412/ });

  test('somebody else has changed the profile', async ({ console: page, server }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate', display_name: 'Gate' });
    await page.goto(`${server.url}/#/cameras/gate/profile`);
    await expect(page.getByLabel('Name', { exact: true })).toHaveValue('Gate');
    await server.request('PATCH', '/v1/cameras/gate', { display_name: 'Other' }, 'application/json', { 'if-match': '*' });
    await page.getByLabel('Name', { exact: true }).fill('Mine');
    await page.getByRole('button', { name: 'Save' }).click();
    await expect(page.getByRole('alert')).toContainText('Somebody else has changed the profile');
    await page.getByRole('button', { name: 'Read again' }).click();
    await expect(page.getByLabel('Name', { exact: true })).toHaveValue('Other');
    await page.getByLabel('Type gate to confirm').fill('gate');
    await page.getByRole('button', { name: 'Delete camera' }).click();
    await expect(page.getByText('No camera yet')).toBeVisible();
  });
});

test.describe('the phone page', () => {
  test.use({ permissions: ['geolocation'], geolocation: { longitude: 11.0, latitude: 48.0, accuracy: 5 }, allowed: /ERR_INTERNET_DISCONNECTED/ });

  test('queues positions without a network and sends them with one', async ({ console: page, server, context }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate' });
    await page.goto(`${server.url}/walk#camera=gate&receiver=phone-7`);
    await page.getByRole('button', { name: 'Start recording' }).click();
    const sent = page.locator('dl div', { hasText: 'Sent' }).locator('dd');
    const waiting = page.locator('dl div', { hasText: 'Waiting' }).locator('dd');
    await expect(sent).toHaveText('1');
    await context.setOffline(true);
    await context.setGeolocation({ longitude: 11.0001, latitude: 48.0001, accuracy: 5 });
    await expect(waiting).toHaveText('1');
    await expect(page.getByText('positions wait on this phone')).toBeVisible();
    await context.setOffline(false);
    await expect(waiting).toHaveText('0');
    await expect(sent).toHaveText('2');
    const tracks = await server.request<{ features: { properties: { target_id: string } }[] }>('GET', '/v1/cameras/gate/tracks');
    expect(tracks.features.map((feature) => feature.properties.target_id)).toEqual(['phone-7']);
    const downloading = page.waitForEvent('download');
    await page.getByRole('button', { name: 'Save as CSV' }).click();
    expect(rowsOf(readFileSync(await (await downloading).path(), 'utf8'))).toHaveLength(2);
  });

  test('its positions become samples with the boxes that the camera sends', async ({ console: page, server, context }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate', receivers: [{ receiver_id: 'phone-7', target_id: 'walker' }] });
    await page.goto(`${server.url}/walk#camera=gate&receiver=phone-7`);
    let left_px = 100;
    const sending: Promise<unknown>[] = [];
    const camera = setInterval(() => {
      left_px += 1;
      const box = { time: new Date().toISOString(), target_id: 'walker', bounding_box: { left_px, top_px: 20, width_px: 30, height_px: 60 } };
      sending.push(server.request('POST', '/v1/cameras/gate/tracks?store_samples=true', box));
    }, 200);
    await page.getByRole('button', { name: 'Start recording' }).click();
    await expect(page.locator('dl div', { hasText: 'Latest position' }).locator('dd')).not.toHaveText('–');
    // The browser's first position is from before the camera sent anything.
    await context.setGeolocation({ longitude: 11.0001, latitude: 48.0001, accuracy: 5 });
    await expect(page.locator('dl div', { hasText: 'In samples' }).locator('dd')).toHaveText('1');
    clearInterval(camera);
    await Promise.all(sending);
    const samples = await server.request<{ items: { target_id: string; fix: { longitude_deg: number } }[] }>('GET', '/v1/cameras/gate/samples');
    expect(samples.items.map(({ target_id, fix }) => [target_id, fix.longitude_deg])).toEqual([['walker', 11.0001]]);
  });
});

test.describe('a part of the page is gone', () => {
  test.use({ allowed: /Failed to (load resource|fetch dynamically)|uncaught|Unable to preload/ });

  test('after an upgrade the page loads itself again, and shows the view', async ({ console: page, server }) => {
    await server.request('POST', '/v1/cameras', { id: 'gate' });
    let loads = 0;
    page.on('request', (request) => (loads += request.isNavigationRequest() ? 1 : 0));
    // The files of the page that is open are those of the release before.
    await page.route('**/assets/Camera-*', (route) => (loads === 0 ? route.fulfill({ status: 404 }) : route.fallback()));
    await page.evaluate(() => (location.hash = '#/cameras/gate/data'));
    await expect(page.getByRole('heading', { name: 'Recording guide' })).toBeVisible();
    expect(loads).toBe(1);
  });
});
