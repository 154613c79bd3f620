// A vector tile in the muted colours of the theme: what lies around the cameras, and no more.
import { drawPath, type Context, type Style } from './draw';

/** The parts of a decoded vector tile (Mapbox Vector Tile, version 2) that are drawn. */
export interface VectorLayers {
  layers: Record<string, VectorLayer>;
}
interface VectorLayer {
  length: number;
  extent: number;
  feature: (at: number) => VectorFeature;
}
interface VectorFeature {
  /** 1 for points, 2 for lines, 3 for polygons. */
  type: number;
  properties: Record<string, unknown>;
  loadGeometry: () => { x: number; y: number }[][];
}

export interface MapColors {
  water: string;
  green: string;
  building: string;
  road: string;
}

export function mapColors(): MapColors {
  const style = getComputedStyle(document.documentElement);
  const read = (name: string): string => style.getPropertyValue(`--map-${name}`).trim();
  return { water: read('water'), green: read('green'), building: read('building'), road: read('road') };
}

/** Where a tile is on a canvas, and how large a metre is there. */
export interface TilePlace {
  x: number;
  y: number;
  size_px: number;
  px_per_m: number;
}

const [LINE, POLYGON] = [2, 3];
const GREEN = /park|grass|forest|wood|garden|meadow|scrub|cemetery|pitch|recreation|nature|farm|orchard/;
/** Widths of ways in metres, by the words that the schemas of Protomaps and OpenMapTiles use. */
const WAY_WIDTHS_M: [RegExp, number][] = [
  [/motorway|highway|trunk/, 14],
  [/major|primary|secondary/, 10],
  [/path|footway|track|cycle|steps|pedestrian/, 2.5],
  [/rail|transit/, 3],
];
const OTHER_WAY_WIDTH_M = 6;

/** Layers from below to above, by the names that the same schemas use. */
const ORDER: [RegExp, (feature: VectorFeature, colors: MapColors, px_per_m: number) => Style | undefined][] = [
  [/^land(use|cover)$|^park$|^natural$/, ({ type, properties }, colors) => (type === POLYGON && GREEN.test(wordsOf(properties)) ? { fill: colors.green } : undefined)],
  [/^water|^physical_line$/, ({ type }, colors) => (type === POLYGON ? { fill: colors.water } : type === LINE ? { stroke: colors.water, width: 1.5 } : undefined)],
  [/^roads?$|^transportation$|^transit$/, ({ type, properties }, colors, px_per_m) => (type === LINE ? { stroke: colors.road, width: Math.min(Math.max(wayWidth_m(properties) * px_per_m, 0.6), 60) } : undefined)],
  [/^buildings?$/, ({ type }, colors) => (type === POLYGON ? { fill: colors.building } : undefined)],
];

function wordsOf(properties: Record<string, unknown>): string {
  return [properties.kind, properties.class, properties.subclass, properties.kind_detail].filter(Boolean).join(' ');
}

function wayWidth_m(properties: Record<string, unknown>): number {
  const words = wordsOf(properties);
  return WAY_WIDTHS_M.find(([known]) => known.test(words))?.[1] ?? OTHER_WAY_WIDTH_M;
}

export function drawVectorTile(context: Context, tile: VectorLayers, colors: MapColors, place: TilePlace): void {
  context.lineJoin = 'round';
  context.lineCap = 'round';
  for (const [name, styleOf] of ORDER) {
    for (const [, layer] of Object.entries(tile.layers).filter(([it]) => name.test(it))) {
      const scale = place.size_px / layer.extent;
      for (let at = 0; at < layer.length; at++) {
        const feature = layer.feature(at);
        const style = styleOf(feature, colors, place.px_per_m);
        if (!style) continue;
        const paths = feature.loadGeometry().map((path) => path.map(({ x, y }) => ({ x: place.x + x * scale, y: place.y + y * scale })));
        drawPath(context, paths, feature.type === POLYGON, style);
      }
    }
  }
}
