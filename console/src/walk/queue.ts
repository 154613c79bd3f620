// Fixes that wait for the server, in IndexedDB: they survive a dead spot, a reload and an empty battery.

export interface QueuedFix {
  id?: number;
  time: string;
  longitude_deg: number;
  latitude_deg: number;
  sigma_m?: number;
  sent: boolean;
}

const DATABASE = 'sightfix-walk';
const STORE = 'fixes';

function done<T>(request: IDBRequest<T>): Promise<T> {
  return new Promise((resolve, reject) => {
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

export class FixQueue {
  readonly #database: IDBDatabase;

  private constructor(database: IDBDatabase) {
    this.#database = database;
  }

  static open(): Promise<FixQueue> {
    return new Promise((resolve, reject) => {
      const request = indexedDB.open(DATABASE, 1);
      request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: 'id', autoIncrement: true });
      request.onsuccess = () => resolve(new FixQueue(request.result));
      request.onerror = () => reject(request.error);
    });
  }

  #store(mode: IDBTransactionMode): IDBObjectStore {
    return this.#database.transaction(STORE, mode).objectStore(STORE);
  }

  async add(fix: QueuedFix): Promise<void> {
    await done(this.#store('readwrite').add(fix));
  }

  all(): Promise<QueuedFix[]> {
    return done<QueuedFix[]>(this.#store('readonly').getAll());
  }

  /** The oldest that were not sent. */
  async waiting(most: number): Promise<QueuedFix[]> {
    return (await this.all()).filter((fix) => !fix.sent).slice(0, most);
  }

  async markSent(fixes: QueuedFix[]): Promise<void> {
    const store = this.#store('readwrite');
    await Promise.all(fixes.map((fix) => done(store.put({ ...fix, sent: true }))));
  }

  async clear(): Promise<void> {
    await done(this.#store('readwrite').clear());
  }
}

/** The walk in the columns that the importer of fixes documents. */
export function walkCsv(receiver: string, fixes: QueuedFix[]): string {
  const lines = fixes.map((fix) => [fix.time, receiver, fix.longitude_deg.toFixed(8), fix.latitude_deg.toFixed(8), fix.sigma_m?.toFixed(3) ?? ''].join(','));
  return ['time,receiver_id,longitude,latitude,sigma_m', ...lines].join('\n') + '\n';
}

/** A browser states the radius that holds 68 % of positions in the plane: 1.515 standard deviations per axis. */
export function sigmaOf(radius68_m: number): number {
  return radius68_m / Math.sqrt(-2 * Math.log(1 - 0.68));
}
