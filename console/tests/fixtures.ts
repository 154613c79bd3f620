// A page that fails its test on any console error and on any request to somebody else.
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { expect, test as base, type Page } from '@playwright/test';
import { Server } from './server';

interface Fixtures {
  /** Settings of the test's server, from the environment. */
  settings: Record<string, string>;
  /** Size of the disk that its data folder has for itself; none if empty. */
  disk: string;
  /** Where the server listens; a free port if it is not named. */
  listen: string;
  /** Further flags of `sightfix serve`. */
  flags: string[];
  server: Server;
  /** Console errors that the test provokes on purpose. */
  allowed: RegExp;
  console: Page;
}

export const test = base.extend<Fixtures>({
  settings: [{}, { option: true }],
  allowed: [/^$/, { option: true }],
  disk: ['', { option: true }],
  listen: ['127.0.0.1:0', { option: true }],
  flags: [[], { option: true }],
  server: async ({ settings, disk, listen, flags }, use) => {
    const server = await Server.start(settings, disk, listen, flags);
    await use(server);
    await server.stop();
  },
  console: async ({ page, server, allowed }, use) => {
    const faults: string[] = [];
    const report = (text: string): void => {
      if (!allowed.test(text)) faults.push(text);
    };
    page.on('console', (message) => {
      // The tests' own reading of what a canvas shows.
      if (message.text().includes('willReadFrequently')) return;
      if (message.type() === 'error' || message.type() === 'warning') report(`${message.type()}: ${message.text()}`);
    });
    page.on('pageerror', (error) => report(`uncaught: ${error.message}`));
    page.on('request', (request) => {
      const url = request.url();
      if (!url.startsWith(server.url) && !/^(blob|data):/.test(url)) report(`foreign request: ${url}`);
    });
    page.on('response', (response) => {
      if (response.status() >= 500) report(`${response.status()} from ${response.url()}`);
    });
    if (process.env.CONSOLE_DIST) await serveFrom(page, server.url, process.env.CONSOLE_DIST);
    await page.goto(server.url);
    await use(page);
    expect(faults, 'console errors and foreign requests').toEqual([]);
  },
});

/** The console's files from a folder, for a build that the binary does not hold yet. */
async function serveFrom(page: Page, url: string, folder: string): Promise<void> {
  await page.route(
    ({ origin, pathname }) => origin === url && (pathname === '/' || pathname === '/walk' || /^\/(assets|favicon)/.test(pathname)),
    (route) => {
      const { pathname } = new URL(route.request().url());
      return route.fulfill({ path: `${folder}${pathname === '/' ? '/index.html' : pathname === '/walk' ? '/walk.html' : pathname}` });
    },
  );
  // Where a redirect leads is asked of the server itself; a page that goes on is routed.
  await page.route('**/v1/session/openid**', async (route) => {
    const response = await route.fetch({ maxRedirects: 0 });
    const { location } = response.headers();
    if (!location?.startsWith('/')) return route.fulfill({ response });
    const { location: _, ...headers } = response.headers();
    return route.fulfill({ status: 200, headers: { ...headers, 'content-type': 'text/html' }, body: `<script>location.replace('${location}')</script>` });
  });
}

const axe = readFileSync(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8');

interface Finding {
  id: string;
  nodes: { target: unknown; failureSummary?: string }[];
}

/** The findings of axe-core in what the page shows. */
export async function accessibilityFindings(page: Page): Promise<string[]> {
  await page.evaluate(axe);
  const findings = await page.evaluate(async () => {
    const { axe: library } = globalThis as unknown as { axe: { run: (options: object) => Promise<{ violations: Finding[] }> } };
    const tags = ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa', 'best-practice'];
    return (await library.run({ runOnly: tags } as object)).violations;
  });
  return findings.map(({ id, nodes }) => `${id}: ${nodes.map((node) => `${JSON.stringify(node.target)} ${node.failureSummary ?? ''}`).join('; ')}`);
}

export { expect };
