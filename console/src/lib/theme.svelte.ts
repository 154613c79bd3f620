// Light or dark: the system's choice until the operator chooses.
const STORED = 'sightfix.theme';
export type Theme = 'light' | 'dark';

class ThemeChoice {
  current = $state<Theme>('dark');

  constructor() {
    const system = matchMedia('(prefers-color-scheme: dark)');
    const stored = localStorage.getItem(STORED);
    this.#apply(stored === 'light' || stored === 'dark' ? stored : system.matches ? 'dark' : 'light');
    system.addEventListener('change', () => {
      if (!localStorage.getItem(STORED)) this.#apply(system.matches ? 'dark' : 'light');
    });
  }

  toggle(): void {
    const next = this.current === 'dark' ? 'light' : 'dark';
    localStorage.setItem(STORED, next);
    this.#apply(next);
  }

  #apply(theme: Theme): void {
    this.current = theme;
    document.documentElement.dataset.theme = theme;
  }
}

export const theme = new ThemeChoice();
