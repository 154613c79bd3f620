// Server-sent events that come back after the server was gone.
import { connection } from './connection.svelte';

export interface EventHandlers {
  on: Record<string, (data: unknown) => void>;
  /** True if events can come now. */
  state: (isOpen: boolean) => void;
}

/** Listens until the returned function is called. */
export function listen(path: string, handlers: EventHandlers): () => void {
  let source: EventSource | undefined;
  let timer: ReturnType<typeof setTimeout> | undefined;
  let pause_ms = 500;
  let lastEventId = '';
  let closed = false;

  function open(): void {
    // After the last event that was seen: a new source does not send its id by itself.
    const url = new URL(path, location.origin);
    if (lastEventId) url.searchParams.set('last_event_id', lastEventId);
    source = new EventSource(url);
    source.onopen = () => {
      pause_ms = 500;
      connection.regain();
      handlers.state(true);
    };
    source.onerror = () => {
      // The browser's own pause and its end after a refusal are both too coarse for an operator.
      source?.close();
      if (closed) return;
      handlers.state(false);
      timer = setTimeout(open, pause_ms);
      pause_ms = Math.min(pause_ms * 2, 8000);
    };
    for (const [name, handle] of Object.entries(handlers.on)) {
      source.addEventListener(name, (event) => {
        const message = event as MessageEvent<string>;
        lastEventId = message.lastEventId || lastEventId;
        handle(JSON.parse(message.data));
      });
    }
  }

  open();
  return () => {
    closed = true;
    clearTimeout(timer);
    source?.close();
  };
}
