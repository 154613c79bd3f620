// Coordinate systems of georeferenced images, by their EPSG codes.
import proj4 from 'proj4';
import type { ToPosition } from './georeference';

const WGS84 = 'EPSG:4326';
const WEB_MERCATOR = 'EPSG:3857';

/** First code of a series of UTM zones, its zones, and its definition beside the zone. */
const UTM: [number, number, number, string][] = [
  [32601, 1, 60, '+datum=WGS84'],
  [32701, 1, 60, '+south +datum=WGS84'],
  // ETRS89 is WGS 84 to less than a metre.
  [25828, 28, 38, '+ellps=GRS80'],
];

/** Degrees (WGS 84, ETRS89), the web's Mercator projection, and zones of UTM; undefined for another system. */
export function systemOf(epsg: number): ToPosition | undefined {
  const definition = definitionOf(epsg);
  return definition ? inverse(definition) : undefined;
}

/** The system of a world file, which does not state it: degrees, else metres of the web's Mercator projection. */
export function guessedSystem(x: number, y: number): ToPosition {
  return inverse(Math.abs(x) <= 180 && Math.abs(y) <= 90 ? WGS84 : WEB_MERCATOR);
}

function definitionOf(epsg: number): string | undefined {
  if (epsg === 4326 || epsg === 4258) return WGS84;
  if (epsg === 3857 || epsg === 3785) return WEB_MERCATOR;
  for (const [first, zone, last, rest] of UTM) {
    if (epsg >= first && epsg - first <= last - zone) return `+proj=utm +zone=${zone + epsg - first} ${rest}`;
  }
  return undefined;
}

function inverse(definition: string): ToPosition {
  const converter = proj4(definition, WGS84);
  return (x, y) => {
    const [longitude_deg, latitude_deg] = converter.forward([x, y]) as [number, number];
    return { longitude_deg, latitude_deg };
  };
}
