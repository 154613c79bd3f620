// Applications of phones that send their position, and what is set in each (docs/howto/integrations.md, "Receivers: phones").
import { getAll, post } from './api';
import { t } from './i18n.svelte';
import { slugOf } from './slug';
import type { TextKey } from './texts';
import type { Connection } from './types';

/** The settings by which a phone reaches the server. */
export interface PhoneAccess {
  /** Where messages are posted. */
  url: string;
  /** Empty on a server without keys. */
  key: string;
  receiver: string;
}

export interface PhoneApplication {
  key: string;
  /** Proper names are the same in every language. */
  name: string;
  settings: (access: PhoneAccess) => [TextKey, string][];
}

/** For applications that cannot set headers. */
const withKey = ({ url, key }: PhoneAccess): string => (key ? `${url}/${key}` : url);
const signIn = ({ key, receiver }: PhoneAccess): [TextKey, string][] => (key ? [['phone.user', receiver], ['phone.password', key]] : []);

/** The body of a rest_command: a template with the attributes of the companion's device tracker. */
function homeAssistantBody(receiver: string): string {
  const entity = `device_tracker.${slugOf(receiver).replaceAll('-', '_')}`;
  const attribute = (name: string): string => `{{ state_attr('${entity}', '${name}') }}`;
  return `{"type": "update_location", "data": {"gps": [${attribute('latitude')}, ${attribute('longitude')}], "gps_accuracy": ${attribute('gps_accuracy')}}}`;
}

export const PHONE_APPLICATIONS: PhoneApplication[] = [
  { key: 'owntracks', name: 'OwnTracks', settings: (it) => [['phone.mode', 'HTTP'], ['phone.url', it.url], ...signIn(it), ['phone.device', it.receiver]] },
  { key: 'traccar', name: 'Traccar Client', settings: (it) => [['phone.url', withKey(it)], ['phone.device', it.receiver]] },
  { key: 'gpslogger', name: 'GPSLogger', settings: (it) => [['phone.url', `${it.url}?lat=%LAT&lon=%LON&timestamp=%TIMESTAMP&accuracy=%ACC&id=${encodeURIComponent(it.receiver)}`], ['phone.method', 'POST'], ...signIn(it)] },
  { key: 'overland', name: 'Overland', settings: (it) => [['phone.url', it.url], ...(it.key ? ([['phone.token', it.key]] as [TextKey, string][]) : []), ['phone.device', it.receiver]] },
  { key: 'sensorlogger', name: 'Sensor Logger', settings: (it) => [['phone.url', withKey(it)], ['phone.sensor', 'Location']] },
  {
    key: 'homeassistant',
    name: 'Home Assistant',
    settings: (it) => [['phone.url', withKey(it)], ['phone.method', 'POST'], ['phone.body', homeAssistantBody(it.receiver)]],
  },
];

export const phoneConnectionId = (camera: string): string => slugOf(`phones ${camera}`);

/** The connection that takes what phones of a camera send, made if it is missing. */
export async function ensurePhoneConnection(camera: string): Promise<string> {
  const id = phoneConnectionId(camera);
  const known = await getAll<Connection>('/v1/connections', 1000);
  // Messages that name no receiver are of the one that the key is named after.
  const source = { address: 'push:', format: 'phone', camera_ids: [camera], receiver_from: 'sender', store_samples: true };
  if (!known.some((it) => it.id === id)) await post('/v1/connections', { id, display_name: `${t('connections.kind.phone')}: ${camera}`, source });
  return `${location.origin}/v1/connections/${id}/messages`;
}
