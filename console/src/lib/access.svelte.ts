// Access: if this server asks for a key, and what the signed-in caller may do.
import { get } from './api';
import type { Session } from './types';

class Access {
  needsKey = $state(false);

  load(): void {
    void this.#session().then((session) => (this.needsKey = session?.open_access === false));
  }

  /** Viewers read; everybody else may also send what cameras measure. */
  async mayIngest(): Promise<boolean> {
    const session = await this.#session();
    return !!session && session.role !== 'viewer';
  }

  #session(): Promise<Session | undefined> {
    return get<Session>('/v1/session').catch(() => undefined);
  }
}

export const access = new Access();
