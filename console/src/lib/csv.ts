// Files of rows as people have them: any separator, any column names, any convention of boxes. The importer reads them;
// here is what it needs to be told, and a preview of what it will read.
import columnNames from '../../../crates/exchange/src/column_names.json' with { type: 'json' };
import type { ImageSize, RejectedRow } from './types';

export type FileKind = 'samples' | 'detections' | 'fixes';
export type BoxForm = 'left_top' | 'centre' | 'corners';

export interface TableRow {
  /** Number of its line in the file, from 1. */
  line: number;
  cells: string[];
  /** Why the line cannot be split into the header's columns; it has no cells then. */
  problem?: string;
}

export interface Table {
  header: string[];
  /** Number of the header's line in the file, from 1. */
  headerLine: number;
  separator: string;
  rows: TableRow[];
}

export interface Mapping {
  kind: FileKind;
  /** Column of each field, -1 for none. */
  columns: Record<string, number>;
  boxForm: BoxForm;
  normalised: boolean;
  /** True if numbers may have a decimal comma: where it is not the separator. */
  decimalComma: boolean;
  /** Used where there is no column of the target. */
  targetId: string;
}

const MOST_ROW_BYTES = 64 * 1024;

/** Splits a text into rows as the importer does: line by line, so that an open quote spoils no more than its own line. */
export function parseTable(text: string): Table {
  const lines = text.replace(/^\uFEFF/, '').split('\n').map((line) => line.replace(/\r$/, ''));
  const first = lines.findIndex((line) => line.trim() !== '');
  const headerLine = lines[first] ?? '';
  const separator = [';', '\t', ',', '|'].map((it) => [it, headerLine.split(it).length] as const).sort((a, b) => b[1] - a[1])[0]![0];
  const split = splitLine(headerLine, separator);
  const header = typeof split === 'string' ? [] : split;
  const rows = lines.flatMap((line, at): TableRow[] => {
    if (at <= first || line.trim() === '') return [];
    const cells = rowOf(line, separator, header.length);
    return [typeof cells === 'string' ? { line: at + 1, cells: [], problem: cells } : { line: at + 1, cells }];
  });
  return { header, headerLine: first + 1, separator, rows };
}

/** The cells of a line, or why it has not those that the header names. */
function rowOf(line: string, separator: string, width: number): string[] | string {
  // A character is at most four bytes.
  if (line.length * 4 > MOST_ROW_BYTES && new TextEncoder().encode(line).length > MOST_ROW_BYTES) return 'is longer than 64 KiB';
  const cells = splitLine(line, separator);
  if (typeof cells === 'string' || cells.length === width) return cells;
  return `has ${cells.length} fields where the header names ${width}`;
}

/** The trimmed fields of a line as in RFC 4180, but without line ends within quotes; or what is wrong with it. */
function splitLine(line: string, separator: string): string[] | string {
  const cells: string[] = [];
  let at = 0;
  for (;;) {
    let cell = '';
    if (line[at] === '"') {
      at += 1;
      for (;;) {
        const end = line.indexOf('"', at);
        if (end < 0) return 'has an unclosed quote; a field cannot continue on the next line';
        cell += line.slice(at, end);
        at = end + 1;
        if (line[at] !== '"') break;
        cell += '"';
        at += 1;
      }
      if (at < line.length && line[at] !== separator) return 'has text after a closing quote';
    } else {
      const end = line.indexOf(separator, at);
      const next = end < 0 ? line.length : end;
      cell = line.slice(at, next);
      at = next;
    }
    cells.push(cell.trim());
    if (at >= line.length) return cells;
    at += 1;
  }
}

/** Names that columns of each field have in the wild, lower case without units and signs; the importer has the same. */
const NAMES: Record<string, string[]> = columnNames;

export const REQUIRED: Record<FileKind, string[]> = {
  samples: ['time', 'target_id', 'left', 'top', 'width', 'height', 'longitude', 'latitude'],
  detections: ['time', 'target_id', 'left', 'top', 'width', 'height'],
  fixes: ['time', 'longitude', 'latitude'],
};
export const OPTIONAL: Record<FileKind, string[]> = {
  samples: ['sigma_m', 'class', 'score'],
  detections: ['class', 'score'],
  fixes: ['receiver_id', 'sigma_m'],
};

function plain(name: string): string {
  return name.toLowerCase().replace(/_?(px|deg|m2)$/, '').replace(/[^\p{L}\p{N}]/gu, '');
}

