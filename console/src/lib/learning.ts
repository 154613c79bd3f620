// How far a camera has come on its way to a model, in the language of the page.
import { t } from './i18n.svelte';
import type { Camera, Learning } from './types';

export function learningText(camera: Camera, { state, recorded_s, needed_s, boxes, fixes }: Learning): string {
  if (state === 'off') return t('learning.off');
  if (state === 'matching') return t('learning.matching');
  if (state === 'training') return t('learning.training');
  if (state === 'learned') return t('learning.learned', { version: camera.active_model ?? '' });
  if (!camera.image_size) return t('learning.noSize');
  if (boxes === 0) return t('learning.noBoxes');
  if (fixes === 0) return t('learning.noFixes');
  return t('learning.recorded', { recorded: Math.floor(recorded_s / 60), needed: Math.ceil(needed_s / 60) });
}
