// Two thousand cameras.
import { expect, test } from './fixtures';

const CAMERAS = 2000;

test('two thousand cameras are listed, scrolled, searched and filtered with few elements', async ({ console: page, server }) => {
  for (let from = 0; from < CAMERAS; from += 50) {
    const batch = Array.from({ length: 50 }, (_, at) => from + at);
    await Promise.all(batch.map((n) => server.request('POST', '/v1/cameras', { id: `camera-${n}`, display_name: `Camera ${String(n).padStart(4, '0')}`, labels: { site: `s${n % 7}` } })));
  }
  await page.reload();
  await expect(page.getByRole('heading', { name: 'Cameras 2,000' })).toBeVisible();
  const rows = page.getByRole('list', { name: 'Cameras' }).getByRole('listitem');
  await expect(rows.first()).toBeVisible();
  expect(await rows.count()).toBeLessThan(60);

  const list = page.getByRole('list', { name: 'Cameras' });
  await list.hover();
  for (let turn = 0; turn < 10; turn++) {
    await page.mouse.wheel(0, 4000);
    // Wherever the wheel stops, the view is filled: no gap above or below.
    await expect
      .poll(() =>
        list.evaluate((viewport) => {
          const area = viewport.getBoundingClientRect();
          const items = [...viewport.querySelectorAll('[role=listitem]')].map((item) => item.getBoundingClientRect());
          return items.some((it) => it.top <= area.top + 1) && items.some((it) => it.bottom >= area.bottom - 1);
        }),
      )
      .toBe(true);
  }
  await list.evaluate((viewport) => (viewport.scrollTop = viewport.scrollHeight));
  await expect(page.getByText('Camera 1999')).toBeVisible();
  await page.getByRole('searchbox').fill('1234');
  await expect(rows).toHaveCount(1);
  await page.getByRole('searchbox').fill('');
  await page.getByLabel('Filter by label').selectOption('site=s3');
  await expect(page.getByText('Camera 0003')).toBeVisible();
  await expect(page.getByText('Camera 0004')).toBeHidden();
});
