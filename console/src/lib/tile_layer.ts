// The tiles of a PMTiles file under a Leaflet map. Beyond the file's last zoom its tiles are drawn enlarged: cameras are
// looked at much closer than maps are made.
import { VectorTile } from '@mapbox/vector-tile';
import type * as L from 'leaflet';
import { PbfReader } from 'pbf';
import { PMTiles, TileType } from 'pmtiles';
import { metresPerPixel } from './geo';
import { drawVectorTile, mapColors, type TilePlace } from './vector_tile';

const TILE_PX = 256;
const MOST_DECODED = 48;

type Decoded = { image: ImageBitmap } | { vector: VectorTile } | undefined;

/** Decoded tiles of a file, the latest of them remembered. */
class Archive {
  readonly #file: PMTiles;
  readonly #decoded = new Map<string, Promise<Decoded>>();

  constructor(url: string) {
    this.#file = new PMTiles(new URL(url, location.href).href);
  }

  /** The tile that holds another one, and how many zooms it is above. */
  async holding({ x, y, z }: L.Coords): Promise<{ tile: Decoded; above: number }> {
    const { maxZoom, minZoom } = await this.#file.getHeader();
    const above = Math.max(0, z - maxZoom);
    if (z < minZoom) return { tile: undefined, above };
    const key = [z - above, x >> above, y >> above].join('/');
    let tile = this.#decoded.get(key);
    this.#decoded.delete(key);
    tile ??= this.#read(z - above, x >> above, y >> above);
    this.#decoded.set(key, tile);
    // A map remembers its keys in the order in which they were set.
    for (const oldest of this.#decoded.keys()) {
      if (this.#decoded.size <= MOST_DECODED) break;
      this.#decoded.delete(oldest);
    }
    return { tile: await tile, above };
  }

  async #read(z: number, x: number, y: number): Promise<Decoded> {
    const [{ tileType }, content] = [await this.#file.getHeader(), await this.#file.getZxy(z, x, y)];
    if (!content) return undefined;
    if (tileType === TileType.Mvt) return { vector: new VectorTile(new PbfReader(new Uint8Array(content.data))) };
    return { image: await createImageBitmap(new Blob([content.data])) };
  }
}

async function paint(canvas: HTMLCanvasElement, coords: L.Coords, archive: Archive): Promise<void> {
  const { tile, above } = await archive.holding(coords);
  const context = canvas.getContext('2d');
  if (!tile || !context) return;
  const times = 2 ** above;
  const size_px = TILE_PX * times;
  const latitude_rad = Math.atan(Math.sinh(Math.PI * (1 - (2 * (coords.y + 0.5)) / 2 ** coords.z)));
  const place: TilePlace = { x: -(coords.x % times) * TILE_PX, y: -(coords.y % times) * TILE_PX, size_px, px_per_m: 1 / metresPerPixel(latitude_rad, coords.z) };
  const ratio = canvas.width / TILE_PX;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  if ('image' in tile) context.drawImage(tile.image, place.x, place.y, size_px, size_px);
  else drawVectorTile(context, tile.vector, mapColors(), place);
}

export function pmtilesLayer(leaflet: typeof L, url: string, attribution: string): L.GridLayer {
  const archive = new Archive(url);
  class Layer extends leaflet.GridLayer {
    protected override createTile(coords: L.Coords, done: L.DoneCallback): HTMLElement {
      const canvas = document.createElement('canvas');
      canvas.width = canvas.height = TILE_PX * Math.ceil(window.devicePixelRatio || 1);
      paint(canvas, coords, archive).then(
        () => done(undefined, canvas),
        (error: Error) => done(error, canvas),
      );
      return canvas;
    }
  }
  return new Layer({ tileSize: TILE_PX, maxZoom: 25, attribution, keepBuffer: 1 });
}
