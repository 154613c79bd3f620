// Events at the places of a site or a camera, newest first.
import { get } from './api';
import { listen } from './events';
import { failureOf, type Failure } from './failure';
import { FLASH_MS, type Flash } from './place_draw';
import { scopedPath, type Scope } from './scope';
import type { EventKind, PlaceEvent } from './types';

/** Events that are kept and listed. */
const MOST_EVENTS = 500;
const PAGE_ITEMS = 1000;
/** Pages that are read for the newest events; a server with more shows those from now on. */
const MOST_PAGES = 20;
interface EventPage {
  items: PlaceEvent[];
  last_event_id?: string;
  has_more: boolean;
}

export interface EventFilter {
  place?: string;
  kind?: EventKind | '';
}

export class PlaceEvents {
  items = $state.raw<PlaceEvent[]>([]);
  /** Those that came while this page was listening, in the last seconds. */
  flashes = $state.raw<Flash[]>([]);
  isOpen = $state(false);
  wasOpen = $state(false);
  /** True if the stored events are too many to read for the newest. */
  isLate = $state(false);
  error = $state.raw<Failure>();
  #stop = (): void => {};
  #sweep: ReturnType<typeof setInterval> | undefined;
  #isClosed = false;

  constructor(scope: Scope, { place, kind }: EventFilter = {}) {
    const path = (end: string, values: Record<string, string | undefined> = {}): string => scopedPath(`/v1/place-events${end}`, scope, { place, kind, ...values });
    void this.#begin(path);
  }

  close(): void {
    this.#isClosed = true;
    this.#stop();
    clearInterval(this.#sweep);
  }

  async #begin(path: (end: string, values?: Record<string, string | undefined>) => string): Promise<void> {
    let last: string | undefined;
    try {
      last = await this.#readStored((after) => path('', { after, limit: String(PAGE_ITEMS) }));
    } catch (error) {
      this.error = failureOf(error);
      return;
    }
    if (this.#isClosed) return;
    // From the last event that was read, so that none between is missed.
    this.#stop = listen(path('/stream', { last_event_id: last }), {
      on: { place_event: (data) => this.#take(data as PlaceEvent) },
      state: (isOpen) => {
        this.isOpen = isOpen;
        this.wasOpen ||= isOpen;
      },
    });
    this.#sweep = setInterval(() => this.#dim(), 500);
  }

  async #readStored(path: (after?: string) => string): Promise<string | undefined> {
    let after: string | undefined;
    for (let pages = 0; pages < MOST_PAGES && !this.#isClosed; pages++) {
      const page = await get<EventPage>(path(after));
      this.items = [...page.items.reverse(), ...this.items].slice(0, MOST_EVENTS);
      after = page.last_event_id;
      if (!page.has_more) return after ?? '0';
    }
    this.items = [];
    this.isLate = true;
    return undefined;
  }

  /** An event may be delivered again, under the same id. */
  #take(event: PlaceEvent): void {
    if (this.items.some(({ id }) => id === event.id)) return;
    this.items = [event, ...this.items].slice(0, MOST_EVENTS);
    this.flashes = [...this.flashes, { event, heardAt_ms: Date.now() }];
  }

  #dim(): void {
    if (this.flashes.length === 0) return;
    const oldest_ms = Date.now() - FLASH_MS;
    this.flashes = this.flashes.filter(({ heardAt_ms }) => heardAt_ms > oldest_ms);
  }
}
