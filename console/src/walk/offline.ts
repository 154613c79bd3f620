// Keeps the files of this page in the browser, so that it opens again without a network.

const CACHE = 'sightfix-walk';

export async function keepPage(): Promise<void> {
  if (!('serviceWorker' in navigator)) return;
  await navigator.serviceWorker.register('/walk-worker.js', { scope: '/walk' });
  const loaded = performance.getEntriesByType('resource').map(({ name }) => new URL(name).pathname);
  const files = new Set(['/walk', '/favicon.svg', ...loaded.filter((path) => path.startsWith('/assets/'))]);
  const cache = await caches.open(CACHE);
  await cache.addAll([...files]);
  // Those of an earlier release.
  const kept = await cache.keys();
  await Promise.all(kept.filter(({ url }) => !files.has(new URL(url).pathname)).map((request) => cache.delete(request)));
}
