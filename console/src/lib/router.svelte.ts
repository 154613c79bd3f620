// Routes live in the fragment (`#/cameras/north-gate/live`), so the server has one page and no fallback.

/** A segment whose percent signs are no escapes is taken as it is. */
function decoded(segment: string): string {
  try {
    return decodeURIComponent(segment);
  } catch {
    return segment;
  }
}

function segmentsOf(hash: string): string[] {
  return hash.replace(/^#\/?/, '').split('?')[0]!.split('/').filter(Boolean).map(decoded);
}

/** The view that a sign-in at a provider leads away from. */
const LEFT_VIEW = 'sightfix.left_view';

class Router {
  segments = $state<string[]>([]);

  constructor() {
    const left = sessionStorage.getItem(LEFT_VIEW);
    sessionStorage.removeItem(LEFT_VIEW);
    // The provider leads back to the page without a fragment.
    if (left && !location.hash) history.replaceState(null, '', left);
    this.segments = segmentsOf(location.hash);
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

/** Before the browser leaves for a provider: it is to come back to this view. */
export function rememberView(): void {
  if (router.segments[0] !== 'sign-in') sessionStorage.setItem(LEFT_VIEW, location.hash);
}

export const router = new Router();
