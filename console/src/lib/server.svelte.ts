// What the server says of itself; read once.
import { get } from './api';
import type { ServerInfo } from './types';

class Server {
  info = $state.raw<ServerInfo>();
  #loading: Promise<void> | undefined;

  /** Never fails: without an answer the console goes on without tiles. */
  load(): Promise<void> {
    this.#loading ??= get<ServerInfo>('/v1/server').then(
      (info) => {
        this.info = info;
      },
      () => {
        this.#loading = undefined;
      },
    );
    return this.#loading;
  }
}

export const server = new Server();
