// The text of a failure: the kind in the language of the page, the details in the server's own words.
import { ApiProblem } from './api';
import { t } from './i18n.svelte';
import { texts, type TextKey } from './texts';

const PROBLEM_TYPE = 'urn:sightfix:problem:';

export interface Failure {
  /** In the language of the page. */
  text?: string;
  /** The details, which the server words in English. */
  detail?: string;
}

export function failureOf(error: unknown): Failure {
  if (!(error instanceof ApiProblem)) return { text: error instanceof Error ? error.message : String(error) };
  const key = problemKey(error.type);
  return { ...(key ? { text: t(key) } : {}), detail: error.text };
}

/** The text of a problem's stable type, or of the last part of it, if this page knows it. */
export function problemKey(type: string): TextKey | undefined {
  const key = `problem.${type.replace(PROBLEM_TYPE, '')}`;
  return key in texts.en ? (key as TextKey) : undefined;
}
