// A place as a form holds it, and as the interface takes it.
import type { Scope } from './scope';
import { slugOf } from './slug';
import type { EventKind, Place, PlaceGeometry, PlaceRule, Position } from './types';

export type Shape = PlaceGeometry['type'];

export interface RuleDraft {
  id: string;
  kind: EventKind;
  classes: string;
  after_s: number | null;
  speed_mps: number | null;
  distance_m: number | null;
  probability: number | null;
}

export interface PlaceDraft {
  id: string;
  display_name: string;
  shape: Shape;
  /** The outer ring without its repeated first corner, the points of a line, or a centre. */
  corners: Position[];
  /** Holes of a polygon, which stay as they came. */
  holes: [number, number][][];
  radius_m: number | null;
  probability: number;
  rules: RuleDraft[];
  /** Id of a place that is stored. */
  revision?: number;
}

/** Corners that a geometry needs at least. */
export const LEAST_CORNERS: Record<Shape, number> = { Polygon: 3, LineString: 2, Point: 1 };

const OF_AREAS: EventKind[] = ['enter', 'leave', 'dwell', 'speed_above', 'speed_below', 'appeared', 'lost', 'near', 'receiver_without_box', 'box_without_receiver'];
const OF_LINES: EventKind[] = ['cross', 'wrong_way', 'speed_above', 'speed_below'];
export const EVENT_KINDS: EventKind[] = [...new Set([...OF_AREAS, ...OF_LINES])];

/** The kinds of events that a geometry can have. */
export function kindsOf(shape: Shape): EventKind[] {
  return shape === 'LineString' ? OF_LINES : OF_AREAS;
}

export type Threshold = 'after_s' | 'speed_mps' | 'distance_m';
/** The threshold that a kind of rule needs. */
export const THRESHOLDS: Partial<Record<EventKind, Threshold>> = {
  dwell: 'after_s',
  receiver_without_box: 'after_s',
  box_without_receiver: 'after_s',
  speed_above: 'speed_mps',
  speed_below: 'speed_mps',
  near: 'distance_m',
};

const DEFAULT_PROBABILITY = 0.95;

export function newDraft(shape: Shape): PlaceDraft {
  const rules = (shape === 'LineString' ? (['cross'] as const) : (['enter', 'leave'] as const)).map((kind) => newRule(kind, []));
  return { id: '', display_name: '', shape, corners: [], holes: [], radius_m: shape === 'Point' ? 5 : null, probability: DEFAULT_PROBABILITY, rules };
}

/** A rule whose name no other rule has. */
export function newRule(kind: EventKind, others: { id: string }[]): RuleDraft {
  const base = kind.replaceAll('_', '-');
  let id: string = base;
  for (let number = 2; others.some((other) => other.id === id); number++) id = `${base}-${number}`;
  return { id, kind, classes: '', after_s: null, speed_mps: null, distance_m: null, probability: null };
}

const positionOf = ([longitude_deg, latitude_deg]: [number, number]): Position => ({ longitude_deg, latitude_deg });
const coordinatesOf = ({ longitude_deg, latitude_deg }: Position): [number, number] => [longitude_deg, latitude_deg];

/** The corners that can be moved: those of the outer ring, of the line, or the centre. */
export function cornersOf(geometry: PlaceGeometry): Position[] {
  if (geometry.type === 'Point') return [positionOf(geometry.coordinates)];
  if (geometry.type === 'LineString') return geometry.coordinates.map(positionOf);
  return (geometry.coordinates[0] ?? []).slice(0, -1).map(positionOf);
}

export function geometryOf({ shape, corners, holes }: Pick<PlaceDraft, 'shape' | 'corners' | 'holes'>): PlaceGeometry {
  const points = corners.map(coordinatesOf);
  if (shape === 'Point') return { type: 'Point', coordinates: points[0]! };
  if (shape === 'LineString') return { type: 'LineString', coordinates: points };
  return { type: 'Polygon', coordinates: [[...points, points[0]!], ...holes] };
}

export function draftOf({ id, display_name, geometry, radius_m, probability, rules, revision }: Place): PlaceDraft {
  return {
    id,
    display_name,
    shape: geometry.type,
    corners: cornersOf(geometry),
    holes: geometry.type === 'Polygon' ? geometry.coordinates.slice(1) : [],
    radius_m: radius_m ?? null,
    probability,
    rules: rules.map((rule) => ({ ...newRule(rule.kind, []), ...rule, classes: (rule.classes ?? []).join(', ') })),
    revision,
  };
}

function ruleOf({ id, kind, classes, probability, ...thresholds }: RuleDraft): PlaceRule {
  const named = classes.split(',').map((it) => it.trim()).filter(Boolean);
  const threshold = THRESHOLDS[kind];
  const value = threshold && thresholds[threshold];
  return {
    id,
    kind,
    ...(named.length > 0 ? { classes: named } : {}),
    ...(threshold && value !== null ? { [threshold]: value } : {}),
    ...(probability === null ? {} : { probability }),
  };
}

/** The changeable fields of a place. */
export function settingsOf(draft: PlaceDraft): object {
  return {
    display_name: draft.display_name || null,
    geometry: geometryOf(draft),
    radius_m: draft.shape === 'Point' ? draft.radius_m : null,
    probability: draft.probability,
    rules: draft.rules.map(ruleOf),
  };
}

const scopeField = ({ kind, id }: Scope): object => (kind === 'site' ? { site_id: id } : { camera_id: id });

export function createdOf(draft: PlaceDraft, scope: Scope): object {
  return { ...scopeField(scope), ...settingsOf(draft), id: draft.id || slugOf(draft.display_name) };
}

/** Places as GeoJSON (RFC 7946), as the server would write them. */
export function geojsonOf(places: Place[]): string {
  const features = places.map(({ id, geometry, ...properties }) => ({ type: 'Feature', id, geometry, properties }));
  return JSON.stringify({ type: 'FeatureCollection', features }, undefined, 1);
}

interface Feature {
  id?: string | number;
  geometry?: { type: string; coordinates: unknown };
  properties?: Record<string, unknown> | null;
}

/** The features of a GeoJSON file as places of the scope; whatever else their properties say is left out. */
export function importedOf(text: string, scope: Scope): { id: string }[] {
  const file = JSON.parse(text) as { type?: string; features?: Feature[] } & Feature;
  const features = file.type === 'FeatureCollection' ? (file.features ?? []) : [file];
  return features.map(({ id, geometry, properties }, at) => {
    const { display_name, name, labels, radius_m, probability, rules } = properties ?? {};
    const label = display_name ?? name ?? id;
    const named = typeof label === 'string' || typeof label === 'number' ? String(label) : '';
    const kept = Object.entries({ labels, radius_m, probability, rules }).filter(([, value]) => value !== undefined && value !== null);
    return {
      ...scopeField(scope),
      ...Object.fromEntries(kept),
      id: slugOf(String(id ?? named)) || `place-${at + 1}`,
      ...(named ? { display_name: named } : {}),
      geometry: geometry && { type: geometry.type, coordinates: flattened(geometry.coordinates) },
    };
  });
}

/** Coordinates without heights. */
function flattened(coordinates: unknown): unknown {
  if (!Array.isArray(coordinates)) return coordinates;
  return typeof coordinates[0] === 'number' ? coordinates.slice(0, 2) : coordinates.map(flattened);
}
