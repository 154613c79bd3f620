// The systems that connections are made with: what each kind asks for, and its part of a request.
import type { TextKey } from './texts';
import type { Connection } from './types';

/** The fields of a form. */
export type Field = 'topics' | 'topic' | 'cameras' | 'camera_ids' | 'receiver_id' | 'store_samples' | 'username' | 'min_interval_s' | 'cot' | 'ca_certificate';
export type Secret = 'password' | 'signing_key' | 'authorization' | 'client_certificate' | 'client_key';

export interface Kind {
  key: string;
  text: TextKey;
  direction: 'source' | 'sink';
  format: string;
  /** Addresses that it may have; the first is proposed. */
  addresses: string[];
  fields: Field[];
}

const MQTT = 'mqtt://broker:1883';
const KAFKA = 'kafka://broker:9092';
const detector = (key: string, text: TextKey, addresses: string[]): Kind => ({ key, text, direction: 'source', format: key, addresses, fields: ['topics', 'cameras', 'store_samples', 'username', 'ca_certificate'] });
const receiver = (key: string, text: TextKey, addresses: string[], fields: Field[] = []): Kind => ({ key, text, direction: 'source', format: key, addresses, fields: ['topics', 'camera_ids', ...fields, 'store_samples', 'username', 'ca_certificate'] });
const sink = (key: string, text: TextKey, format: string, addresses: string[], fields: Field[]): Kind => ({ key, text, direction: 'sink', format, addresses, fields: ['camera_ids', ...fields, 'min_interval_s'] });

export const KINDS: Kind[] = [
  detector('frigate', 'connections.kind.frigate', [MQTT, 'push:']),
  detector('deepstream', 'connections.kind.deepstream', [MQTT, KAFKA, 'push:']),
  detector('onvif', 'connections.kind.onvif', ['rtsp://camera:554/', 'push:', MQTT]),
  receiver('nmea', 'connections.kind.nmea', ['tcp://receiver:4001', 'udp://0.0.0.0:10110', 'tcp-listen://0.0.0.0:10110', 'serial:///dev/ttyUSB0?baud=4800', MQTT], ['receiver_id']),
  receiver('gpsd', 'connections.kind.gpsd', ['gpsd://localhost:2947']),
  receiver('traccar', 'connections.kind.traccar', ['push:']),
  receiver('phone', 'connections.kind.phone', ['push:', MQTT]),
  sink('home-assistant', 'connections.kind.homeAssistant', 'home_assistant', [MQTT, 'mqtts://broker:8883'], ['topic', 'username', 'ca_certificate']),
  sink('mqtt', 'connections.kind.mqtt', 'json', [MQTT, 'mqtts://broker:8883'], ['topic', 'username', 'ca_certificate']),
  sink('kafka', 'connections.kind.kafka', 'json', [KAFKA, 'kafkas://broker:9093'], ['topic', 'username', 'ca_certificate']),
  sink('nats', 'connections.kind.nats', 'json', ['nats://localhost:4222', 'natss://nats.example.org:4222'], ['topic', 'username', 'ca_certificate']),
  sink('webhook', 'connections.kind.webhook', 'json', ['https://hooks.example.org/positions'], ['ca_certificate']),
  sink('cot', 'connections.kind.cot', 'cot', ['udp://239.2.3.1:6969', 'tcp://tak.example.org:8087', 'tls://tak.example.org:8089'], ['cot', 'ca_certificate']),
  sink('onvif-frames', 'connections.kind.onvifFrames', 'onvif', ['udp://239.2.3.1:6970', 'tcp://vms.example.org:6970', 'tls://vms.example.org:6971', MQTT], ['topic', 'username', 'ca_certificate']),
];

const schemeOf = (address: string): string => address.split(':')[0]!;
/** The name of a user, its password and an authority belong to addresses that have a peer to sign in at. */
const isEncrypted = (address: string): boolean => /^(mqtts|kafkas|natss|rtsps|tls|https)$/.test(schemeOf(address));
const isBroker = (address: string): boolean => /^(mqtts?|kafkas?|natss?)$/.test(schemeOf(address));
const hasUsers = (address: string): boolean => isBroker(address) || /^rtsps?$/.test(schemeOf(address));

