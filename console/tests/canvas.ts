// What a canvas of the page shows.
import type { Locator } from '@playwright/test';

/** The number of pixels that are painted more than faintly. */
export function paintedPixels(canvas: Locator): Promise<number> {
  return canvas.evaluate((element) => {
    const { width, height } = element as HTMLCanvasElement;
    const { data } = (element as HTMLCanvasElement).getContext('2d')!.getImageData(0, 0, width, height);
    let count = 0;
    for (let at = 3; at < data.length; at += 4) if (data[at]! > 80) count += 1;
    return count;
  });
}
