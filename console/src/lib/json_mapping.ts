// Proposes where the values of a detector's JSON are, from one of its messages.

export type BoxForm = 'corners' | 'left_top' | 'centre';
export interface JsonMapping {
  items?: string;
  time?: string;
  camera?: string;
  target?: string;
  class?: string;
  score?: string;
  bounding_box: { form: BoxForm; unit: 'px' | 'share'; sides: string[] };
}

type Json = null | boolean | number | string | Json[] | { [name: string]: Json };
/** A value of a message by its JSON pointer (RFC 6901). */
export interface Leaf {
  pointer: string;
  value: number | string;
}

const DEEPEST = 6;
const MOST_LEAVES = 200;
const escaped = (name: string): string => name.replaceAll('~', '~0').replaceAll('/', '~1');

/** The numbers and texts of a value; of an array of objects, those of the first. */
export function leavesOf(value: Json, pointer = '', found: Leaf[] = []): Leaf[] {
  if (found.length >= MOST_LEAVES || pointer.split('/').length > DEEPEST + 1) return found;
  if (typeof value === 'number' || typeof value === 'string') found.push({ pointer, value });
  else if (value !== null && typeof value === 'object') {
    for (const [name, part] of Object.entries(value)) leavesOf(part, `${pointer}/${escaped(name)}`, found);
  }
  return found;
}

const SIDES: [BoxForm, string[]][] = [
  ['corners', ['left', 'top', 'right', 'bottom']],
  ['corners', ['x1', 'y1', 'x2', 'y2']],
  ['corners', ['xmin', 'ymin', 'xmax', 'ymax']],
  ['left_top', ['left', 'top', 'width', 'height']],
  ['left_top', ['x', 'y', 'width', 'height']],
  ['left_top', ['x', 'y', 'w', 'h']],
  ['centre', ['cx', 'cy', 'w', 'h']],
];
const NAMES = {
  target: ['trackid', 'trackingid', 'trackerid', 'objectid', 'id'],
  class: ['class', 'label', 'classname', 'category', 'type', 'name'],
  score: ['score', 'confidence', 'conf', 'probability', 'likelihood'],
  time: ['timestamp', 'time', 'frametime', 'utctime', 'datetime', 'ts'],
  camera: ['camera', 'cameraid', 'cameraname', 'sensorid', 'sensor', 'stream', 'source'],
} as const;

const plain = (name: string): string => name.toLowerCase().replace(/[^a-z0-9]/g, '');
const lastName = (pointer: string): string => plain(pointer.slice(pointer.lastIndexOf('/') + 1));

/** The leaf whose name, or whose parent's name, is the first of some names. */
function named(leaves: Leaf[], names: readonly string[]): string | undefined {
  for (const name of names) {
    const found = leaves.find(({ pointer }) => lastName(pointer) === name) ?? leaves.find(({ pointer }) => lastName(pointer.slice(0, pointer.lastIndexOf('/'))) === name);
    if (found) return found.pointer;
  }
  return undefined;
}

function boxOf(leaves: Leaf[]): JsonMapping['bounding_box'] | undefined {
  const numbers = leaves.filter((leaf): leaf is { pointer: string; value: number } => typeof leaf.value === 'number');
  const parents = [...new Set(numbers.map(({ pointer }) => pointer.slice(0, pointer.lastIndexOf('/'))))];
  const unitOf = (values: number[]): 'px' | 'share' => (values.every((value) => value >= 0 && value <= 1) ? 'share' : 'px');
  for (const parent of parents) {
    const own = numbers.filter(({ pointer }) => pointer.slice(0, pointer.lastIndexOf('/')) === parent);
    const list = [0, 1, 2, 3].map((at) => own.find(({ pointer }) => pointer === `${parent}/${at}`));
    const candidates: [BoxForm, (typeof list)][] = SIDES.map(([form, names]) => [form, names.map((name) => own.find(({ pointer }) => lastName(pointer) === name))]);
    // An array says nothing of its form: corners grow.
    const grows = (list[2]?.value ?? 0) > (list[0]?.value ?? 0) && (list[3]?.value ?? 0) > (list[1]?.value ?? 0);
    for (const [form, sides] of [...candidates, [grows ? 'corners' : 'left_top', list] as [BoxForm, typeof list]]) {
      if (sides.some((side) => !side)) continue;
      return { form, unit: unitOf(sides.map((side) => side!.value)), sides: sides.map((side) => side!.pointer) };
    }
  }
  return undefined;
}

/** Arrays of objects, with their pointers. */
export function listsOf(value: Json, pointer = ''): { pointer: string; first: Json }[] {
  if (value === null || typeof value !== 'object') return [];
  if (Array.isArray(value)) return pointer && value[0] !== null && typeof value[0] === 'object' && !Array.isArray(value[0]) ? [{ pointer, first: value[0]! }] : [];
  return Object.entries(value).flatMap(([name, part]) => listsOf(part, `${pointer}/${escaped(name)}`));
}

/** The possible mappings of a message: the pointers of one item, and a proposal. Undefined for what is no JSON object with a box. */
export function proposed(text: string): { mapping: JsonMapping; leaves: Leaf[] } | undefined {
  let message: Json;
  try {
    message = JSON.parse(text) as Json;
  } catch {
    return undefined;
  }
  const candidates = [...listsOf(message).map(({ pointer, first }) => ({ items: pointer, item: first })), { items: undefined, item: message }];
  for (const { items, item } of candidates) {
    const own = leavesOf(item);
    const bounding_box = boxOf(own);
    if (!bounding_box) continue;
    // Pointers are looked up in an item first, then in the whole message.
    const rest = items ? leavesOf(message).filter(({ pointer }) => !pointer.startsWith(`${items}/`)) : [];
    const others = [...own, ...rest].filter(({ pointer }) => !bounding_box.sides.includes(pointer));
    const fields = Object.entries(NAMES).flatMap(([field, names]) => {
      const pointer = named(others, names);
      return pointer ? [[field, pointer]] : [];
    });
    return { mapping: { ...(items ? { items } : {}), ...Object.fromEntries(fields), bounding_box }, leaves: [...own, ...rest] };
  }
  return undefined;
}
