// The language of the page. All texts are in texts.ts.
import { texts, type Language, type TextKey } from './texts';

const STORED = 'sightfix.language';

function preferred(): Language {
  const stored = localStorage.getItem(STORED);
  if (stored === 'en' || stored === 'de') return stored;
  return navigator.language.startsWith('de') ? 'de' : 'en';
}

class Internationalisation {
  language = $state<Language>(preferred());

  get locale(): string {
    return this.language === 'de' ? 'de-DE' : 'en-GB';
  }

  set(language: Language): void {
    this.language = language;
    localStorage.setItem(STORED, language);
    document.documentElement.lang = language;
  }
}

export const i18n = new Internationalisation();
document.documentElement.lang = i18n.language;

/** A text with its `{placeholders}` filled in. */
export function t(key: TextKey, values: Record<string, string | number> = {}): string {
  return texts[i18n.language][key].replace(/\{(\w+)\}/g, (whole, name: string) => String(values[name] ?? whole));
}

/** The singular for one, else the plural with its `{n}`. */
export function plural(n: number, one: TextKey, many: TextKey): string {
  return n === 1 ? t(one) : t(many, { n });
}

export type { TextKey };
