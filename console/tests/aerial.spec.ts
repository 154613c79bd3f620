// An aerial image of the user's own under the map: from a file that says where it lies, or by its corners.
import { writeArrayBuffer } from 'geotiff';
import type { Page } from '@playwright/test';
import type { Corners } from '../src/lib/georeference';
import { accessibilityFindings, expect, test } from './fixtures';

const [WIDTH, HEIGHT] = [40, 20];
const IMAGE = '.leaflet-overlay-pane img.aerial';

async function drop(page: Page, files: { name: string; mimeType: string; buffer: Buffer }[]): Promise<void> {
  await page.getByRole('button', { name: 'Aerial image' }).click();
  await page.getByRole('dialog').locator('input[type=file]').setInputFiles(files);
  await expect(page.getByRole('dialog')).toBeHidden();
  await expect(page.locator(IMAGE)).toBeAttached();
}

async function png(page: Page): Promise<Buffer> {
  const url = await page.evaluate(
    ([width, height]) => {
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [width!, height!];
      canvas.getContext('2d')!.fillRect(0, 0, width!, height!);
      return canvas.toDataURL('image/png');
    },
    [WIDTH, HEIGHT],
  );
  return Buffer.from(url.split(',')[1]!, 'base64');
}

/** The corners that the browser keeps. */
function kept(page: Page): Promise<Corners> {
  return page.evaluate(
    () =>
      new Promise<Corners>((done) => {
        const opening = indexedDB.open('sightfix');
        opening.onsuccess = () => {
          const reading = opening.result.transaction('aerial').objectStore('aerial').get('image');
          reading.onsuccess = () => done((reading.result as { corners: Corners }).corners);
        };
      }),
  );
}

test('an image without a place is dragged into it by its corners, and stays there', async ({ console: page }) => {
  await drop(page, [{ name: 'roof.png', mimeType: 'image/png', buffer: await png(page) }]);
  const image = page.locator(IMAGE);
  const before = (await image.boundingBox())!;
  expect(before.width / before.height).toBeCloseTo(WIDTH / HEIGHT, 1);
  expect(await accessibilityFindings(page)).toEqual([]);
  const handle = page.getByRole('button', { name: 'Upper left corner of the image' });
  await handle.hover();
  await page.mouse.down();
  await page.mouse.move(before.x - 60, before.y - 40, { steps: 5 });
  await page.mouse.up();
  await expect.poll(async () => (await image.boundingBox())!.x).toBeLessThan(before.x - 50);
  const after = (await image.boundingBox())!;
  expect(after.y).toBeLessThan(before.y - 30);
  // The opposite corner has not moved.
  expect(after.x + after.width).toBeCloseTo(before.x + before.width, 0);
  await page.getByRole('button', { name: 'The image lies right' }).click();
  await expect(handle).toBeHidden();
  const corners = await kept(page);

  await page.reload();
  await expect(image).toBeVisible();
  expect(await kept(page)).toEqual(corners);
  await page.getByRole('button', { name: 'Aerial image' }).click();
  await page.getByRole('dialog').getByRole('button', { name: 'Remove' }).click();
  await expect(image).toBeHidden();
});

test('a world file and a georeferenced TIFF say where an image lies', async ({ console: page }) => {
  // The middle of the upper left pixel, and 0.00001 degrees per pixel.
  const world = '0.00001\n0\n0\n-0.00001\n24.745005\n59.437995\n';
  await drop(page, [
    { name: 'roof.png', mimeType: 'image/png', buffer: await png(page) },
    { name: 'roof.pgw', mimeType: 'text/plain', buffer: Buffer.from(world) },
  ]);
  const [upperLeft, , lowerRight] = await kept(page);
  expect(upperLeft.longitude_deg).toBeCloseTo(24.745, 9);
  expect(upperLeft.latitude_deg).toBeCloseTo(59.438, 9);
  expect(lowerRight.longitude_deg).toBeCloseTo(24.745 + WIDTH * 0.00001, 9);
  expect(lowerRight.latitude_deg).toBeCloseTo(59.438 - HEIGHT * 0.00001, 9);

  const tiff = await writeArrayBuffer(new Uint8Array(3 * WIDTH * HEIGHT).fill(90), {
    width: WIDTH,
    height: HEIGHT,
    SamplesPerPixel: 3,
    BitsPerSample: [8, 8, 8],
    PhotometricInterpretation: 2,
    ModelPixelScale: [0.00002, 0.00001, 0],
    ModelTiepoint: [0, 0, 0, 11.5, 48.1, 0],
    GeographicTypeGeoKey: 4326,
    GTModelTypeGeoKey: 2,
  });
  await drop(page, [{ name: 'yard.tif', mimeType: 'image/tiff', buffer: Buffer.from(tiff as ArrayBuffer) }]);
  const [first, , last] = await kept(page);
  expect(first).toEqual({ longitude_deg: 11.5, latitude_deg: 48.1 });
  expect(last.longitude_deg).toBeCloseTo(11.5 + WIDTH * 0.00002, 9);
  expect(last.latitude_deg).toBeCloseTo(48.1 - HEIGHT * 0.00001, 9);

  // Half a metre per pixel in zone 35 of UTM. PROJ converts the corner: gdaltransform -s_srs EPSG:32635 -t_srs EPSG:4326.
  const utm = await writeArrayBuffer(new Uint8Array(3 * WIDTH * HEIGHT).fill(90), {
    width: WIDTH,
    height: HEIGHT,
    SamplesPerPixel: 3,
    BitsPerSample: [8, 8, 8],
    PhotometricInterpretation: 2,
    ModelPixelScale: [0.5, 0.5, 0],
    ModelTiepoint: [0, 0, 0, 372_000, 6_590_000, 0],
    ProjectedCSTypeGeoKey: 32635,
    GTModelTypeGeoKey: 1,
  });
  await drop(page, [{ name: 'harbour.tif', mimeType: 'image/tiff', buffer: Buffer.from(utm as ArrayBuffer) }]);
  const [corner] = await kept(page);
  expect(corner.longitude_deg).toBeCloseTo(24.7436530128744, 8);
  expect(corner.latitude_deg).toBeCloseTo(59.429058724256, 8);
});
