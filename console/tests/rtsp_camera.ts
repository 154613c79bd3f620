// A camera's ONVIF metadata on GStreamer's RTSP server, which asks for digest authentication.
import { spawn, type ChildProcessByStdio } from 'node:child_process';
import { once } from 'node:events';
import { fileURLToPath } from 'node:url';
import type { Readable, Writable } from 'node:stream';
import { freePort } from './broker';

const SCRIPT = fileURLToPath(new URL('../../tests/it/outside/rtsp_server.py', import.meta.url));

export class RtspCamera {
  readonly address: string;
  readonly user = 'operator';
  readonly password = 'secret';
  readonly #process: ChildProcessByStdio<Writable, Readable, null>;

  private constructor(port: number) {
    this.address = `rtsp://127.0.0.1:${port}/onvif/metadata`;
    // Debian's Python has the bindings of GStreamer.
    this.#process = spawn('/usr/bin/python3', [SCRIPT, String(port), this.user, this.password], { stdio: ['pipe', 'pipe', 'ignore'] });
  }

  static async start(): Promise<RtspCamera> {
    const camera = new RtspCamera(await freePort());
    await once(camera.#process.stdout, 'data');
    return camera;
  }

  /** Sends XML documents without line breaks to those who play the stream. */
  send(documents: string[]): void {
    this.#process.stdin.write(documents.map((document) => document + '\n').join(''));
  }

  stop(): void {
    this.#process.kill('SIGKILL');
  }
}
