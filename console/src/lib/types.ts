// The shapes of the REST interface that the console reads (docs/openapi.json).
import type { Recipe } from './recipes';

export interface Position {
  longitude_deg: number;
  latitude_deg: number;
}
export interface Fix extends Position {
  sigma_m?: number | null;
}
export interface BoundingBox {
  left_px: number;
  top_px: number;
  width_px: number;
  height_px: number;
}
export interface ImageSize {
  width_px: number;
  height_px: number;
}
export type JobState = 'queued' | 'running' | 'cancelling' | 'succeeded' | 'failed' | 'cancelled';

/** True if a job has not ended. */
export function isLive(state: JobState): boolean {
  return state === 'queued' || state === 'running' || state === 'cancelling';
}
export type GnssError = 'unknown' | { sigma_m: number };

export interface Receiver {
  receiver_id: string;
  target_id?: string | null;
  clock_offset_s?: number;
  sigma_m?: number | null;
}
export interface CameraMoved {
  model_version: number;
  onset_at: string;
  raised_at: string;
  shift_east_m: number;
  shift_north_m: number;
  statistic: number;
  targets: number;
}
/** Where a still picture is fetched; the password is never shown. */
export interface SnapshotSource {
  url: string;
  username?: string;
}
/** How finished tracks are kept. */
export interface HistorySettings {
  keep_days: number;
  max_bytes: number;
  coarsen_m: number;
}
/** A point of the ground whose place in the image and on the earth is known. */
export interface KnownPoint {
  x_px: number;
  y_px: number;
  /** Null while it is not entered. */
  position: { longitude_deg: number | null; latitude_deg: number | null };
  sigma_m: number;
}

