// An aerial image of the user's own under the maps of this browser, which keeps it.
import { cornersOf, readWorldFile, type Corners } from './georeference';
import { t } from './i18n.svelte';

const DATABASE = 'sightfix';
const STORE = 'aerial';
const KEY = 'image';

interface Stored {
  picture: Blob;
  corners: Corners;
}

/** A picture to be placed, with its corners if a file states them. */
export interface AerialFile {
  picture: Blob;
  corners: Corners | undefined;
}

/** Reads a picture, a picture with its world file, or a georeferenced TIFF. */
export async function readAerial(files: File[]): Promise<AerialFile> {
  const picture = files.find((file) => /\.(png|jpe?g|webp|tiff?)$/i.test(file.name));
  if (!picture) throw new Error(t('aerial.none'));
  const worldFile = files.find((file) => /\.(wld|[a-z]{2,4}w)$/i.test(file.name));
  const stated = worldFile && readWorldFile(await worldFile.text());
  if (/\.tiff?$/i.test(picture.name)) {
    const { readGeoTiff } = await import('./geotiff');
    const { picture: shown, place } = await readGeoTiff(picture);
    return { picture: shown, corners: place && cornersOf(stated ?? place.affine, place.width_px, place.height_px, place.toPosition) };
  }
  if (!stated) return { picture, corners: undefined };
  const { guessedSystem } = await import('./projection');
  const { width, height } = await createImageBitmap(picture);
  return { picture, corners: cornersOf(stated, width, height, guessedSystem(stated.e, stated.f)) };
}

class Aerial {
  url = $state('');
  corners = $state.raw<Corners>();
  #picture: Blob | undefined;
  #loading: Promise<void> | undefined;

  /** Never fails: a browser that keeps nothing shows maps without an image. */
  load(): Promise<void> {
    this.#loading ??= inStore('readonly', (store) => store.get(KEY) as IDBRequest<Stored | undefined>).then(
      (stored) => stored && this.#show(stored),
      () => undefined,
    );
    return this.#loading;
  }

  async set(picture: Blob, corners: Corners): Promise<void> {
    this.#show({ picture, corners });
    await this.#keep();
  }

  /** Moves its corners; the place is kept once the hand has let go. */
  move(corners: Corners, isDone: boolean): void {
    this.corners = corners;
    if (isDone) void this.#keep().catch(() => undefined);
  }

  async remove(): Promise<void> {
    URL.revokeObjectURL(this.url);
    this.url = '';
    this.corners = undefined;
    this.#picture = undefined;
    await inStore('readwrite', (store) => store.delete(KEY));
  }

  #show({ picture, corners }: Stored): void {
    if (this.url) URL.revokeObjectURL(this.url);
    this.#picture = picture;
    this.corners = corners;
    this.url = URL.createObjectURL(picture);
  }

  async #keep(): Promise<void> {
    const stored: Stored = { picture: this.#picture!, corners: this.corners! };
    await inStore('readwrite', (store) => store.put(stored, KEY));
  }
}

async function inStore<T>(mode: IDBTransactionMode, action: (store: IDBObjectStore) => IDBRequest<T>): Promise<T> {
  const opening = indexedDB.open(DATABASE, 1);
  opening.onupgradeneeded = () => opening.result.createObjectStore(STORE);
  const database = await settled(opening);
  try {
    return await settled(action(database.transaction(STORE, mode).objectStore(STORE)));
  } finally {
    database.close();
  }
}

function settled<T>(request: IDBRequest<T>): Promise<T> {
  return new Promise((done, fail) => {
    request.onsuccess = () => done(request.result);
    request.onerror = () => fail(request.error ?? new Error('the browser keeps nothing'));
  });
}

export const aerial = new Aerial();
