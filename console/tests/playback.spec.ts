// Places, counts and tracks as they are computed for the console, without a page.
import { expect, test } from '@playwright/test';
import { distanceToLine_m, isInside, toPosition } from '../src/lib/geo';
import { createdOf, draftOf, geojsonOf, importedOf, newDraft, newRule } from '../src/lib/place_draft';
import { drawDirection } from '../src/lib/place_draw';
import { positionAt, tracksOf, tracksOverTime, wayBefore } from '../src/lib/playback';
import { countSeries, everyInterval, quantileSeries, statisticsCsv } from '../src/lib/statistics';
import type { HistoryPosition, Place, PlaceFigures, Position } from '../src/lib/types';
import { recorder } from './recorder';

const ORIGIN = { longitude_deg: 11, latitude_deg: 48 };
const at = (east_m: number, north_m: number): Position => toPosition(ORIGIN, { east_m, north_m });
const point = (track_id: string, time_s: number, position: Position): HistoryPosition => ({
  track_id,
  time: new Date(time_s * 1000).toISOString(),
  position,
  covariance: { east_m2: 1, north_m2: 1, east_north_m2: 0 },
  speed_mps: 1,
  speed_interval_mps: [0.5, 1.5],
  stationary_probability: 0,
});

test('a target is on the straight line between two of its positions, and nowhere in a gap', () => {
  const [track] = tracksOf([point('a', 100, at(0, 0)), point('b', 101, at(50, 0)), point('a', 104, at(8, 4)), point('a', 200, at(9, 9))]);
  const halfway = positionAt(track!, 102_000)!;
  expect(halfway.longitude_deg).toBeCloseTo(at(4, 2).longitude_deg, 9);
  expect(halfway.latitude_deg).toBeCloseTo(at(4, 2).latitude_deg, 9);
  expect([99_000, 150_000, 201_000].map((time_ms) => positionAt(track!, time_ms))).toEqual([undefined, undefined, undefined]);
  expect(positionAt(track!, 200_000)).toEqual(at(9, 9));
  expect(wayBefore(track!, 150_000, 48_000)).toEqual([at(8, 4)]);
});

test('the time line counts the tracks that are there', () => {
  const tracks = tracksOf([point('a', 0, at(0, 0)), point('b', 5, at(1, 0)), point('a', 10, at(2, 0)), point('b', 20, at(3, 0))]);
  expect(tracksOverTime(tracks, 0, 20_000, 4)).toEqual([1, 2, 1, 1]);
});

test('a click is inside a ring or near a line', () => {
  const ring = [at(0, 0), at(10, 0), at(10, 10), at(5, 5), at(0, 10)];
  expect([at(2, 2), at(5, 7), at(-1, 2), at(9, 8)].map((position) => isInside(ring, position))).toEqual([true, false, false, true]);
  expect(distanceToLine_m([at(0, 0), at(10, 0), at(10, 10)], at(13, 14))).toBeCloseTo(5, 3);
});

test('the arrow across a line points to its right-hand side', () => {
  const { context, calls } = recorder();
  // To the east on the screen; the right-hand side is to the south, where y grows.
  drawDirection(context, [{ x: 0, y: 50 }, { x: 100, y: 50 }], 'red');
  const [from, to] = ['moveTo', 'lineTo'].map((name) => calls.filter(([call, x]) => call === name && x === 50).map(([, , y]) => y as number));
  expect(Math.min(...from!)).toBe(35);
  expect(Math.max(...to!)).toBe(65);
});

test('a place is the same after it was a draft, and after it was a file', () => {
  const place: Place = {
    id: 'gate',
    site_id: 'harbour',
    display_name: 'Gate',
    labels: { zone: 'north' },
    geometry: { type: 'Polygon', coordinates: [[[11, 48], [11.1, 48], [11.1, 48.1], [11, 48]], [[11.05, 48.01], [11.06, 48.01], [11.06, 48.02], [11.05, 48.01]]] },
    probability: 0.9,
    rules: [{ id: 'slow', kind: 'speed_below', classes: ['person', 'car'], speed_mps: 2, probability: 0.8 }],
    revision: 3,
  };
  const { display_name, geometry, probability, rules } = place;
  const scope = { kind: 'site', id: 'harbour' } as const;
  expect(createdOf(draftOf(place), scope)).toEqual({ id: 'gate', site_id: 'harbour', display_name, geometry, radius_m: null, probability, rules });
  const [imported] = importedOf(geojsonOf([place]), { kind: 'camera', id: 'c1' });
  expect(imported).toEqual({ id: 'gate', camera_id: 'c1', display_name, labels: place.labels, geometry, probability, rules });
});

test('a feature of another program becomes a place: an id of its name, no heights, no foreign properties', () => {
  const feature = { type: 'Feature', geometry: { type: 'LineString', coordinates: [[11, 48, 512], [11.1, 48, 513]] }, properties: { name: 'Main Street', fill: '#f00' } };
  expect(importedOf(JSON.stringify(feature), { kind: 'camera', id: 'c1' })).toEqual([
    { id: 'main-street', camera_id: 'c1', display_name: 'Main Street', geometry: { type: 'LineString', coordinates: [[11, 48], [11.1, 48]] } },
  ]);
});

test('a rule has a name that no other has, and a new line counts crossings', () => {
  expect(newRule('wrong_way', [{ id: 'wrong-way' }, { id: 'wrong-way-2' }]).id).toBe('wrong-way-3');
  expect(newDraft('LineString').rules.map(({ kind }) => kind)).toEqual(['cross']);
});

test('intervals without counts are zeros, and the file has the bounds of each figure', () => {
  const none = { count: 0, expected: 0, interval: [0, 0] as [number, number] };
  const figures: PlaceFigures = { enters: { count: 2, expected: 2.4, interval: [2, 3] }, leaves: none, left_to_right: none, right_to_left: none, mean_occupancy: 0.5, dwell_s: [], speed_mps: [{ percent: 50, value: 1.2, interval: [1, 1.5] }], origins: {} };
  const intervals = everyInterval({ occupancy: none, total: figures, intervals: [{ ...figures, from: '2026-01-01T10:01:00Z' }] }, Date.parse('2026-01-01T10:00:00Z') / 1000, Date.parse('2026-01-01T10:03:00Z') / 1000, 'minute');
  expect(countSeries(intervals, 'enters')).toEqual({ values: [0, 2.4, 0], interval: { low: [0, 2, 0], high: [0, 3, 0] } });
  expect(quantileSeries(intervals, 'speed_mps', 50).values).toEqual([null, 1.2, null]);
  const [head, ...rows] = statisticsCsv(intervals).trim().split('\r\n').map((line) => line.split(',').map((cell) => cell.replaceAll('"', '')));
  const cell = (row: number, name: string): string | undefined => rows[row]![head!.indexOf(name)];
  expect(rows.map((row) => row.length)).toEqual(rows.map(() => head!.length));
  expect(['from', 'enters_count', 'enters_high', 'mean_occupancy', 'speed_mps_p50_low', 'dwell_s_p85'].map((name) => cell(1, name))).toEqual(['2026-01-01T10:01:00.000Z', '2', '3', '0.5', '1', '']);
});