export interface Camera {
  id: string;
  display_name: string;
  image_size?: ImageSize;
  gnss_error: GnssError;
  recipe: Recipe;
  target_classes: string[];
  labels: Record<string, string>;
  receivers: Receiver[];
  /** Whose world tracks the camera contributes to. */
  site?: string;
  snapshot?: SnapshotSource;
  history?: HistorySettings;
  known_points: KnownPoint[];
  retrain_when_moved: boolean;
  learn_automatically: boolean;
  revision: number;
  created_at: string;
  updated_at: string;
  samples: number;
  samples_without_fix: number;
  location?: Position;
  gnss_bias_sigma_m?: number;
  active_model?: number;
  model_fault?: string;
  moved?: CameraMoved;
  warnings: string[];
}
/** How far a camera has come on its way to a model. */
export interface Learning {
  state: 'off' | 'recording' | 'matching' | 'training' | 'learned';
  message: string;
  recorded_s: number;
  needed_s: number;
  boxes: number;
  fixes: number;
  receivers: number;
  last_attempt?: { time: string; outcome: string };
  training_run?: string;
}
export interface CameraStatus {
  camera: Camera;
  latest_run?: { id: string; state: JobState };
  model?: { held_out_mean_to_fix_m?: number; median_r95_m: number; view_area: Position[] };
  targets: number;
  streams: number;
  last_observed_at?: string;
  frozen_since?: string;
}
export interface Page<T> {
  items: T[];
  next_cursor?: string;
}
export interface Sample {
  time: string;
  target_id: string;
  bounding_box: BoundingBox;
  /** Missing for a box that only shows the camera's geometry. */
  fix?: Fix | null;
  truth?: Position | null;
}
export interface RejectedRow {
  part?: string;
  line: number;
  field: string;
  reason: string;
}
export interface Imported {
  accepted: number;
  accepted_without_fix: number;
  duplicate: number;
  rejected: number;
  rejected_rows: RejectedRow[];
  warnings: string[];
}
export interface PairedSamples extends Imported {
  pairing: {
    detections: number;
    fixes: number;
    paired: number;
    unpaired_detections: Record<string, number>;
    unused_fixes: Record<string, number>;
  };
}
export interface RunProgress {
  phase: string;
  epoch: number;
  epochs: number;
  reconstruction_error: number | null;
  regression_error: number | null;
  error_scale: number | null;
  remaining_s?: number | null;
}
/** The fields of every training run, whether its subject is a camera or a site. */
interface Run {
  id: string;
  seed: number;
  from?: string;
  until?: string;
  state: JobState;
  progress: RunProgress;
  outcome?: string;
  created_at: string;
  started_at?: string;
  ended_at?: string;
}
export interface TrainingRun extends Run {
  camera_id: string;
  recipe: Recipe;
  epochs?: number;
  attempt: number;
  model_version?: number;
  /** Missing where the model came without a report. */
  report?: { advice: string[] };
}
/** How long a run that has ended took, s. */
export function ranFor({ started_at, ended_at }: { started_at?: string; ended_at?: string }): number | undefined {
  return started_at && ended_at ? (Date.parse(ended_at) - Date.parse(started_at)) / 1000 : undefined;
}
export interface SiteCameraFinding {
  camera_id: string;
  model_version: number;
  samples: number;
  held_out_m: number;
  held_out_apart_m?: number;
  coverage95_of_fixes: number;
  comparison: string;
}
export interface SiteTrainingRun extends Run {
  site_id: string;
  report?: {
    is_activated: boolean;
    receivers: number;
    pairs: number;
    disagreement_m?: number;
    disagreement_apart_m?: number;
    cameras: SiteCameraFinding[];
  };
}
export interface EpochReport {
  epoch: number;
  loss: number;
  reconstruction_error: number;
  regression_error: number;
  error_scale: number;
}
export interface HeldOutError {
  blocks: number;
  samples: number;
  mean_to_fix_m: number;
  error_to_fix_m2: number;
  e_regression_m2: number;
  coverage95_of_fixes: number;
}
export interface ModelVersion {
  camera_id: string;
  number: number;
  created_at: string;
  run_id?: string;
  weights_bytes: number;
  metadata: {
    recipe: Recipe;
    requested_recipe: Recipe;
    samples: number;
    targets: number;
    passes: number;
    epochs: number;
    seed: number;
    e_gnss_m2: number;
    e_gnss_source: string;
    held_out: HeldOutError | null;
    candidates: { candidate: string; held_out: HeldOutError }[];
    parameters: Record<string, number>;
  };
}
/** Covariance of a position's error, m2. */
export interface Covariance {
  east_m2: number;
  north_m2: number;
  east_north_m2: number;
}
export interface FusedFix {
  time: string;
  target_id?: string;
  fused: Position;
  regressed?: Position;
  gnss?: Fix;
  confidence_regression: number;
  confidence_gnss: number;
  e_regression_m2?: number;
  e_gnss_m2?: number;
  r95_m: number;
  covariance: Covariance;
  regressed_covariance?: Covariance;
  reconstruction_error?: number;
  model_version?: number;
  flags: string[];
}
/** Speed and course; intervals of 95 %. */
export interface Motion {
  speed_mps: number;
  speed_interval_mps: [number, number];
  course_deg?: number;
  course_interval_deg?: [number, number];
  stationary_probability: number;
}
/** The receiver that a target carries, as association found it. */
export interface ReceiverMatch {
  receiver_id: string;
  probability: number;
}
export interface TrackFeature {
  geometry: { coordinates: [number, number] };
  properties: Motion & {
    target_id: string;
    time: string;
    velocity_east_m_s: number;
    velocity_north_m_s: number;
    r95_m: number;
    covariance: Covariance;
    nis?: number;
    rejections: { source: string; reason: string; nis?: number }[];
    restarted: boolean;
    receiver_match?: ReceiverMatch | null;
  };
}
export interface TrackUpdate extends TrackFeature {
  bounding_box?: BoundingBox;
  fused?: FusedFix;
}
/** A box of a camera without a model. */
export interface SeenBox {
  time: string;
  target_id?: string;
  tracker_id?: string;
  bounding_box: BoundingBox;
  class?: string;
  score?: number;
}
export interface ImagePoint {
  x_px: number;
  y_px: number;
}
export interface ErrorFigures {
  n: number;
  mean_m: number;
  median_m: number;
  rmse_m: number;
  p95_m: number;
  max_m: number;
  coverage50?: number | null;
  coverage95?: number | null;
  share_within: Record<string, number>;
}
export interface Evaluation {
  id: string;
  camera_id: string;
  methods: string[];
  seeds: number;
  state: JobState;
  progress: { phase: string; steps: number; steps_done: number; remaining_s?: number | null };
  outcome?: string;
  created_at: string;
  ended_at?: string;
  truth_point?: Position;
  truth_line?: [number, number][];
  report?: EvaluationReport | null;
}
export interface EvaluatedPosition extends Position {
  error_m?: number;
  r95_m?: number;
  truth_longitude_deg?: number;
  truth_latitude_deg?: number;
}
export interface EvaluationReport {
  methods: Record<string, ErrorFigures>;
  failed?: Record<string, string>;
  positions?: Record<string, EvaluatedPosition[]>;
}
export interface ServerInfo {
  version: string;
  limits: Record<string, number>;
  /** True if the answers of the server are simulated. */
  demonstration: boolean;
  tiles?: Tiles;
  /** Tiles of another server, which is asked once the user agrees. */
  offered_tiles?: Tiles;
}
export interface Tiles {
  url: string;
  format: 'images' | 'pmtiles';
  attribution: string;
}
export type Role = 'viewer' | 'edge' | 'operator' | 'admin';
export interface Session {
  role: Role;
  name?: string;
  open_access: boolean;
}
export interface AuditEntry {
  number: number;
  time: string;
  actor: string;
  address?: string;
  request_id?: string;
  /** The kind of event, such as `camera-created`. */
  action: string;
  subject?: string;
  camera_id?: string;
}
export interface ApiKey {
  id: string;
  name: string;
  role: Role;
  camera_ids: string[];
  created_at: string;
  expires_at?: string;
  last_used_at?: string;
  revoked_at?: string;
}
export type ConnectionState = 'paused' | 'connecting' | 'running' | 'waiting';
export interface LastMessage {
  time: string;
  subject: string;
  text: string;
  reading: string[];
}
export interface ConnectionStatus {
  state: ConnectionState;
  since?: string;
  last_error?: { time: string; message: string };
  last_message?: LastMessage;
  messages: number;
  items: number;
  skipped: number;
  rejected: number;
  dropped: number;
  acknowledged: number;
  connects: number;
  queued: number;
  dead_letters: number;
  reasons: { reason: string; count: number; example: string; last_at: string }[];
  lag_s?: number;
}
/** Where messages come from, or go to. */
export interface ConnectionSettings {
  address: string;
  format: string;
  topics?: string[];
  topic?: string;
  username?: string;
  cameras?: Record<string, { camera_id: string; area?: ImagePoint[] }>;
  camera_ids?: string[];
  receiver_id?: string;
  classes?: string[];
  least_score?: number;
  store_samples?: boolean;
  min_interval_s?: number;
}
export interface Connection {
  id: string;
  display_name: string;
  paused: boolean;
  source?: ConnectionSettings;
  sink?: ConnectionSettings;
  secret_names: string[];
  revision: number;
  created_at: string;
  status: ConnectionStatus;
}
export interface DeadLetter {
  number: number;
  id: string;
  subject: string;
  text: string;
  created_at: string;
  reason: string;
}
export interface Site {
  id: string;
  display_name: string;
  cameras: number;
  history?: HistorySettings;
  revision: number;
}
/** A target of a site, over all of its cameras. */
export interface WorldTrack extends Motion {
  id: string;
  /** Once a receiver is known. */
  target_id?: string;
  time: string;
  started_at: string;
  velocity_east_m_s: number;
  velocity_north_m_s: number;
  covariance: Covariance;
  r95_m: number;
  sightings: { camera_id: string; tracker_id?: string; last_seen_at: string }[];
  receiver_match?: ReceiverMatch | null;
  position: Position;
}
export interface WorldTrackFeature {
  geometry: { coordinates: [number, number] };
  properties: Omit<WorldTrack, 'position'>;
}
/** A geometry of GeoJSON that a place can have. */
export type PlaceGeometry =
  | { type: 'Polygon'; coordinates: [number, number][][] }
  | { type: 'LineString'; coordinates: [number, number][] }
  | { type: 'Point'; coordinates: [number, number] };
