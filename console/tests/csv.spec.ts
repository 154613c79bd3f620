// Files as people have them.
import { expect, test } from '@playwright/test';
import { guessMapping, isRejected, mapRow, hasLocalTimes, documentedHeader, missingFields, outputColumns, parseTable, type BoxForm, type MappedRow } from '../src/lib/csv';
import { curlLine, grpcurlLine } from '../src/lib/request_lines';
import { sigmaOf, walkCsv } from '../src/walk/queue';
import cases from '../../tests/cases/column_mapping.json' with { type: 'json' };
import lineCases from '../../tests/cases/csv_lines.json' with { type: 'json' };

interface Case {
  name: string;
  csv: string;
  box_form?: BoxForm;
  box_unit?: 'px' | 'share';
  box_px: number[];
  fix_deg: number[];
  sigma_m?: number;
  time: string;
}

function mapped(text: string, image?: { width_px: number; height_px: number }): string {
  const table = parseTable(text);
  const mapping = guessMapping(table);
  expect(missingFields(mapping)).toEqual([]);
  const rows = table.rows.map((row) => mapRow(row, mapping, image));
  const cells = rows.filter((row): row is MappedRow => !isRejected(row)).map((row) => row.cells);
  return [outputColumns(mapping), ...cells].map((row) => `${row.join(',')}\n`).join('');
}

test('the documented columns pass as they are', () => {
  const text = 'time,target_id,left,top,width,height,longitude,latitude\n2020-12-14T14:41:48+08:00,person-1,475,11,28,77,103.98678,30.6280135\n';
  expect(mapped(text)).toBe(text);
});

test('semicolons, upper case, units, decimal commas and extra columns', () => {
  const text = '\uFEFFTime;Target ID;LEFT_PX;TOP_PX;WIDTH_PX;HEIGHT_PX;Longitude_deg;Latitude_deg;Note\r\n2026-01-01 10:00:00Z;a;1,5;2;3;4;11,25;48,5;"x;y"\r\n';
  expect(mapped(text)).toBe('time,target_id,left,top,width,height,longitude,latitude\n2026-01-01T10:00:00Z,a,1.5,2,3,4,11.25,48.5\n');
});

test('corners, centres and normalised boxes become left, top, width, height', () => {
  expect(mapped('time,id,x1,y1,x2,y2\n2026-01-01T00:00:00Z,a,10,20,40,60\n')).toContain(',a,10,20,30,40\n');
  expect(mapped('time,id,cx,cy,w,h\n2026-01-01T00:00:00Z,a,10,20,4,6\n')).toContain(',a,8,17,4,6\n');
  const normalised = 'time,id,x_center,y_center,w,h\n2026-01-01T00:00:00Z,a,0.5,0.5,0.1,0.2\n';
  expect(mapped(normalised, { width_px: 1000, height_px: 500 })).toContain(',a,450,200,100,100\n');
});

test('the header gets the documented names, and times without an offset are found', () => {
  const table = parseTable('Zeit;Spur;"x;1";Y1;X2;Y2\n2026-01-01 10:00:00;a;1;2;3;4\n');
  const mapping = { ...guessMapping(table), columns: { time: 0, target_id: 1, left: 2, top: 3, width: 4, height: -1 } };
  expect(documentedHeader(table, mapping)).toBe('time;target_id;left;top;width;unused_6');
  expect(hasLocalTimes(table, mapping)).toBe(true);
  for (const time of ['2026-01-01T10:00:00Z', '2026-01-01 10:00:00+0100', '1767225600.5']) {
    expect(hasLocalTimes(parseTable(`time;id;x;y;w;h\n${time};a;1;2;3;4\n`), mapping), time).toBe(false);
  }
});

test('Unix times and a file without targets', () => {
  const text = 'timestamp,lon,lat,accuracy\n1767225600,11,48,5\n';
  expect(mapped(text)).toBe('time,longitude,latitude,sigma_m\n2026-01-01T00:00:00.000Z,11,48,5\n');
  const boxes = guessMapping(parseTable('time,left,top,width,height\n2026-01-01T00:00:00Z,1,2,3,4\n'));
  expect([boxes.kind, boxes.targetId]).toEqual(['detections', 'target-1']);
});

