// A small PMTiles file (version 3) of one vector tile, which stands for all tiles of its zooms.
import { PbfWriter } from 'pbf';

const EXTENT = 4096;
/** Zooms of the file: tiles beyond the last are drawn from it. */
export const LAST_ZOOM = 14;

/** A tile that is water all over. */
function waterTile(): Uint8Array {
  const zigzag = (value: number): number => (value << 1) ^ (value >> 31);
  const [moveTo, lineTo, closePath] = [9, 26, 15];
  const geometry = [moveTo, zigzag(0), zigzag(0), lineTo, zigzag(EXTENT), zigzag(0), zigzag(0), zigzag(EXTENT), zigzag(-EXTENT), zigzag(0), closePath];
  const tile = new PbfWriter();
  tile.writeMessage(3, (_, layer) => {
    layer.writeVarintField(15, 2);
    layer.writeStringField(1, 'water');
    layer.writeMessage(2, (_, feature) => {
      feature.writeVarintField(3, 3);
      feature.writePackedVarint(4, geometry);
    }, undefined);
    layer.writeVarintField(5, EXTENT);
  }, undefined);
  return tile.finish();
}

export function pmtilesFile(): Buffer {
  const tile = waterTile();
  const tiles = (4 ** (LAST_ZOOM + 1) - 1) / 3;
  const directory = new PbfWriter();
  // One entry: its first tile, how many tiles it stands for, its length, and its offset plus one.
  for (const value of [1, 0, tiles, tile.length, 1]) directory.writeVarint(value);
  const root = directory.finish();
  const metadata = Buffer.from('{}');
  const header = Buffer.alloc(127);
  header.write('PMTiles');
  header.writeUInt8(3, 7);
  const at = { root: header.length, metadata: header.length + root.length, tiles: header.length + root.length + metadata.length };
  [at.root, root.length, at.metadata, metadata.length, at.tiles, 0, at.tiles, tile.length, tiles, 1, 1].forEach((value, index) => header.writeBigUInt64LE(BigInt(value), 8 + 8 * index));
  // Clustered, nothing compressed, vector tiles, zooms.
  Buffer.from([1, 1, 1, 1, 0, LAST_ZOOM]).copy(header, 96);
  [-180e7, -85e7, 180e7, 85e7].forEach((value, index) => header.writeInt32LE(value, 102 + 4 * index));
  return Buffer.concat([header, root, metadata, tile]);
}