export type EventKind =
  | 'enter'
  | 'leave'
  | 'dwell'
  | 'cross'
  | 'wrong_way'
  | 'speed_above'
  | 'speed_below'
  | 'appeared'
  | 'lost'
  | 'near'
  | 'receiver_without_box'
  | 'box_without_receiver';
/** Which events are made of what happens at a place. */
export interface PlaceRule {
  id: string;
  kind: EventKind;
  classes?: string[];
  after_s?: number;
  speed_mps?: number;
  distance_m?: number;
  probability?: number;
}
/** An area or a line on the ground. */
export interface Place {
  id: string;
  site_id?: string;
  camera_id?: string;
  display_name: string;
  labels: Record<string, string>;
  geometry: PlaceGeometry;
  radius_m?: number;
  probability: number;
  rules: PlaceRule[];
  revision: number;
}
export interface PlaceEvent extends Position {
  /** The same whenever the event is delivered again. */
  id: string;
  kind: EventKind;
  place_id: string;
  rule_id: string;
  time: string;
  time_sigma_s: number;
  probability: number;
  track_id: string;
  target_id?: string;
  class?: string;
  speed_mps: number;
  speed_sigma_mps: number;
  direction?: 'left_to_right' | 'right_to_left';
  dwell_s?: number;
  other_track_id?: string;
  distance_m?: number;
  distance_sigma_m?: number;
}
/** A number of things; the interval holds the true number with 95 % probability. */
export interface CountFigure {
  count: number;
  expected: number;
  interval: [number, number];
}
export interface Quantile {
  percent: number;
  value: number;
  interval: [number, number];
}
export interface PlaceFigures {
  enters: CountFigure;
  leaves: CountFigure;
  left_to_right: CountFigure;
  right_to_left: CountFigure;
  mean_occupancy: number;
  dwell_s: Quantile[];
  speed_mps: Quantile[];
  /** Crossings of a line by the line that the target crossed before. */
  origins: Record<string, number>;
}
export interface PlaceStatistics {
  occupancy: CountFigure;
  total: PlaceFigures;
  /** Those in which something was counted, oldest first. */
  intervals: (PlaceFigures & { from: string })[];
}
/** A position of a finished track. */
export interface HistoryPosition extends Motion {
  time: string;
  track_id: string;
  target_id?: string;
  class?: string;
  position: Position;
  covariance: Covariance;
}