test('lines are split as the importer splits them', () => {
  for (const { name, csv, accepted, rejected } of lineCases) {
    const { rows } = parseTable(csv);
    expect(rows.filter(({ problem }) => !problem).map(({ line }) => line), name).toEqual(accepted);
    expect(rows.flatMap(({ line, problem }) => (problem ? [{ line, reason: problem }] : [])), name).toEqual(rejected);
  }
  const quoted = parseTable('time,class\na,"say ""hi"", twice"\n');
  expect(quoted.rows).toEqual([{ line: 2, cells: ['a', 'say "hi", twice'] }]);
});

test('a line that cannot be split is rejected in the preview', () => {
  const table = parseTable('time,id,left,top,width,height\n2026-01-01T00:00:00Z,"a,1,2,3,4\n');
  expect(mapRow(table.rows[0]!, guessMapping(table), undefined)).toEqual({ line: 2, field: '', reason: 'has an unclosed quote; a field cannot continue on the next line' });
});

test('a cell that is no number is rejected with its field', () => {
  const table = parseTable('time,id,left,top,width,height\n2026-01-01T00:00:00Z,a,1,2,wide,4\n');
  expect(mapRow(table.rows[0]!, guessMapping(table), undefined)).toEqual({ line: 2, field: 'width', reason: 'must be a number, not `wide`' });
});

test('the lines for a shell are quoted', () => {
  const observation = { time: "2026-01-01T00:00:00Z'", fix: { longitude_deg: 11, latitude_deg: 48 } };
  expect(curlLine('http://h:8080', 'c', observation)).toBe(`curl -s http://h:8080/v1/cameras/c/fusions --json '{"time":"2026-01-01T00:00:00Z'\\''","fix":{"longitude_deg":11,"latitude_deg":48}}'`);
  expect(grpcurlLine('http://h:8080', 'c', observation)).toMatch(/^grpcurl -plaintext -d '.*' h:8080 sightfix\.v1\.FusionService\/Fuse$/);
  expect(grpcurlLine('https://h', 'c', observation)).toMatch(/^grpcurl -d .* h:443 /);
  for (const line of [curlLine('http://h', 'c', observation, true), grpcurlLine('http://h', 'c', observation, true)]) expect(line).toContain(' -H "authorization: Bearer $SIGHTFIX_KEY" ');
});

test('a walk is saved in the columns of the importer', () => {
  const fix = { time: '2026-01-01T00:00:00.000Z', longitude_deg: 11, latitude_deg: 48, sigma_m: sigmaOf(5), sent: true };
  // 68 % of a circular normal distribution lie within 1.5096 standard deviations.
  expect(fix.sigma_m).toBeCloseTo(5 / 1.5096, 3);
  expect(walkCsv('phone', [fix])).toBe('time,receiver_id,longitude,latitude,sigma_m\n2026-01-01T00:00:00.000Z,phone,11.00000000,48.00000000,3.312\n');
});

test('the cases of the importer are mapped alike', () => {
  for (const { name, csv, box_form, box_unit, box_px, fix_deg, sigma_m, time } of cases as Case[]) {
    const table = parseTable(csv);
    const mapping = guessMapping(table);
    if (box_form) mapping.boxForm = box_form;
    expect(mapping.normalised, name).toBe(box_unit === 'share');
    const row = mapRow(table.rows[0]!, mapping, { width_px: 1000, height_px: 500 });
    if (isRejected(row)) throw new Error(`${name}: ${row.field}: ${row.reason}`);
    const cell = (field: string): string => row.cells[outputColumns(mapping).indexOf(field)] ?? '';
    expect(['left', 'top', 'width', 'height'].map((field) => Number(cell(field))), name).toEqual(box_px);
    expect(['longitude', 'latitude'].map((field) => Number(cell(field))), name).toEqual(fix_deg);
    expect(cell('sigma_m'), name).toBe(sigma_m === undefined ? '' : String(sigma_m));
    expect(Date.parse(cell('time')), name).toBe(Date.parse(time));
    expect(cell('target_id'), name).toBe('a');
  }
});
