// Still images behind the image planes. They stay in this browser.
const DATABASE = 'sightfix';
const STORE = 'stills';

function open(): Promise<IDBDatabase> {
  return new Promise((resolve, reject) => {
    const request = indexedDB.open(DATABASE, 1);
    request.onupgradeneeded = () => request.result.createObjectStore(STORE);
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

function done<T>(request: IDBRequest<T>): Promise<T> {
  return new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

class Stills {
  images = $state.raw<Record<string, ImageBitmap>>({});

  async load(camera: string): Promise<void> {
    if (this.images[camera]) return;
    const database = await open();
    const blob = await done<Blob | undefined>(database.transaction(STORE).objectStore(STORE).get(camera));
    if (blob) this.images = { ...this.images, [camera]: await createImageBitmap(blob) };
  }

  async set(camera: string, file: Blob): Promise<ImageBitmap> {
    const image = await createImageBitmap(file);
    const database = await open();
    await done(database.transaction(STORE, 'readwrite').objectStore(STORE).put(file, camera));
    this.images = { ...this.images, [camera]: image };
    return image;
  }

  async remove(camera: string): Promise<void> {
    const database = await open();
    await done(database.transaction(STORE, 'readwrite').objectStore(STORE).delete(camera));
    const { [camera]: _, ...others } = this.images;
    this.images = others;
  }
}

export const stills = new Stills();
