// The places of a site or a camera.
import { del, getAll, patch, post } from './api';
import { failureOf, type Failure } from './failure';
import { createdOf, importedOf, settingsOf, type PlaceDraft } from './place_draft';
import { scopedPath, type Scope } from './scope';
import type { Place } from './types';

/** Places that are listed and drawn. */
const MOST_PLACES = 20_000;
/** Refusals of an import that are shown. */
const MOST_REFUSALS = 20;

/** A place's own path. */
export function placePath(id: string, ...rest: string[]): string {
  return ['/v1/places', ...[id, ...rest].map(encodeURIComponent)].join('/');
}

export interface ImportOutcome {
  stored: number;
  refused: number;
  refusals: { id: string; failure: Failure }[];
}

export class Places {
  items = $state.raw<Place[]>([]);
  error = $state.raw<Failure>();
  readonly #scope: Scope;

  constructor(scope: Scope) {
    this.#scope = scope;
  }

  async refresh(): Promise<void> {
    try {
      this.items = await getAll<Place>(scopedPath('/v1/places', this.#scope), MOST_PLACES);
      this.error = undefined;
    } catch (error) {
      this.error = failureOf(error);
    }
  }

  /** Creates a place, or changes the one that the draft was made of. */
  async save(draft: PlaceDraft): Promise<Place> {
    const saved = await (draft.revision === undefined
      ? post<Place>('/v1/places', createdOf(draft, this.#scope))
      : patch<Place>(placePath(draft.id), settingsOf(draft), draft.revision));
    await this.refresh();
    return saved;
  }

  async remove({ id, revision }: Place): Promise<void> {
    await del(placePath(id), revision);
    await this.refresh();
  }

  /** Creates the features of a GeoJSON file; what is refused does not keep out the others. */
  async import(text: string): Promise<ImportOutcome> {
    const outcome: ImportOutcome = { stored: 0, refused: 0, refusals: [] };
    for (const feature of importedOf(text, this.#scope)) {
      try {
        await post('/v1/places', feature);
        outcome.stored += 1;
      } catch (error) {
        outcome.refused += 1;
        if (outcome.refusals.length < MOST_REFUSALS) outcome.refusals.push({ id: feature.id, failure: failureOf(error) });
      }
    }
    await this.refresh();
    return outcome;
  }
}
