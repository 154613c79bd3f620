// A site: cameras that track their targets together.
import { accessibilityFindings, expect, test } from './fixtures';
import { addCamera, simulate, walk } from './world';

test('two cameras of a site, named in their profiles, show one track per target', async ({ console: page, server }) => {
  const world = simulate(13, [0, 0], 300);
  await addCamera(server, 'north', 'North', world);
  await addCamera(server, 'south', 'South', world);
  for (const camera of ['north', 'south']) {
    await page.goto(`${server.url}/#/cameras/${camera}/profile`);
    await page.getByLabel(/^Site/).fill('plaza');
    await page.getByRole('button', { name: 'Save' }).click();
    await expect(page.getByText('revision 2')).toBeVisible();
  }
  expect((await server.request<{ cameras: number }>('GET', '/v1/sites/plaza')).cameras).toBe(2);

  await page.getByRole('link', { name: 'Site plaza' }).click();
  await expect(page.getByText('No target is tracked on this site now.')).toBeVisible();
  await expect(page.getByRole('status').getByText('Live')).toBeVisible();
  // Both see the same two people.
  const stops = ['north', 'south'].map((camera) => walk(server, camera, world.live));
  const targets = page.locator('.targets tbody tr');
  await expect(targets.filter({ hasText: 'north, south' }).first()).toBeVisible({ timeout: 60_000 });
  expect(await targets.count()).toBeLessThan(4);
  // One of them in detail.
  await targets.filter({ hasText: 'north, south' }).first().getByRole('button').click();
  const details = page.getByRole('region', { name: /^Details of/ });
  await expect(details.getByRole('link')).toHaveText(['north', 'south']);
  await expect(details.getByText(/^\d+\.\d{7}, \d+\.\d{7}$/)).toBeVisible();
  await expect(details).toContainText(/Way that is shown[\d.,]+ m, \d+ points/);
  // The tracks are drawn in the colour of what is fused.
  const drawn = await page.locator('.plane-canvas').evaluate((element) => {
    const canvas = element as HTMLCanvasElement;
    const hex = getComputedStyle(document.documentElement).getPropertyValue('--fused').trim();
    const color = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
    const { data } = canvas.getContext('2d')!.getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let at = 0; at < data.length; at += 4) if (data[at + 3]! > 200 && color.every((value, channel) => Math.abs(value - data[at + channel]!) < 12)) count += 1;
    return count;
  });
  expect(drawn).toBeGreaterThan(20);
  expect(await accessibilityFindings(page)).toEqual([]);
  await page.goto(`${server.url}/#/cameras/north/live`);
  await page.getByRole('button', { name: 'person-1' }).click();
  await expect(details).toContainText(/Receiverperson-1/);
  await expect(details.getByRole('link')).toHaveText(['north']);
  stops.forEach((stop) => stop());
  await page.goto(`${server.url}/#/cameras`);
  await expect(page.getByRole('link', { name: 'plaza', exact: true })).toBeVisible();
});

test('clocks that are wrong are told with what to do', async ({ console: page, server }) => {
  await server.request('POST', '/v1/sites', { id: 'yard' });
  let clocks: object = { receiver_clocks: [{ receiver_id: 'phone-7', offset_s: 1.52, sigma_s: 0.1, is_wrong: true }] };
  await page.route('**/v1/sites/yard/tracks', async (route) => {
    const response = await route.fetch();
    await route.fulfill({ response, json: { ...((await response.json()) as object), ...clocks } });
  });
  await page.goto(`${server.url}/#/sites/yard`);
  const alert = page.getByRole('alert');
  await expect(alert).toContainText('The clock of the receiver phone-7 is ahead by 1.5 s.');
  // Where most receivers agree, the cameras are wrong, not they.
  clocks = { ...clocks, common_receiver_clock: { offset_s: 1.5, sigma_s: 0.1, is_wrong: true } };
  await expect(alert).toHaveText(/^The times of all cameras are 1.5 s earlier than those of the receivers/, { timeout: 20_000 });
});
