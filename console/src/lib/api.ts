// The client of the public REST interface. Every refusal is a problem by RFC 9457.
import { connection, session } from './connection.svelte';
import { t } from './i18n.svelte';
import type { Page } from './types';

export class ApiProblem extends Error {
  readonly status: number;
  readonly type: string;
  readonly violations: { field: string; message: string }[];
  readonly traceId: string;

  constructor(status: number, body: Record<string, unknown>) {
    super(String(body.detail ?? body.title ?? `HTTP ${status}`));
    this.status = status;
    this.type = String(body.type ?? '');
    this.violations = (body.violations as ApiProblem['violations']) ?? [];
    this.traceId = String(body.trace_id ?? '');
  }

  /** The sentence for the operator, with the fields at fault. */
  get text(): string {
    const fields = this.violations.map((it) => `${it.field}: ${it.message}`).filter((it) => it !== this.message);
    return fields.length > 0 && !this.message.includes(fields[0]!) ? fields.join('; ') : this.message;
  }
}

export class ServerUnreachable extends Error {}

interface Options {
  body?: unknown;
  headers?: Record<string, string>;
  accept?: string;
  signal?: AbortSignal;
}

async function send(method: string, path: string, options: Options): Promise<Response> {
  const headers: Record<string, string> = { accept: options.accept ?? 'application/json', ...options.headers };
  let body: BodyInit | undefined;
  if (options.body instanceof Blob || options.body instanceof FormData || typeof options.body === 'string') {
    body = options.body;
  } else if (options.body !== undefined) {
    body = JSON.stringify(options.body);
    headers['content-type'] = 'application/json';
  }
  let response: Response;
  try {
    response = await fetch(path, { method, headers, body, signal: options.signal ?? null });
  } catch (error) {
    if (options.signal?.aborted) throw error;
    connection.lose();
    throw new ServerUnreachable(t('connection.unreachable'));
  }
  connection.regain();
  if (response.ok) return response;
  if (response.status === 401) session.required = true;
  const problem = await response.json().catch(() => ({}));
  throw new ApiProblem(response.status, problem as Record<string, unknown>);
}

export async function get<T>(path: string, options: Options = {}): Promise<T> {
  return (await send('GET', path, options)).json() as Promise<T>;
}

export async function getText(path: string, options: Options = {}): Promise<string> {
  return (await send('GET', path, { accept: 'text/plain', ...options })).text();
}

export async function post<T>(path: string, body?: unknown, options: Options = {}): Promise<T> {
  const response = await send('POST', path, { ...options, body });
  return (response.status === 204 ? undefined : await response.json()) as T;
}

/** Pauses before an import is sent again when the server cannot be reached. */
const RETRY_AFTER_MS = [500, 2_000, 5_000];

/** Posts once, however often it must be sent: the server gives what comes under the same key one answer. */
export async function postOnce<T>(path: string, body: unknown, options: Options): Promise<T> {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  const key = Array.from(bytes, (byte) => byte.toString(16).padStart(2, '0')).join('');
  const headers = { ...options.headers, 'idempotency-key': key };
  for (const pause_ms of RETRY_AFTER_MS) {
    try {
      return await post<T>(path, body, { ...options, headers });
    } catch (error) {
      if (!(error instanceof ServerUnreachable)) throw error;
      await new Promise((resolve) => setTimeout(resolve, pause_ms));
    }
  }
  return post<T>(path, body, { ...options, headers });
}

export async function put<T>(path: string, body: unknown): Promise<T> {
  return (await send('PUT', path, { body })).json() as Promise<T>;
}

/** Puts a file, under its own type. */
export async function putFile(path: string, file: Blob): Promise<void> {
  await send('PUT', path, { body: file, headers: { 'content-type': file.type } });
}

/** Has the server make a file. */
export async function fetchFile(path: string): Promise<Blob> {
  return (await send('POST', path, { accept: '*/*' })).blob();
}

/** A file; undefined where there is none (204). */
export async function blob(path: string): Promise<Blob | undefined> {
  const response = await send('GET', path, { accept: '*/*' });
  return response.status === 204 ? undefined : response.blob();
}

export async function patch<T>(path: string, body: unknown, revision: number): Promise<T> {
  const headers = { 'if-match': `"${revision}"`, 'content-type': 'application/merge-patch+json' };
  return (await send('PATCH', path, { body: JSON.stringify(body), headers })).json() as Promise<T>;
}

/** Deletes; a profile only at the revision that the operator saw. */
export async function del(path: string, revision?: number): Promise<void> {
  await send('DELETE', path, revision === undefined ? {} : { headers: { 'if-match': `"${revision}"` } });
}

/** All pages of a list, up to a number of items. */
export async function getAll<T>(path: string, most: number, signal?: AbortSignal): Promise<T[]> {
  const items: T[] = [];
  let cursor: string | undefined;
  do {
    const url = new URL(path, location.origin);
    url.searchParams.set('limit', String(Math.min(1000, most - items.length)));
    if (cursor) url.searchParams.set('cursor', cursor);
    const page: Page<T> = await get(url.pathname + url.search, signal ? { signal } : {});
    items.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor && items.length < most);
  return items;
}

/** A path below a camera. */
export function cameraPath(camera: string, ...rest: string[]): string {
  return ['/v1/cameras', ...[camera, ...rest].map(encodeURIComponent)].join('/');
}

/** A path below a site. */
export function sitePath(site: string, ...rest: string[]): string {
  return ['/v1/sites', ...[site, ...rest].map(encodeURIComponent)].join('/');
}

export function download(name: string, content: Blob | string, type = 'text/csv'): void {
  const url = URL.createObjectURL(typeof content === 'string' ? new Blob([content], { type }) : content);
  const link = document.createElement('a');
  link.href = url;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}
