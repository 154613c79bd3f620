// A real mosquitto of the test's own, and its clients.
import { execFileSync, spawn, type ChildProcess } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { createServer, connect, type AddressInfo } from 'node:net';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { createInterface } from 'node:readline';

/** A topic of the test's own. */
const READY = 'test/ready';

export async function freePort(): Promise<number> {
  const server = createServer();
  await new Promise<void>((done) => server.listen(0, '127.0.0.1', done));
  const { port } = server.address() as AddressInfo;
  await new Promise((done) => server.close(done));
  return port;
}

function answers(port: number): Promise<boolean> {
  return new Promise((done) => {
    const socket = connect(port, '127.0.0.1', () => (socket.destroy(), done(true)));
    socket.on('error', () => done(false));
  });
}

export class Broker {
  readonly port: number;
  readonly #folder: string;
  readonly #processes: ChildProcess[];

  private constructor(port: number, folder: string, process: ChildProcess) {
    [this.port, this.#folder, this.#processes] = [port, folder, [process]];
  }

  static async start(): Promise<Broker> {
    const [port, folder] = [await freePort(), mkdtempSync(join(tmpdir(), 'sightfix-broker-'))];
    const settings = join(folder, 'mosquitto.conf');
    // As the superuser it would become another user, who cannot read the folder.
    writeFileSync(settings, `user root\nlistener ${port} 127.0.0.1\nallow_anonymous true\n`);
    const process = spawn('mosquitto', ['-c', settings], { stdio: 'ignore' });
    while (!(await answers(port))) await new Promise((done) => setTimeout(done, 50));
    return new Broker(port, folder, process);
  }

  get address(): string {
    return `mqtt://127.0.0.1:${this.port}`;
  }

  /** Publishes each line with QoS 1, in their order. */
  publish(topic: string, lines: string[]): void {
    if (lines.length === 0) return;
    execFileSync('mosquitto_pub', ['-h', '127.0.0.1', '-p', String(this.port), '-q', '1', '-t', topic, '-l'], { input: lines.join('\n') + '\n' });
  }

  /** The messages of some topics from now on, by their topics. */
  async subscribe(topics: string[]): Promise<[topic: string, payload: string][]> {
    const flags = [...topics, READY].flatMap((topic) => ['-t', topic]);
    const process = spawn('mosquitto_sub', ['-h', '127.0.0.1', '-p', String(this.port), '-q', '1', '-v', ...flags], { stdio: ['ignore', 'pipe', 'ignore'] });
    this.#processes.push(process);
    const messages: [string, string][] = [];
    let isReady = false;
    createInterface({ input: process.stdout }).on('line', (line) => {
      const [topic] = line.split(' ', 1);
      if (topic === READY) isReady = true;
      else messages.push([topic!, line.slice(topic!.length + 1)]);
    });
    // The client does not say when it has subscribed.
    while (!isReady) {
      this.publish(READY, ['']);
      await new Promise((done) => setTimeout(done, 100));
    }
    return messages;
  }

  stop(): void {
    this.#processes.forEach((process) => process.kill('SIGKILL'));
    rmSync(this.#folder, { recursive: true, force: true });
  }
}
