// The commands that ask the same as the try-it form.

export interface TriedObservation {
  time: string;
  bounding_box?: { left_px: number; top_px: number; width_px: number; height_px: number };
  fix?: { longitude_deg: number; latitude_deg: number; sigma_m?: number };
}

/** A JSON text within single quotes of a shell. */
function quoted(value: unknown): string {
  return `'${JSON.stringify(value).replaceAll("'", "'\\''")}'`;
}

/** The header that a server with keys asks for; the key itself stays in the shell's environment. */
const KEY = '-H "authorization: Bearer $SIGHTFIX_KEY" ';

export function curlLine(origin: string, camera: string, observation: TriedObservation, needsKey = false): string {
  return `curl -s ${needsKey ? KEY : ''}${origin}/v1/cameras/${camera}/fusions --json ${quoted(observation)}`;
}

export function grpcurlLine(origin: string, camera: string, observation: TriedObservation, needsKey = false): string {
  const url = new URL(origin);
  const plain = url.protocol === 'http:' ? '-plaintext ' : '';
  const host = url.port ? url.host : `${url.host}:${url.protocol === 'http:' ? 80 : 443}`;
  return `grpcurl ${plain}${needsKey ? KEY : ''}-d ${quoted({ camera_id: camera, observations: [observation] })} ${host} sightfix.v1.FusionService/Fuse`;
}

/** Starts the edge client for a camera. */
export function edgeLine(origin: string, camera: string, needsKey: boolean): string {
  const key = needsKey ? 'SIGHTFIX_API_KEY="$SIGHTFIX_KEY" ' : '';
  return `${key}sightfix-edge --source rtsp://camera.example.org/stream --camera ${camera} --server ${origin}`;
}

/** Saves the camera's samples and replays them to it, with their times shifted to now. */
export function replayLines(origin: string, camera: string, needsKey: boolean): string {
  const save = `curl -s ${needsKey ? KEY : ''}-H 'accept: text/csv' ${origin}/v1/cameras/${camera}/samples -o ${camera}.csv`;
  const key = needsKey ? 'SIGHTFIX_API_KEY="$SIGHTFIX_KEY" ' : '';
  return `${save}\n${key}sightfix replay ${camera}.csv --server ${origin} --camera ${camera} --shift-to-now`;
}
