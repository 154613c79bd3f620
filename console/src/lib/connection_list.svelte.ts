// The connections, read again while a view shows them.
import { getAll } from './api';
import { failureOf, type Failure } from './failure';
import type { Connection } from './types';

const MOST_CONNECTIONS = 1000;
const POLL_MS = 2000;

export class ConnectionList {
  /** Undefined until read. */
  items = $state.raw<Connection[]>();
  problem = $state.raw<Failure>();

  refresh = async (): Promise<void> => {
    try {
      this.items = await getAll<Connection>('/v1/connections', MOST_CONNECTIONS);
      this.problem = undefined;
    } catch (error) {
      this.problem = failureOf(error);
    }
  };

  /** Reads now and again and again until the returned function is called. */
  watch = (): (() => void) => {
    void this.refresh();
    const timer = setInterval(() => {
      if (!document.hidden) void this.refresh();
    }, POLL_MS);
    return () => clearInterval(timer);
  };
}
