// Statistics of a place as series over time, and as a table for spreadsheets.
import { csvOf } from './csv_rows';
import type { CountFigure, PlaceFigures, PlaceStatistics, Quantile } from './types';

export const COUNTED = ['enters', 'leaves', 'left_to_right', 'right_to_left'] as const;
export type Counted = (typeof COUNTED)[number];
export const MEASURED = ['speed_mps', 'dwell_s'] as const;
export type Measured = (typeof MEASURED)[number];
export const PERCENTS = [15, 50, 85];

export const STEP_S = { minute: 60, hour: 3600 } as const;
export type Step = keyof typeof STEP_S;

export interface Interval {
  from_s: number;
  figures: PlaceFigures | undefined;
}

/** Every interval of the window, also those in which nothing was counted, which the server leaves out. */
export function everyInterval({ intervals }: PlaceStatistics, from_s: number, until_s: number, step: Step): Interval[] {
  const known = new Map(intervals.map((interval) => [Date.parse(interval.from) / 1000, interval]));
  const all: Interval[] = [];
  for (let at_s = Math.floor(from_s / STEP_S[step]) * STEP_S[step]; at_s < until_s; at_s += STEP_S[step]) all.push({ from_s: at_s, figures: known.get(at_s) });
  return all;
}

const NONE: CountFigure = { count: 0, expected: 0, interval: [0, 0] };

export interface Series {
  values: (number | null)[];
  interval: { low: (number | null)[]; high: (number | null)[] };
}

export function countSeries(intervals: Interval[], what: Counted): Series {
  const counts = intervals.map(({ figures }) => figures?.[what] ?? NONE);
  return {
    values: counts.map(({ expected }) => expected),
    interval: { low: counts.map(({ interval: [low] }) => low), high: counts.map(({ interval: [, high] }) => high) },
  };
}

export function quantileSeries(intervals: Interval[], what: Measured, percent: number): Series {
  const quantiles = intervals.map(({ figures }) => quantileOf(figures?.[what], percent));
  return {
    values: quantiles.map((it) => it?.value ?? null),
    interval: { low: quantiles.map((it) => it?.interval[0] ?? null), high: quantiles.map((it) => it?.interval[1] ?? null) },
  };
}

export function quantileOf(quantiles: Quantile[] | undefined, percent: number): Quantile | undefined {
  return quantiles?.find((it) => it.percent === percent);
}

/** A line per interval, with the bounds of each figure after it. */
export function statisticsCsv(intervals: Interval[]): string {
  const bounded = (name: string): string[] => [name, `${name}_low`, `${name}_high`];
  const head = ['from', ...COUNTED.flatMap((what) => [`${what}_count`, ...bounded(what)]), 'mean_occupancy', ...MEASURED.flatMap((what) => PERCENTS.flatMap((percent) => bounded(`${what}_p${percent}`)))];
  const rows = intervals.map(({ from_s, figures }) => [
    new Date(from_s * 1000).toISOString(),
    ...COUNTED.flatMap((what) => {
      const { count, expected, interval } = figures?.[what] ?? NONE;
      return [count, expected, ...interval];
    }),
    figures?.mean_occupancy ?? 0,
    ...MEASURED.flatMap((what) => PERCENTS.flatMap((percent): (string | number)[] => {
      const quantile = quantileOf(figures?.[what], percent);
      return quantile ? [quantile.value, ...quantile.interval] : ['', '', ''];
    })),
  ]);
  return csvOf([head, ...rows]);
}
