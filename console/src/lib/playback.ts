// Where the targets of finished tracks were at an instant.
import type { HistoryPosition, Position } from './types';

/** A target that was not seen for longer is not shown between. */
const LONGEST_GAP_MS = 10_000;

export interface HistoryTrack {
  id: string;
  name: string;
  points: HistoryPosition[];
  /** Times of the points, ms since 1970. */
  times_ms: number[];
}

/** Positions in the order of time, by track. */
export function tracksOf(positions: HistoryPosition[]): HistoryTrack[] {
  const tracks = new Map<string, HistoryTrack>();
  for (const point of positions) {
    const { track_id: id, target_id } = point;
    const track = tracks.get(id) ?? { id, name: target_id ?? id, points: [], times_ms: [] };
    tracks.set(id, track);
    track.points.push(point);
    track.times_ms.push(Date.parse(point.time));
  }
  return [...tracks.values()];
}

/** The index of the last of the sorted times that is not after an instant; -1 before the first. */
export function lastAt(times_ms: number[], time_ms: number): number {
  let [low, high] = [0, times_ms.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times_ms[middle]! <= time_ms) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Where a track was at an instant, on the straight line between two of its points; undefined outside them and in gaps. */
export function positionAt({ points, times_ms }: HistoryTrack, time_ms: number): Position | undefined {
  const before = lastAt(times_ms, time_ms);
  const [a, b] = [points[before]?.position, points[before + 1]?.position];
  if (!a) return undefined;
  const passed_ms = time_ms - times_ms[before]!;
  if (!b) return passed_ms === 0 ? a : undefined;
  const gap_ms = times_ms[before + 1]! - times_ms[before]!;
  if (gap_ms > LONGEST_GAP_MS) return undefined;
  const share = passed_ms / gap_ms;
  return {
    longitude_deg: a.longitude_deg + share * (b.longitude_deg - a.longitude_deg),
    latitude_deg: a.latitude_deg + share * (b.latitude_deg - a.latitude_deg),
  };
}

/** The way of a track in the time before an instant. */
export function wayBefore({ points, times_ms }: HistoryTrack, time_ms: number, length_ms: number): Position[] {
  return points.slice(lastAt(times_ms, time_ms - length_ms) + 1, lastAt(times_ms, time_ms) + 1).map(({ position }) => position);
}

/** The number of tracks at the middle of each of equal parts of a window. */
export function tracksOverTime(tracks: HistoryTrack[], from_ms: number, until_ms: number, parts: number): number[] {
  const middle = (part: number): number => from_ms + ((part + 0.5) / parts) * (until_ms - from_ms);
  return Array.from({ length: parts }, (_, part) => tracks.filter(({ times_ms }) => times_ms[0]! <= middle(part) && middle(part) <= times_ms.at(-1)!).length);
}
