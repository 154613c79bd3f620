// Answers for the phone page where there is no network, with the files that the page has kept (src/walk/offline.ts).
addEventListener('install', () => skipWaiting());
addEventListener('activate', (event) => event.waitUntil(clients.claim()));
addEventListener('fetch', (event) => {
  const { origin, pathname } = new URL(event.request.url);
  const isOfPage = pathname === '/walk' || pathname === '/favicon.svg' || pathname.startsWith('/assets/');
  if (origin !== location.origin || event.request.method !== 'GET' || !isOfPage) return;
  event.respondWith(fetch(event.request).catch(async () => (await caches.match(pathname)) ?? Response.error()));
});
