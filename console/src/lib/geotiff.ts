// The picture and the place of a georeferenced TIFF.
import { fromBlob } from 'geotiff';
import type { Affine, ToPosition } from './georeference';
import { systemOf } from './projection';

/** Longer side of the picture that is shown. */
const LONGEST_SIDE_PX = 4096;

export interface PlacedPicture {
  picture: Blob;
  /** From the whole image to coordinates, with its size, and from those to positions; undefined if it is in another system or in none. */
  place?: { affine: Affine; width_px: number; height_px: number; toPosition: ToPosition };
}

export async function readGeoTiff(file: Blob): Promise<PlacedPicture> {
  const image = await (await fromBlob(file)).getImage();
  const [width_px, height_px] = [image.getWidth(), image.getHeight()];
  const scale = Math.min(1, LONGEST_SIDE_PX / Math.max(width_px, height_px));
  const [width, height] = [Math.round(width_px * scale), Math.round(height_px * scale)];
  const picture = await pictureOf(await image.readRGB({ width, height, interleave: true }), width, height);
  const keys = image.getGeoKeys();
  const toPosition = systemOf(Number(keys?.ProjectedCSTypeGeoKey ?? keys?.GeographicTypeGeoKey));
  const affine = affineOf(image);
  return affine && toPosition ? { picture, place: { affine, width_px, height_px, toPosition } } : { picture };
}

type Image = Awaited<ReturnType<Awaited<ReturnType<typeof fromBlob>>['getImage']>>;

function affineOf(image: Image): Affine | undefined {
  try {
    const [e, f] = image.getOrigin() as [number, number];
    const [a, d] = image.getResolution() as [number, number];
    return { a, b: 0, c: 0, d, e, f };
  } catch {
    // It has neither tie points nor a transformation.
    return undefined;
  }
}

async function pictureOf(rgb: ArrayLike<number>, width: number, height: number): Promise<Blob> {
  const pixels = new ImageData(width, height);
  for (let at = 0; at < width * height; at++) {
    for (let part = 0; part < 3; part++) pixels.data[4 * at + part] = rgb[3 * at + part]!;
    pixels.data[4 * at + 3] = 255;
  }
  const canvas = new OffscreenCanvas(width, height);
  canvas.getContext('2d')!.putImageData(pixels, 0, 0);
  return canvas.convertToBlob({ type: 'image/jpeg', quality: 0.9 });
}
