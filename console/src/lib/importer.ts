// Sends files to the importer, which reads them: whole, or in parts as they come from the disk, so that their size neither
// fills this browser's memory nor the importer's limit.
import { cameraPath, postOnce } from './api';
import { documentedHeader, parseTable, type Mapping, type Table } from './csv';
import type { Imported, PairedSamples, RejectedRow } from './types';

/** Enough of a file to map its columns. */
const HEAD_BYTES = 256 * 1024;
const PART_BYTES = 4 * 1024 * 1024;
const NEWLINE = 10;

export interface SourceFile {
  file: File;
  /** Its first rows. Missing for files of receivers, which the server reads itself. */
  table?: Table;
  mapping: Mapping;
}

export interface ImportOutcome {
  accepted: number;
  withoutFix: number;
  duplicate: number;
  rejected: number;
  rejectedRows: RejectedRow[];
  warnings: string[];
  pairing?: PairedSamples['pairing'];
}

/** The first rows of a file. */
export async function tableOf(file: File): Promise<Table> {
  const head = new Uint8Array(await file.slice(0, HEAD_BYTES).arrayBuffer());
  const end = file.size > HEAD_BYTES ? head.lastIndexOf(NEWLINE) + 1 : head.length;
  return parseTable(new TextDecoder().decode(head.subarray(0, end)));
}

/** Where the rows of a file begin, in bytes. */
async function rowsFrom({ file, table }: SourceFile): Promise<number> {
  const head = new Uint8Array(await file.slice(0, HEAD_BYTES).arrayBuffer());
  let from = 0;
  for (let line = 0; line < table!.headerLine; line++) from = head.indexOf(NEWLINE, from) + 1;
  return from;
}

/** The settings of a file that the importer gets. */
function layoutOf({ boxForm, normalised, targetId }: Mapping, timezone: string | undefined): URLSearchParams {
  const layout = new URLSearchParams({ columns: 'auto', box_form: boxForm, box_unit: normalised ? 'share' : 'px' });
  if (timezone) layout.set('timezone', timezone);
  if (targetId.trim()) layout.set('target_id', targetId.trim());
  return layout;
}

/** Imports samples; `progress` gets the share that is done. Times without an offset are local times of `timezone`. */
export async function importSamples(
  camera: string,
  source: SourceFile,
  timezone: string | undefined,
  progress: (share: number) => void,
  signal: AbortSignal,
): Promise<ImportOutcome> {
  const { file, table, mapping } = source;
  const outcome: ImportOutcome = { accepted: 0, withoutFix: 0, duplicate: 0, rejected: 0, rejectedRows: [], warnings: [] };
  const path = `${cameraPath(camera, 'samples')}?${layoutOf(mapping, timezone)}`;
  const header = `${documentedHeader(table!, mapping)}\n`;
  let linesBefore = table!.headerLine;
  for (let from = await rowsFrom(source); from < file.size; ) {
    const read = new Uint8Array(await file.slice(from, from + PART_BYTES).arrayBuffer());
    const isLast = from + read.length === file.size;
    // A row longer than a part is refused by the importer in either of its halves.
    const part = isLast ? read : read.subarray(0, read.lastIndexOf(NEWLINE) + 1 || read.length);
    const report = await postOnce<Imported>(path, new Blob([header, part]), { headers: { 'content-type': 'text/csv' }, signal });
    outcome.accepted += report.accepted;
    outcome.withoutFix += report.accepted_without_fix;
    outcome.duplicate += report.duplicate;
    outcome.rejected += report.rejected;
    // The line of the file instead of that of the part, whose first is the header.
    for (const row of report.rejected_rows) outcome.rejectedRows.push({ ...row, line: linesBefore + row.line - 1 });
    // Parts of one file have the same fault.
    if (outcome.warnings.length === 0) outcome.warnings = report.warnings;
    linesBefore += part.reduce((count, byte) => count + (byte === NEWLINE ? 1 : 0), 0);
    from += part.length;
    progress(from / file.size);
  }
  return outcome;
}

/** Imports detections and fixes that were recorded apart; the server pairs them by time. */
export async function importPair(
  camera: string,
  detections: SourceFile,
  fixes: SourceFile,
  timezone: string | undefined,
  keepUnpaired: boolean,
  signal: AbortSignal,
): Promise<ImportOutcome> {
  const form = new FormData();
  const linesBefore: Record<string, number> = {};
  for (const [part, source] of [['detections', detections], ['fixes', fixes]] as const) {
    const { file, table, mapping } = source;
    if (!table) {
      form.append(part, file, file.name);
      continue;
    }
    linesBefore[part] = table.headerLine - 1;
    const rows = file.slice(await rowsFrom(source));
    form.append(part, new Blob([documentedHeader(table, mapping), '\n', rows], { type: 'text/csv' }), `${part}.csv`);
  }
  const params = layoutOf(detections.mapping, timezone);
  params.set('keep_unpaired', String(keepUnpaired));
  const report = await postOnce<PairedSamples>(`${cameraPath(camera, 'samples', 'pairings')}?${params}`, form, { signal });
  return {
    accepted: report.accepted,
    withoutFix: report.accepted_without_fix,
    duplicate: report.duplicate,
    rejected: report.rejected,
    rejectedRows: report.rejected_rows.map((row) => ({ ...row, line: row.line + (linesBefore[row.part ?? ''] ?? 0) })),
    warnings: report.warnings,
    pairing: report.pairing,
  };
}
