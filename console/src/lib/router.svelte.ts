// Routes live in the fragment (`#/cameras/north-gate/live`), so the server has one page and no fallback.

function segmentsOf(hash: string): string[] {
  return hash.replace(/^#\/?/, '').split('?')[0]!.split('/').filter(Boolean).map(decodeURIComponent);
}

class Router {
  segments = $state<string[]>(segmentsOf(location.hash));

  constructor() {
    addEventListener('hashchange', () => {
      this.segments = segmentsOf(location.hash);
    });
  }

  go(...segments: string[]): void {
    location.hash = href(...segments);
  }
}

export function href(...segments: string[]): string {
  return `#/${segments.map(encodeURIComponent).join('/')}`;
}

export const router = new Router();
