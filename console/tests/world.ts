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

/** Samples of the cameras `c1` and `c2`, whose views overlap: the boxes of those who carry a receiver, with its fixes. */
export function simulateSite(walkers: number, duration_s: number): Record<string, string> {
  const folder = mkdtempSync(join(tmpdir(), 'sightfix-site-'));
  const scene = ['--cameras', '2', '--walkers', String(walkers), '--vehicles', '0', '--receivers', '1', '--duration-s', String(duration_s)];
  execFileSync(BINARY, ['simulate', 'site', '--out', folder, ...scene], { stdio: 'ignore' });
  const cells = (name: string): string[][] => readFileSync(join(folder, name), 'utf8').trim().split(/\r?\n/).slice(1).map((line) => line.split(','));
  // The columns of each file are in docs/explanation/world-tracks.md; `phone-3` is carried by `person-3`.
  const people = new Map(cells('identity.csv').map(([camera, id, person]) => [`${camera} ${id}`, person!]));
  const fixes = new Map(cells('fixes.csv').map(([time, receiver, ...position]) => [`${time} ${receiver!.replace('phone', 'person')}`, position]));
  const samplesOf = (camera: string): string => {
    const rows = cells(`detections_${camera}.csv`).flatMap(([time, id, left, top, width, height]) => {
      const person = people.get(`${camera} ${id}`);
      const position = fixes.get(`${time} ${person}`);
      return position ? [[time, person, left, top, width, height, ...position].join(',')] : [];
    });
    return ['time,target_id,left,top,width,height,longitude,latitude', ...rows].join('\n');
  };
  const samples = Object.fromEntries(['c1', 'c2'].map((camera) => [camera, samplesOf(camera)]));
  rmSync(folder, { recursive: true });
  return samples;
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
