// The site or the camera whose tracks a view is about.
export interface Scope {
  kind: 'site' | 'camera';
  id: string;
}

/** A path with the scope and further values as its query; values that are undefined or empty are left out. */
export function scopedPath(path: string, { kind, id }: Scope, values: Record<string, string | undefined> = {}): string {
  const query = new URLSearchParams({ [kind]: id });
  for (const [name, value] of Object.entries(values)) if (value) query.set(name, value);
  return `${path}?${query}`;
}
