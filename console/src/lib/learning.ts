// How far a camera has come on its way to a model, in the language of the page, and what its user can do next.
import { t } from './i18n.svelte';
import { href } from './router.svelte';
import type { TextKey } from './texts';
import type { Camera, Learning } from './types';

/** Actions that only the page that shows the progress can take. */
export type LearningAction = 'start' | 'phone';

export interface LearningAdvice {
  text: string;
  /** The button or link that does what the text says, if anything but walking and waiting helps. */
  next?: { label: TextKey; action?: LearningAction; to: string };
}

export function learningAdvice(camera: Camera, learning: Learning): LearningAdvice {
  const to = (tab: string): string => href('cameras', camera.id, tab);
  const { state, recorded_s, needed_s, boxes, fixes } = learning;
  if (state === 'matching') return { text: t('learning.matching') };
  if (state === 'training') return { text: t('learning.training') };
  if (state === 'learned') return { text: t('learning.learned', { version: camera.active_model ?? '' }) };
  if (state === 'off') {
    return camera.learn_automatically
      ? { text: t('learning.fault'), next: { label: 'learning.models', to: to('models') } }
      : { text: t('learning.off'), next: { label: 'learning.start', action: 'start', to: to('setup') } };
  }
  if (!camera.image_size) return { text: t('learning.noSize'), next: { label: 'setup.profile', to: to('profile') } };
  if (boxes === 0) return { text: t('learning.noBoxes'), next: { label: 'setup.connections', to: href('settings', 'connections') } };
  if (fixes === 0) return { text: t('learning.noFixes'), next: { label: 'phone.add', action: 'phone', to: to('setup') } };
  const recorded = t('learning.recorded', { recorded: Math.floor(recorded_s / 60), needed: Math.ceil(needed_s / 60) });
  if (learning.training_run) return { text: `${t('learning.runFailed')} ${recorded}`, next: { label: 'learning.runs', to: to('training') } };
  return { text: learning.last_attempt ? `${t('learning.unclear')} ${recorded}` : recorded };
}
