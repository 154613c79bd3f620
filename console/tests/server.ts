// The real binary on a data folder of its own.
import { execFileSync, spawn, type ChildProcess } from 'node:child_process';
import { closeSync, mkdtempSync, openSync, rmSync, writeSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { createInterface } from 'node:readline';

export const BINARY = resolve(process.env.SIGHTFIX ?? '../target/debug/sightfix');

export class Server {
  readonly #folder = mkdtempSync(join(tmpdir(), 'sightfix-console-'));
  readonly #settings: Record<string, string>;
  readonly #flags: string[];
  readonly #binary: string;
  /** Whether the data folder is a disk of its own. */
  #hasDisk = false;
  #process: ChildProcess | undefined;
  url = '';

  private constructor(settings: Record<string, string>, flags: string[], binary: string) {
    this.#settings = settings;
    this.#flags = flags;
    this.#binary = binary;
  }

  /** `disk` is the size of a disk of its own for the data folder, such as `24m`; mounting it needs the superuser. */
  static async start(settings: Record<string, string> = {}, disk = '', listen = '127.0.0.1:0', flags: string[] = [], binary = BINARY): Promise<Server> {
    const server = new Server(settings, flags, binary);
    if (disk) {
      execFileSync('mount', ['-t', 'tmpfs', '-o', `size=${disk}`, 'tmpfs', server.#folder]);
      server.#hasDisk = true;
    }
    await server.run(listen);
    return server;
  }

  /** Starts the binary and waits until it listens. */
  async run(listen: string): Promise<void> {
    // Settings of whoever runs the tests are not the test's.
    const inherited = Object.fromEntries(Object.entries(process.env).filter(([name]) => !name.startsWith('SIGHTFIX_')));
    const child = spawn(this.#binary, ['serve', '--data', this.#folder, '--listen', listen, ...this.#flags], {
      env: { ...inherited, SIGHTFIX_LOG_FORMAT: 'json', ...this.#settings },
      stdio: ['ignore', 'ignore', 'pipe'],
      cwd: tmpdir(),
    });
    this.#process = child;
    const lines = createInterface({ input: child.stderr! });
    const log: string[] = [];
    this.url = await new Promise((done, fail) => {
      child.once('error', fail);
      child.once('exit', (code) => fail(new Error(`the server ended with ${code}: ${log.join('\n')}`)));
      lines.on('line', (line) => {
        log.push(line);
        const address = /"address":"([^"]+)"/.exec(line)?.[1];
        if (address) done(`http://${address}`);
      });
    });
  }

  /** Kills the server; `restart` brings it back at the same address. */
  async kill(): Promise<void> {
    const child = this.#process;
    if (!child || child.exitCode !== null) return;
    const ended = new Promise((done) => child.once('exit', done));
    child.kill('SIGKILL');
    await ended;
    this.#process = undefined;
  }

  async restart(): Promise<void> {
    await this.run(new URL(this.url).host);
  }

  /** Writes a file beside the data until nothing more fits. */
  fillDisk(): void {
    const file = openSync(join(this.#folder, 'filler'), 'w');
    try {
      for (const block of [Buffer.alloc(1 << 20), Buffer.alloc(4096)]) while (fits(file, block));
    } finally {
      closeSync(file);
    }
  }

  emptyDisk(): void {
    rmSync(join(this.#folder, 'filler'));
  }

  async stop(): Promise<void> {
    await this.kill();
    if (this.#hasDisk) execFileSync('umount', [this.#folder]);
    rmSync(this.#folder, { recursive: true, force: true });
  }

  async request<T>(method: string, path: string, body?: unknown, type = 'application/json', headers: Record<string, string> = {}): Promise<T> {
    const response = await fetch(this.url + path, {
      method,
      headers: body === undefined ? headers : { 'content-type': type, ...headers },
      ...(body === undefined ? {} : { body: typeof body === 'string' ? body : JSON.stringify(body) }),
    });
    const text = await response.text();
    if (!response.ok) throw new Error(`${method} ${path}: ${response.status} ${text}`);
    return (text ? JSON.parse(text) : undefined) as T;
  }

  /** Trains a camera and waits for the end. */
  async train(camera: string, draft: object): Promise<void> {
    const path = `/v1/cameras/${camera}/training-runs`;
    const { id } = await this.request<{ id: string }>('POST', path, draft);
    for (;;) {
      const run = await this.request<{ state: string; outcome?: string }>('GET', `${path}/${id}`);
      if (run.state === 'succeeded') return;
      if (run.state !== 'queued' && run.state !== 'running') throw new Error(`${run.state}: ${run.outcome}`);
      await new Promise((done) => setTimeout(done, 200));
    }
  }
}

/** Writes a block; false if the disk has no room for it. */
function fits(file: number, block: Buffer): boolean {
  try {
    return writeSync(file, block) === block.length;
  } catch (error) {
    if ((error as NodeJS.ErrnoException).code === 'ENOSPC') return false;
    throw error;
  }
}