/** Fields of a kind that an address leaves open. */
export function fieldsOf(kind: Kind, address: string): Field[] {
  return kind.fields.filter((field) => {
    if (field === 'topics' || field === 'topic') return isBroker(address);
    if (field === 'username') return hasUsers(address);
    return field === 'ca_certificate' ? isEncrypted(address) : true;
  });
}

/** Secrets that an address may need. */
export function secretsOf(kind: Kind, address: string): Secret[] {
  const scheme = schemeOf(address);
  return [
    ...(hasUsers(address) ? (['password'] as const) : []),
    ...(kind.direction === 'sink' && /^https?$/.test(scheme) ? (['signing_key', 'authorization'] as const) : []),
    ...(isEncrypted(address) ? (['client_certificate', 'client_key'] as const) : []),
  ];
}

/** The kind of a stored connection; one that this page does not know is shown by its format. */
export function kindOf({ source, sink: target }: Connection): Kind | undefined {
  if (source) return KINDS.find((kind) => kind.direction === 'source' && kind.format === source.format);
  if (!target) return undefined;
  const scheme = schemeOf(target.address);
  const sinks = KINDS.filter((kind) => kind.direction === 'sink' && kind.format === target.format);
  return sinks.find((kind) => kind.addresses.some((address) => schemeOf(address).replace(/s$/, '') === scheme.replace(/s$/, ''))) ?? (sinks.length === 1 ? sinks[0] : undefined);
}

/** The values of a form; texts are empty where nothing is given. */
export interface ConnectionForm {
  address: string;
  topics: string;
  topic: string;
  username: string;
  caCertificate: string;
  mappings: { name: string; camera_id: string; width_px: number | null; height_px: number | null }[];
  cameraIds: string[];
  receiverId: string;
  storeSamples: boolean;
  minInterval_s: number | null;
  stale_s: number | null;
  cotType: string;
  secrets: Record<Secret, string>;
}

export function emptyForm(kind: Kind): ConnectionForm {
  return {
    address: kind.addresses[0]!,
    topics: kind.key === 'frigate' ? 'frigate/events' : '',
    topic: '',
    username: '',
    caCertificate: '',
    mappings: [{ name: '', camera_id: '', width_px: null, height_px: null }],
    cameraIds: [],
    receiverId: '',
    storeSamples: kind.direction === 'source',
    minInterval_s: null,
    stale_s: null,
    cotType: '',
    secrets: { password: '', signing_key: '', authorization: '', client_certificate: '', client_key: '' },
  };
}

/** The settings of a request: what was left empty is left to the server. */
export function settingsOf(kind: Kind, form: ConnectionForm): Record<string, unknown> {
  const fields = fieldsOf(kind, form.address);
  const given = (field: Field, value: Record<string, unknown>): Record<string, unknown> =>
    fields.includes(field) ? Object.fromEntries(Object.entries(value).filter(([, it]) => it !== '' && it !== null && it !== undefined)) : {};
  return {
    address: form.address.trim(),
    format: kind.format,
    ...given('topics', { topics: form.topics.split(/[\s,]+/).filter(Boolean) }),
    ...given('topic', { topic: form.topic.trim() }),
    ...given('username', { username: form.username.trim() }),
    ...given('ca_certificate', { ca_certificate: form.caCertificate.trim() }),
    ...given('cameras', { cameras: mappingsOf(form) }),
    ...given('camera_ids', { camera_ids: form.cameraIds }),
    ...given('receiver_id', { receiver_id: form.receiverId.trim() }),
    ...given('store_samples', { store_samples: form.storeSamples }),
    ...given('min_interval_s', { min_interval_s: form.minInterval_s }),
    ...given('cot', { stale_s: form.stale_s, cot_type: form.cotType.trim() }),
  };
}

function mappingsOf({ mappings }: ConnectionForm): Record<string, object> {
  const given = mappings.filter(({ camera_id }) => camera_id);
  // A sender that is not named may be any.
  return Object.fromEntries(given.map(({ name, camera_id, width_px, height_px }) => [name.trim() || '*', { camera_id, ...(width_px && height_px ? { image_size: { width_px, height_px } } : {}) }]));
}

/** The secrets that were typed. */
export function typedSecrets(kind: Kind, form: ConnectionForm): Record<string, string> {
  return Object.fromEntries(secretsOf(kind, form.address).flatMap((name) => (form.secrets[name] ? [[name, form.secrets[name]]] : [])));
}
