// A small provider of OpenID Connect, whose page signs one person in, or not.
import { createHash, generateKeyPairSync, randomUUID, sign, type KeyObject } from 'node:crypto';
import { createServer, type IncomingMessage, type Server, type ServerResponse } from 'node:http';
import type { AddressInfo } from 'node:net';

export const CLIENT_ID = 'sightfix';

interface SignIn {
  nonce: string;
  challenge: string;
}

export class OpenIdProvider {
  /** Groups of the person who signs in next. */
  groups = ['site-operators'];
  url = '';
  readonly #key: KeyObject;
  readonly #publicKey: object;
  readonly #signIns = new Map<string, SignIn>();
  #server: Server | undefined;

  private constructor() {
    const { privateKey, publicKey } = generateKeyPairSync('ec', { namedCurve: 'P-256' });
    this.#key = privateKey;
    this.#publicKey = { ...publicKey.export({ format: 'jwk' }), kid: '1', use: 'sig' };
  }

  static async start(): Promise<OpenIdProvider> {
    const provider = new OpenIdProvider();
    await provider.#listen(0);
    return provider;
  }

  async stop(): Promise<void> {
    this.#server?.closeAllConnections();
    await new Promise((done) => this.#server?.close(done));
  }

  async #listen(port: number): Promise<void> {
    this.#server = createServer((request, response) => void this.#answer(request, response));
    await new Promise<void>((done) => this.#server!.listen(port, '127.0.0.1', done));
    this.url = `http://127.0.0.1:${(this.#server.address() as AddressInfo).port}`;
  }

  async #answer(request: IncomingMessage, response: ServerResponse): Promise<void> {
    const { pathname, searchParams } = new URL(request.url!, this.url);
    const json = (value: object): void => void response.setHeader('content-type', 'application/json').end(JSON.stringify(value));
    switch (pathname) {
      case '/.well-known/openid-configuration':
        return json({ issuer: this.url, authorization_endpoint: `${this.url}/authorize`, token_endpoint: `${this.url}/token`, jwks_uri: `${this.url}/keys` });
      case '/keys':
        return json({ keys: [this.#publicKey] });
      case '/authorize':
        return void response.setHeader('content-type', 'text/html').end(this.#page(searchParams));
      case '/token':
        return json(this.#token(new URLSearchParams(await bodyOf(request))));
      default:
        response.writeHead(404).end();
    }
  }

  /** The page at which the person signs in, or cancels. */
  #page(asked: URLSearchParams): string {
    const code = randomUUID();
    this.#signIns.set(code, { nonce: asked.get('nonce')!, challenge: asked.get('code_challenge')! });
    const back = (answer: Record<string, string>): string => `${asked.get('redirect_uri')}?${new URLSearchParams({ ...answer, state: asked.get('state')! })}`;
    const link = (url: string, text: string): string => `<p><a href="${url.replaceAll('&', '&amp;')}">${text}</a></p>`;
    return `<!doctype html><html lang="en"><link rel="icon" href="data:,"><title>Provider</title>${link(back({ code }), 'I am Ada')}${link(back({ error: 'access_denied' }), 'Cancel')}`;
  }

  #token(form: URLSearchParams): object {
    const signIn = this.#signIns.get(form.get('code')!);
    const challenge = createHash('sha256').update(form.get('code_verifier')!).digest('base64url');
    if (!signIn || signIn.challenge !== challenge) return { error: 'invalid_grant' };
    const now_s = Math.floor(Date.now() / 1000);
    const claims = { iss: this.url, sub: '7', aud: CLIENT_ID, iat: now_s, exp: now_s + 300, nonce: signIn.nonce, preferred_username: 'ada', groups: this.groups };
    const encode = (value: object): string => Buffer.from(JSON.stringify(value)).toString('base64url');
    const signed = `${encode({ alg: 'ES256', kid: '1' })}.${encode(claims)}`;
    const signature = sign('sha256', Buffer.from(signed), { key: this.#key, dsaEncoding: 'ieee-p1363' });
    return { id_token: `${signed}.${signature.toString('base64url')}`, token_type: 'Bearer' };
  }
}

async function bodyOf(request: IncomingMessage): Promise<string> {
  let text = '';
  for await (const part of request) text += String(part);
  return text;
}
