// The description that the server gives of itself; read once.
import { del, get } from './api';
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

  /** Stops the simulated devices and removes their cameras. */
  async endDemonstration(): Promise<void> {
    await del('/v1/demonstration');
    if (this.info) this.info = { ...this.info, demonstration: false };
  }
}

export const server = new Server();
