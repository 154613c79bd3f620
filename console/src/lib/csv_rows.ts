// Tables as files for spreadsheets.
import type { RejectedRow } from './types';

/** Rows as a file that a spreadsheet opens. */
export function csvOf(rows: (string | number)[][]): string {
  // A spreadsheet would run a text that begins like a formula.
  const cell = (value: string | number): string => (typeof value === 'number' ? String(value) : `"${(/^[=+\-@\t\r]/.test(value) ? `'${value}` : value).replaceAll('"', '""')}"`);
  return rows.map((row) => `${row.map(cell).join(',')}\r\n`).join('');
}

/** Rejected rows as a file that a spreadsheet opens. */
export function rejectedRowsCsv(rows: RejectedRow[]): string {
  const lines = rows.map((row) => [row.part ?? '', String(row.line), row.field, row.reason]);
  return 'part,line,field,reason\r\n' + csvOf(lines);
}
