// Positions of finished tracks in a window of time, and where the targets spent it.
import type { FeatureCollection, Polygon } from 'geojson';
import { get, getAll } from './api';
import { failureOf, type Failure } from './failure';
import { boundsOf, roundLength, sideOf } from './geo';
import { tracksOf, type HistoryTrack } from './playback';
import { scopedPath, type Scope } from './scope';
import type { HistoryPosition, Position } from './types';

/** Positions that are read and kept; a window with more is shown from its beginning. */
const MOST_POSITIONS = 50_000;
const HEAT_CELLS_ACROSS = 60;
const LEAST_CELL_M = 0.5;

export interface HeatCell {
  corners: Position[];
  /** Share of the fullest cell. */
  share: number;
}

type HeatMap = FeatureCollection<Polygon, { seconds: number }>;

export class History {
  tracks = $state.raw<HistoryTrack[]>([]);
  heat = $state.raw<HeatCell[]>([]);
  count = $state(0);
  /** The end of what is shown, if the window has more, ms since 1970. */
  cutAt_ms = $state<number>();
  isReading = $state(false);
  error = $state.raw<Failure>();
  readonly #scope: Scope;
  #window: { from: string; until: string } | undefined;
  #reading: AbortController | undefined;

  constructor(scope: Scope) {
    this.#scope = scope;
  }

  /** Reads a window, page by page; one that is being read is given up. */
  async read(from_ms: number, until_ms: number): Promise<void> {
    this.close();
    const reading = (this.#reading = new AbortController());
    this.#window = { from: new Date(from_ms).toISOString(), until: new Date(until_ms).toISOString() };
    [this.isReading, this.error, this.heat] = [true, undefined, []];
    try {
      const path = scopedPath('/v1/history', this.#scope, this.#window);
      const positions = await getAll<HistoryPosition>(path, MOST_POSITIONS, reading.signal);
      this.tracks = tracksOf(positions);
      this.count = positions.length;
      this.cutAt_ms = positions.length < MOST_POSITIONS ? undefined : Date.parse(positions.at(-1)!.time);
    } catch (error) {
      if (reading.signal.aborted) return;
      this.error = failureOf(error);
    }
    this.isReading = false;
  }

  /** Reads where targets spent the window, in cells as large as what is shown asks for. */
  async readHeat(): Promise<void> {
    const bounds = boundsOf(this.tracks.flatMap(({ points }) => points.map(({ position }) => position)));
    if (!bounds) return;
    const cell_m = String(roundLength(Math.max(sideOf(bounds) / HEAT_CELLS_ACROSS, LEAST_CELL_M)));
    try {
      this.heat = cellsOf(await get<HeatMap>(scopedPath('/v1/history/heat-map', this.#scope, { ...this.#window, cell_m })));
    } catch (error) {
      this.error = failureOf(error);
    }
  }

  close(): void {
    this.#reading?.abort();
  }
}

function cellsOf({ features }: HeatMap): HeatCell[] {
  const most_s = Math.max(...features.map(({ properties }) => properties.seconds));
  return features.map(({ geometry, properties }) => {
    const corners = geometry.coordinates[0]!.map(([longitude_deg, latitude_deg]) => ({ longitude_deg, latitude_deg }) as Position);
    return { corners, share: properties.seconds / most_s };
  });
}
