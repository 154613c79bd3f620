// Writes a gzip and a brotli form beside every built file that becomes smaller by it. With --check it compares the
// forms that are there with their files: their bytes differ between versions of zlib, their content does not.
import { existsSync, readdirSync, readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { brotliCompressSync, brotliDecompressSync, constants, gunzipSync, gzipSync } from 'node:zlib';

const folder = new URL('../dist/', import.meta.url).pathname;
const isCheck = process.argv.includes('--check');

for (const entry of readdirSync(folder, { recursive: true, withFileTypes: true })) {
  if (!entry.isFile() || /\.(woff2|png|gz|br)$/.test(entry.name)) continue;
  const path = join(entry.parentPath ?? entry.path, entry.name);
  const content = readFileSync(path);
  if (isCheck) check(path, content);
  else compress(path, content);
}

function compress(path, content) {
  const brotli = brotliCompressSync(content, {
    params: { [constants.BROTLI_PARAM_QUALITY]: 11, [constants.BROTLI_PARAM_SIZE_HINT]: content.length },
  });
  const gzip = gzipSync(content, { level: 9 });
  if (gzip.length < content.length) writeFileSync(`${path}.gz`, gzip);
  if (brotli.length < content.length) writeFileSync(`${path}.br`, brotli);
}

function check(path, content) {
  for (const [ending, decompress] of [['gz', gunzipSync], ['br', brotliDecompressSync]]) {
    const compressed = `${path}.${ending}`;
    if (existsSync(compressed) && !decompress(readFileSync(compressed)).equals(content)) {
      console.error(`${compressed} is not ${path} compressed`);
      process.exitCode = 1;
    }
  }
}
