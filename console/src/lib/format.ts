// Numbers, lengths and times for people.
import { i18n, t } from './i18n.svelte';
import type { Motion } from './types';

export function number(value: number | undefined | null, digits = 0): string {
  if (value === undefined || value === null || !Number.isFinite(value)) return '–';
  return numberFormat(i18n.locale, digits).format(value);
}

/** Making a format takes far longer than using it, and a list of targets asks for thousands a second. */
const numberFormat = kept((locale: string, digits: number) => new Intl.NumberFormat(locale, { minimumFractionDigits: digits, maximumFractionDigits: digits }));
const timeFormat = kept((locale: string) => new Intl.DateTimeFormat(locale, { year: 'numeric', month: 'short', day: 'numeric', hour: '2-digit', minute: '2-digit', second: '2-digit', timeZoneName: 'short' }));

/** The function, which makes the same only once. */
function kept<A extends (string | number)[], T>(make: (...of: A) => T): (...of: A) => T {
  const made = new Map<string, T>();
  return (...of) => {
    const key = of.join();
    const known = made.get(key) ?? make(...of);
    made.set(key, known);
    return known;
  };
}

/** A speed with half the width of its 95 % interval. */
export function speed({ speed_mps, speed_interval_mps: [low, high], stationary_probability }: Motion): string {
  if (stationary_probability > 0.5) return t('live.still');
  return `${number(speed_mps, 1)} ± ${number((high - low) / 2, 1)} m/s`;
}

export function metres(value: number | undefined | null): string {
  if (value === undefined || value === null || !Number.isFinite(value)) return '–';
  if (value >= 10_000) return `${number(value / 1000, 0)} km`;
  return `${number(value, value < 10 ? 2 : value < 100 ? 1 : 0)} m`;
}

export function percent(share: number | undefined | null, digits = 0): string {
  return share === undefined || share === null ? '–' : `${number(share * 100, digits)} %`;
}

export function bytes(value: number): string {
  const units = ['B', 'kB', 'MB', 'GB'];
  let at = 0;
  while (value >= 1000 && at < units.length - 1) {
    value /= 1000;
    at += 1;
  }
  return `${number(value, value < 10 && at > 0 ? 1 : 0)} ${units[at]}`;
}

/** Date, time and zone. */
export function dateTime(text: string | undefined): string {
  if (!text) return '–';
  return timeFormat(i18n.locale).format(new Date(text));
}

/** Name of the time zone in which this browser shows and reads times, such as `Europe/Berlin`. */
export function zoneName(): string {
  return Intl.DateTimeFormat().resolvedOptions().timeZone;
}

export function duration(seconds: number | undefined | null): string {
  if (seconds === undefined || seconds === null || !Number.isFinite(seconds)) return '–';
  if (seconds < 60) return `${number(seconds, seconds < 10 ? 1 : 0)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`;
  return `${Math.floor(seconds / 3600)} h ${Math.round((seconds % 3600) / 60)} min`;
}

/** How long ago, at the given time of this machine. */
export function age(text: string | undefined, now_ms: number): string {
  if (!text) return t('age.never');
  const seconds = Math.max(0, (now_ms - Date.parse(text)) / 1000);
  if (seconds < 5) return t('age.now');
  if (seconds < 90) return t('age.ago', { time: `${Math.round(seconds)} s` });
  if (seconds < 5400) return t('age.ago', { time: `${Math.round(seconds / 60)} min` });
  if (seconds < 129_600) return t('age.ago', { time: `${Math.round(seconds / 3600)} h` });
  return t('age.ago', { time: `${Math.round(seconds / 86_400)} d` });
}

export function degrees(value: number): string {
  return value.toFixed(7);
}
