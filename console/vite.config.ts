import { resolve } from 'node:path';
import { svelte } from '@sveltejs/vite-plugin-svelte';
import { defineConfig } from 'vite';

// The server that a development or preview session of the console asks; the built console asks its own.
const server = process.env.SIGHTFIX_SERVER ?? 'http://127.0.0.1:8080';
const proxied = ['/v1', '/livez', '/readyz', '/metrics', '/docs', '/openapi.json'];
const proxy = Object.fromEntries(proxied.map((path) => [path, { target: server }]));
// The policy of src/http/console.rs, so that a preview refuses what the server's browsers would refuse.
const policy =
  "default-src 'none'; script-src 'self'; style-src 'self'; font-src 'self'; connect-src 'self'; " +
  "img-src 'self' data: blob:; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

export default defineConfig({
  plugins: [svelte()],
  build: {
    target: 'es2022',
    // A data URL would need a wider security policy.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    rollupOptions: { input: { index: resolve('index.html'), walk: resolve('walk.html') } },
  },
  // The names of columns are those of the importer.
  server: { proxy, fs: { allow: ['.', '../crates/exchange/src'] } },
  preview: { proxy, headers: { 'content-security-policy': policy } },
});
