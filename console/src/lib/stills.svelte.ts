// Pictures of what cameras see, which the server keeps: boxes are drawn on them.
import { blob, cameraPath, del, fetchFile, putFile } from './api';

/** Longer side of a picture that is sent: enough to see who stands where. */
const LONGEST_SIDE_PX = 1920;
const JPEG_QUALITY = 0.85;

class Stills {
  images = $state.raw<Record<string, ImageBitmap>>({});

  async load(camera: string): Promise<void> {
    const picture = await blob(cameraPath(camera, 'picture'));
    if (picture) this.#show(camera, await createImageBitmap(picture));
  }

  /** Has the server fetch a new picture from the camera's snapshot address. */
  async fetch(camera: string): Promise<void> {
    this.#show(camera, await createImageBitmap(await fetchFile(cameraPath(camera, 'picture'))));
  }

  /** Sends any image that the browser can read, as a JPEG within the server's limit. */
  async set(camera: string, file: Blob): Promise<void> {
    const image = await createImageBitmap(file);
    const scale = Math.min(1, LONGEST_SIDE_PX / Math.max(image.width, image.height));
    const canvas = new OffscreenCanvas(Math.round(image.width * scale), Math.round(image.height * scale));
    canvas.getContext('2d')!.drawImage(image, 0, 0, canvas.width, canvas.height);
    await putFile(cameraPath(camera, 'picture'), await canvas.convertToBlob({ type: 'image/jpeg', quality: JPEG_QUALITY }));
    this.#show(camera, image);
  }

  async remove(camera: string): Promise<void> {
    await del(cameraPath(camera, 'picture'));
    const { [camera]: _, ...others } = this.images;
    this.images = others;
  }

  #show(camera: string, image: ImageBitmap): void {
    this.images = { ...this.images, [camera]: image };
  }
}

export const stills = new Stills();
