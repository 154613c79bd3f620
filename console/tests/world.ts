// Simulated cameras of one town, and what they see now.
import { execFileSync } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { BINARY, type Server } from './server';

export interface Row {
  time: string;
  target_id: string;
  box: { left_px: number; top_px: number; width_px: number; height_px: number };
  fix?: { longitude_deg: number; latitude_deg: number };
  truth?: { longitude_deg: number; latitude_deg: number };
}

export interface SimulatedCamera {
  csv: string;
  live: Row[];
}

/** Reads the columns that a row of the console's world needs. */
export function rowsOf(csv: string): Row[] {
  const [head, ...lines] = csv.trim().split(/\r?\n/);
  const names = head!.split(',').map((name) => name.replace(/_(px|deg)$/, ''));
  return lines.map((line) => {
    const cells = line.split(',');
    const cell = (name: string): string => cells[names.indexOf(name)] ?? '';
    const number = (name: string): number => Number(cell(name));
    return {
      time: cell('time'),
      target_id: cell('target_id'),
      box: { left_px: number('left'), top_px: number('top'), width_px: number('width'), height_px: number('height') },
      ...(cell('truth_longitude') ? { truth: { longitude_deg: number('truth_longitude'), latitude_deg: number('truth_latitude') } } : {}),
      ...(cell('longitude') ? { fix: { longitude_deg: number('longitude'), latitude_deg: number('latitude') } } : {}),
    };
  });
}

/** A camera on its own square of the town, moved there from the simulator's. */
export function simulate(seed: number, offset: [east_deg: number, north_deg: number] = [0, 0], samples = 400): SimulatedCamera {
  const folder = mkdtempSync(join(tmpdir(), 'sightfix-world-'));
  const [train, live] = [join(folder, 'train.csv'), join(folder, 'live.csv')];
  execFileSync(BINARY, ['simulate', 'square', '--out', train, '--samples', String(samples), '--targets', '2', '--seed', String(seed), '--camera-seed', String(seed), '--test-out', live, '--test-samples', '160'], { stdio: 'ignore' });
  const [csv, liveCsv] = [train, live].map((path) => moved(readFileSync(path, 'utf8'), offset)) as [string, string];
  rmSync(folder, { recursive: true });
  return { csv, live: rowsOf(liveCsv) };
}

function moved(csv: string, [east_deg, north_deg]: [number, number]): string {
  const [head, ...lines] = csv.trim().split(/\r?\n/);
  const names = head!.split(',');
  const shift = (name: string): number => (/longitude/.test(name) ? east_deg : /latitude/.test(name) ? north_deg : 0);
  const rows = lines.map((line) => {
    const cells = line.split(',');
    return cells.map((cell, at) => (cell && shift(names[at]!) !== 0 ? (Number(cell) + shift(names[at]!)).toFixed(8) : cell)).join(',');
  });
  return [head, ...rows].join('\n') + '\n';
}

/** A trained camera. */
export async function addCamera(server: Server, id: string, name: string, world: SimulatedCamera, labels: Record<string, string> = {}): Promise<void> {
  await server.request('POST', '/v1/cameras', { id, display_name: name, image_size: { width_px: 1280, height_px: 720 }, labels });
  await server.request('POST', `/v1/cameras/${id}/samples`, world.csv, 'text/csv');
  await server.train(id, { recipe: 'projective', epochs: 10 });
}

/** Lets people, numbered from the first on, walk in a camera's view until the returned function is called. */
export function walk(server: Server, id: string, rows: Row[], first = 1): () => void {
  const targets = [...new Set(rows.map((row) => row.target_id))];
  let step = 0;
  const timer = setInterval(() => {
    const time = new Date().toISOString();
    const observations = targets.flatMap((target, person) => {
      const own = rows.filter((row) => row.target_id === target);
      const row = own[(step + person * 40) % own.length]!;
      // The second has no receiver.
      return [{ time, target_id: `person-${first + person}`, bounding_box: row.box, ...(person === 0 && row.fix ? { fix: row.fix } : {}) }];
    });
    step += 1;
    void server.request('POST', `/v1/cameras/${id}/tracks`, { observations }).catch(() => undefined);
  }, 400);
  return () => clearInterval(timer);
}
