// Where the boxes of a new camera come from: what each source asks for, and its parts of the requests.
import type { JsonMapping } from './json_mapping';
import { slugOf } from './slug';
import type { TextKey } from './texts';

export interface BoxSource {
  key: string;
  text: TextKey;
  help: TextKey;
  /** Addresses that its connection may have, the first is proposed; none where no connection is made. */
  addresses: string[];
  format?: string;
  /** Topics that are proposed. */
  topics?: string;
  /** True if its boxes are shares of the image, which need the image's size. */
  needsSize?: boolean;
  mapping?: JsonMapping;
}

const MQTT = 'mqtt://broker:1883';
/** A camera's stream; the other is that of an Axis camera. */
const RTSP = ['rtsp://camera:554/', 'rtsp://camera/axis-media/media.amp?camera=1&audio=0&video=0&analytics=polygon'];

/** AXIS scene metadata, the topic axis.scene.frame_v1. */
const AXIS: JsonMapping = {
  items: '/detections',
  time: '/timestamp',
  target: '/object_track_id',
  class: '/class/type',
  score: '/class/score',
  bounding_box: { form: 'corners', unit: 'share', sides: ['/bounding_box/left', '/bounding_box/top', '/bounding_box/right', '/bounding_box/bottom'] },
};

export const BOX_SOURCES: BoxSource[] = [
  { key: 'frigate', text: 'boxes.frigate', help: 'boxes.frigate.help', addresses: [MQTT], format: 'frigate', topics: 'frigate/events' },
  { key: 'onvif', text: 'boxes.onvif', help: 'boxes.onvif.help', addresses: [...RTSP, MQTT, 'push:'], format: 'onvif', needsSize: true },
  { key: 'axis', text: 'boxes.axis', help: 'boxes.axis.help', addresses: [MQTT, 'push:'], format: 'json', mapping: AXIS, needsSize: true },
  { key: 'deepstream', text: 'boxes.deepstream', help: 'boxes.deepstream.help', addresses: [MQTT, 'kafka://broker:9092'], format: 'deepstream' },
  { key: 'json', text: 'boxes.json', help: 'boxes.json.help', addresses: [MQTT, 'kafka://broker:9092', 'push:'], format: 'json' },
  { key: 'edge', text: 'boxes.edge', help: 'boxes.edge.help', addresses: [] },
  { key: 'file', text: 'boxes.file', help: 'boxes.file.help', addresses: [] },
];

/** The form of a source; texts are empty where nothing is given. */
export interface BoxSourceForm {
  address: string;
  topics: string;
  senderName: string;
  username: string;
  password: string;
}

export function emptyForm(source: BoxSource): BoxSourceForm {
  return { address: source.addresses[0] ?? '', topics: source.topics ?? '', senderName: '', username: '', password: '' };
}

/** True if an address has topics. */
export const hasTopics = (address: string): boolean => /^(mqtts?|kafkas?):/.test(address);
/** True if an address may ask for a user. */
export const hasUsers = (address: string): boolean => hasTopics(address) || /^rtsps?:/.test(address);

/** The request for the connection that brings a camera's boxes. */
export function connectionOf(source: BoxSource, form: BoxSourceForm, camera: { id: string; name: string }, mapping?: JsonMapping): object {
  const users = hasUsers(form.address);
  return {
    id: slugOf(`${source.key} ${camera.id}`),
    display_name: camera.name,
    source: {
      address: form.address.trim(),
      format: source.format,
      ...(hasTopics(form.address) ? { topics: form.topics.split(/[\s,]+/).filter(Boolean) } : {}),
      ...(users && form.username.trim() ? { username: form.username.trim() } : {}),
      ...(mapping ? { mapping } : {}),
      cameras: { [form.senderName.trim() || '*']: { camera_id: camera.id } },
      store_samples: true,
    },
    secrets: users && form.password ? { password: form.password } : {},
  };
}
