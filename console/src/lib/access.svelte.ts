// Whether this server asks for a key.
import { get } from './api';
import type { Session } from './types';

class Access {
  needsKey = $state(false);

  load(): void {
    void get<Session>('/v1/session').then(
      ({ open_access }) => (this.needsKey = !open_access),
      () => undefined,
    );
  }
}

export const access = new Access();
