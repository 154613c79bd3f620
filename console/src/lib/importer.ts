// Sends mapped files to the importer in parts, so that there is progress and one bad row costs nothing.
import { cameraPath, postOnce } from './api';
import { isRejected, mapRow, outputColumns, toCsv, type MappedRow, type Mapping, type Table } from './csv';
import type { ImageSize, Imported, PairedSamples, RejectedRow } from './types';

const ROWS_PER_PART = 2_000;

export interface SourceFile {
  file: File;
  /** Missing for NMEA and GPX, which the server reads itself. */
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

function mapAll(source: SourceFile, image: ImageSize | undefined): { rows: MappedRow[]; rejected: RejectedRow[] } {
  const rows: MappedRow[] = [];
  const rejected: RejectedRow[] = [];
  for (const row of source.table?.rows ?? []) {
    const mapped = mapRow(row, source.mapping, image);
    if (isRejected(mapped)) rejected.push(mapped);
    else rows.push(mapped);
  }
  return { rows, rejected };
}

/** The line of the original file instead of that of the part that was sent. */
function atOriginalLines(reported: RejectedRow[], rows: MappedRow[]): RejectedRow[] {
  return reported.map((row) => ({ ...row, line: rows[row.line - 2]?.line ?? row.line }));
}

/** Imports samples; `progress` gets the share that is done. */
export async function importSamples(
  camera: string,
  source: SourceFile,
  image: ImageSize | undefined,
  progress: (share: number) => void,
  signal: AbortSignal,
): Promise<ImportOutcome> {
  const { rows, rejected } = mapAll(source, image);
  const outcome: ImportOutcome = { accepted: 0, withoutFix: 0, duplicate: 0, rejected: rejected.length, rejectedRows: rejected, warnings: [] };
  const columns = outputColumns(source.mapping);
  for (let from = 0; from < rows.length; from += ROWS_PER_PART) {
    const part = rows.slice(from, from + ROWS_PER_PART);
    const report = await postOnce<Imported>(cameraPath(camera, 'samples'), toCsv(columns, part), {
      headers: { 'content-type': 'text/csv' },
      signal,
    });
    outcome.accepted += report.accepted;
    outcome.withoutFix += report.accepted_without_fix;
    outcome.duplicate += report.duplicate;
    outcome.rejected += report.rejected;
    outcome.rejectedRows.push(...atOriginalLines(report.rejected_rows, part));
    // Parts of one file have the same fault.
    if (outcome.warnings.length === 0) outcome.warnings = report.warnings;
    progress(Math.min(1, (from + part.length) / rows.length));
  }
  outcome.rejectedRows.sort((a, b) => a.line - b.line);
  return outcome;
}

/** Imports detections and fixes that were recorded apart; the server pairs them by time. */
export async function importPair(
  camera: string,
  detections: SourceFile,
  fixes: SourceFile,
  image: ImageSize | undefined,
  keepUnpaired: boolean,
  signal: AbortSignal,
): Promise<ImportOutcome> {
  const form = new FormData();
  const rejected: RejectedRow[] = [];
  const mappedRows: Record<string, MappedRow[]> = {};
  for (const [part, source] of [['detections', detections], ['fixes', fixes]] as const) {
    if (!source.table) {
      form.append(part, source.file, source.file.name);
      continue;
    }
    const mapped = mapAll(source, image);
    mappedRows[part] = mapped.rows;
    rejected.push(...mapped.rejected.map((row) => ({ ...row, part })));
    const csv = toCsv(outputColumns(source.mapping), mapped.rows);
    form.append(part, new Blob([csv], { type: 'text/csv' }), `${part}.csv`);
  }
  const report = await postOnce<PairedSamples>(`${cameraPath(camera, 'samples', 'pairings')}?keep_unpaired=${keepUnpaired}`, form, { signal });
  const reported = report.rejected_rows.flatMap((row) => atOriginalLines([row], mappedRows[row.part ?? ''] ?? []));
  return {
    accepted: report.accepted,
    withoutFix: report.accepted_without_fix,
    duplicate: report.duplicate,
    rejected: report.rejected + rejected.length,
    rejectedRows: [...rejected, ...reported],
    warnings: report.warnings,
    pairing: report.pairing,
  };
}
