// Coasts and borders of the world (Natural Earth 1:50 million), so that a map without tiles shows where on earth it is.
import { feature } from 'topojson-client';
import type { GeometryCollection, Topology } from 'topojson-specification';
import type { MultiPolygon, Polygon, Position as Coordinates } from 'geojson';
import outlines from 'world-atlas/countries-50m.json?url';
import { fade } from './draw';
import { CLOSEST_OUTLINES_ZOOM } from './geo';
import type { Draw } from './plane_layer';

/** A country in a world of side 1, with x to the east and y to the south. */
interface Country {
  path: Path2D;
  west: number;
  east: number;
  north: number;
  south: number;
}

/** The web's Mercator projection onto a world of side 1. */
export function onWorld([longitude_deg, latitude_deg]: Coordinates): { x: number; y: number } {
  const latitude_rad = (Math.min(Math.max(latitude_deg!, -85), 85) * Math.PI) / 180;
  return { x: longitude_deg! / 360 + 0.5, y: 0.5 - Math.log(Math.tan(Math.PI / 4 + latitude_rad / 2)) / (2 * Math.PI) };
}

function countryOf(geometry: Polygon | MultiPolygon): Country {
  const country: Country = { path: new Path2D(), west: 1, east: 0, north: 1, south: 0 };
  const polygons = geometry.type === 'Polygon' ? [geometry.coordinates] : geometry.coordinates;
  for (const ring of polygons.flat()) {
    ring.map(onWorld).forEach(({ x, y }, at) => {
      if (at === 0) country.path.moveTo(x, y);
      else country.path.lineTo(x, y);
      country.west = Math.min(country.west, x);
      country.east = Math.max(country.east, x);
      country.north = Math.min(country.north, y);
      country.south = Math.max(country.south, y);
    });
    country.path.closePath();
  }
  return country;
}

/** Reads the outlines from this server, once per map that shows them. */
export async function worldDraw(): Promise<Draw> {
  const world = (await (await fetch(outlines)).json()) as Topology<{ countries: GeometryCollection }>;
  const geometries = feature(world, world.objects.countries).features.map(({ geometry }) => geometry);
  const countries = geometries.filter((it) => it.type === 'Polygon' || it.type === 'MultiPolygon').map(countryOf);
  return ({ context, colors, width, height, world: { left_px, top_px, size_px } }) => {
    if (size_px > 256 * 2 ** CLOSEST_OUTLINES_ZOOM) return;
    context.fillStyle = fade(colors.muted, 0.13);
    context.strokeStyle = fade(colors.muted, 0.55);
    context.lineWidth = 1 / size_px;
    // The world repeats beyond the date line.
    for (let left = left_px - size_px; left < width; left += size_px) {
      if (left + size_px < 0) continue;
      context.save();
      context.translate(left, top_px);
      context.scale(size_px, size_px);
      for (const { path, west, east, north, south } of countries) {
        const isInView = left + east * size_px > 0 && left + west * size_px < width && top_px + south * size_px > 0 && top_px + north * size_px < height;
        if (!isInView) continue;
        context.fill(path, 'evenodd');
        context.stroke(path);
      }
      context.restore();
    }
  };
}
