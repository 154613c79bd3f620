// One word for each camera, by the first rule that holds.
import { isLive, type CameraStatus } from './types';
import type { TextKey } from './i18n.svelte';

export const CAMERA_STATES = ['moved', 'fault', 'training', 'live', 'stale', 'idle', 'ready', 'empty'] as const;
export type CameraState = (typeof CAMERA_STATES)[number];

/** A model needs at least this many samples with a fix (the server refuses a run with fewer). */
export const FEWEST_SAMPLES = 20;
const LIVE_WITHIN_MS = 60_000;
const STALE_AFTER_MS = 15 * 60_000;

export function stateOf(status: CameraStatus, now_ms: number): CameraState {
  const { camera, latest_run, last_observed_at } = status;
  if (camera.moved) return 'moved';
  if (camera.model_fault) return 'fault';
  if (latest_run && isLive(latest_run.state)) return 'training';
  if (camera.active_model === undefined) return camera.samples - camera.samples_without_fix < FEWEST_SAMPLES ? 'empty' : 'ready';
  const silent_ms = last_observed_at ? now_ms - Date.parse(last_observed_at) : undefined;
  if (silent_ms === undefined) return 'idle';
  if (silent_ms <= LIVE_WITHIN_MS) return 'live';
  return silent_ms > STALE_AFTER_MS ? 'stale' : 'idle';
}

export const STATE_TEXT: Record<CameraState, TextKey> = {
  moved: 'state.moved',
  fault: 'state.fault',
  training: 'state.training',
  live: 'state.live',
  stale: 'state.stale',
  idle: 'state.idle',
  ready: 'state.ready',
  empty: 'state.empty',
};

export const STATE_MEANING: Record<CameraState, TextKey> = {
  moved: 'state.moved.meaning',
  fault: 'state.fault.meaning',
  training: 'state.training.meaning',
  live: 'state.live.meaning',
  stale: 'state.stale.meaning',
  idle: 'state.idle.meaning',
  ready: 'state.ready.meaning',
  empty: 'state.empty.meaning',
};
