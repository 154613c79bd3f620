// The recipes: ways to train a camera's model, as texts.ts describes them.
import { texts, type TextKey } from './texts';

const PREFIX = 'recipe.';

type NameOf<Key> = Key extends `${typeof PREFIX}${infer Name}` ? Name : never;

export type Recipe = NameOf<TextKey>;

export const RECIPES = Object.keys(texts.en)
  .filter((key) => key.startsWith(PREFIX))
  .map((key) => key.slice(PREFIX.length)) as Recipe[];