/** The format of a file, and the mapping of its columns: the operator sees both and may change them. */
export function guessMapping(table: Table): Mapping {
  const names = table.header.map(plain);
  const columns: Record<string, number> = {};
  for (const [field, known] of Object.entries(NAMES)) {
    const ranks = names.map((name) => known.indexOf(name)).map((rank) => (rank < 0 ? Infinity : rank));
    const best = Math.min(...ranks);
    columns[field] = best === Infinity ? -1 : ranks.indexOf(best);
  }
  const has = (field: string): boolean => columns[field]! >= 0;
  const kind: FileKind = has('left') && has('longitude') ? 'samples' : has('left') ? 'detections' : 'fixes';
  const at = (field: string): string => names[columns[field]!] ?? '';
  const boxForm: BoxForm = /^(x2|xmax|right)$/.test(at('width')) ? 'corners' : /^(cx|.*cent.*)$/.test(at('left')) ? 'centre' : 'left_top';
  const cells = (field: string): string[] => table.rows.slice(0, 200).map((row) => row.cells[columns[field]!] ?? '');
  const numbers = ['left', 'top', 'width', 'height'].flatMap((field) => cells(field).map((it) => Number(it.replace(',', '.'))));
  return {
    kind,
    columns,
    boxForm,
    normalised: has('left') && numbers.length > 0 && numbers.every((it) => it >= 0 && it <= 1),
    decimalComma: table.separator !== ',',
    targetId: has('target_id') ? '' : 'target-1',
  };
}

export interface MappedRow {
  line: number;
  cells: string[];
}

/** The columns that a mapped file has, in their order. */
export function outputColumns(mapping: Mapping): string[] {
  const optional = OPTIONAL[mapping.kind].filter((field) => (mapping.columns[field] ?? -1) >= 0);
  return [...REQUIRED[mapping.kind], ...optional];
}

/** The fields that are missing before a file can be imported, with the reason; empty if none is. */
export function missingFields(mapping: Mapping): string[] {
  return REQUIRED[mapping.kind].filter(
    (field) => (mapping.columns[field] ?? -1) < 0 && !(field === 'target_id' && mapping.targetId.trim()),
  );
}

const LOCAL_TIME = /^\d{4}-\d\d-\d\d[T ]\d\d:\d\d[\d:.]*$/i;
const UNIX_TIME = /^\d[\d.,]*$/;
/** Unix times below are seconds, others milliseconds. */
const FEWEST_UNIX_MS = 1e11;

/** True if a file has times without an offset, which are the local times of a zone. */
export function hasLocalTimes({ rows }: Table, { columns }: Mapping): boolean {
  const times = rows.slice(0, 200).map(({ cells }) => cells[columns.time ?? -1] ?? '');
  return times.some((time) => LOCAL_TIME.test(time));
}

/** The header with the names that the importer documents, and others for the columns that it shall ignore. */
export function documentedHeader({ header, separator }: Table, { kind, columns }: Mapping): string {
  const fields = [...REQUIRED[kind], ...OPTIONAL[kind]];
  return header.map((_, at) => fields.find((field) => columns[field] === at) ?? `unused_${at + 1}`).join(separator);
}

/** One row in the importer's columns, or why it cannot be. */
export function mapRow(row: TableRow, mapping: Mapping, image: ImageSize | undefined): MappedRow | RejectedRow {
  const raw = (field: string): string => row.cells[mapping.columns[field] ?? -1] ?? '';
  const reject = (field: string, reason: string): RejectedRow => ({ line: row.line, field, reason });
  if (row.problem) return reject('', row.problem);
  const numeric = (field: string): number => {
    const text = mapping.decimalComma ? raw(field).replace(',', '.') : raw(field);
    return text === '' ? NaN : Number(text);
  };
  const values: Record<string, string> = {};
  const time = raw('time');
  if (UNIX_TIME.test(time)) {
    const unix = numeric('time');
    const time_ms = unix < FEWEST_UNIX_MS ? unix * 1000 : unix;
    if (time_ms > 8.64e15) return reject('time', `\`${time.slice(0, 40)}\` is no Unix time`);
    values.time = new Date(time_ms).toISOString();
  } else values.time = time.replace(/^(\d{4}-\d\d-\d\d) (\d\d:)/, '$1T$2');
  values.target_id = raw('target_id') || mapping.targetId;
  if (mapping.kind !== 'fixes') {
    const sides = ['left', 'top', 'width', 'height'].map(numeric);
    const wrong = sides.findIndex((side) => !Number.isFinite(side));
    if (wrong >= 0) {
      const field = ['left', 'top', 'width', 'height'][wrong]!;
      return reject(field, raw(field) === '' ? 'is empty' : `must be a number, not \`${raw(field).slice(0, 40)}\``);
    }
    let [left, top, width, height] = sides as [number, number, number, number];
    if (mapping.normalised && image) {
      [left, width] = [left * image.width_px, width * image.width_px];
      [top, height] = [top * image.height_px, height * image.height_px];
    }
    if (mapping.boxForm === 'corners') [width, height] = [width - left, height - top];
    if (mapping.boxForm === 'centre') [left, top] = [left - width / 2, top - height / 2];
    const shown = (value: number): string => String(Math.round(value * 1000) / 1000);
    Object.assign(values, { left: shown(left), top: shown(top), width: shown(width), height: shown(height) });
  }
  for (const field of ['longitude', 'latitude', 'sigma_m', 'score']) values[field] = mapping.decimalComma ? raw(field).replace(',', '.') : raw(field);
  for (const field of ['class', 'receiver_id']) values[field] = raw(field);
  return { line: row.line, cells: outputColumns(mapping).map((field) => values[field] ?? '') };
}

export function isRejected(row: MappedRow | RejectedRow): row is RejectedRow {
  return 'reason' in row;
}
