//! Training runs and the model versions they yield.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::job::{JobState, RunId};
use super::names::CameraId;
use super::recipe::Recipe;

/// What a run is asked to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrainingOptions {
    /// How to learn the camera.
    pub recipe: Recipe,
    /// Everything random in the run comes from it.
    pub seed: u64,
    /// Passes over the samples, from 1; `None` for the recipe's own number.
    pub epochs: Option<u32>,
    /// Only samples from this instant on.
    pub from: Option<Timestamp>,
    /// Only samples before this instant.
    pub until: Option<Timestamp>,
}

/// How far a fit has come.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct RunProgress {
    /// What is being done: `held-out block 2 of 4`, `final fit`.
    pub phase: String,
    /// Passes done, over all phases.
    pub epoch: u32,
    /// Passes to do, over all phases.
    pub epochs: u32,
    /// eX of (2) in the latest epoch.
    pub reconstruction_error: f64,
    /// eZ of (3) in the latest epoch.
    pub regression_error: f64,
    /// Es of (4) so far.
    pub error_scale: f64,
    /// Seconds left by the pace so far; `None` before there is one.
    pub remaining_s: Option<f64>,
}

/// One point of a run's curve: one epoch of the final fit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct EpochReport {
    /// From 1.
    pub epoch: u32,
    /// L of (1).
    pub loss: f64,
    /// eX of (2), mean over the samples.
    pub reconstruction_error: f64,
    /// eZ of (3), mean over the samples.
    pub regression_error: f64,
    /// Es of (4) over this epoch.
    pub error_scale: f64,
}

/// A training run as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingRun {
    /// The run's id.
    pub id: RunId,
    /// Whose model is fitted.
    pub camera_id: CameraId,
    /// What was asked for.
    pub options: TrainingOptions,
    /// Where it stands.
    pub state: JobState,
    /// How far it has come.
    pub progress: RunProgress,
    /// How often a worker has taken it up.
    pub attempt: u32,
    /// The version it yielded.
    pub model_version: Option<u32>,
    /// Whether that version became active, and why or why not, or why the run failed.
    pub outcome: Option<String>,
    /// When it was asked for.
    pub created_at: Timestamp,
    /// When a worker took it up last.
    pub started_at: Option<Timestamp>,
    /// When it ended.
    pub ended_at: Option<Timestamp>,
}

/// How well a fit foretold blocks of time that it had not seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct HeldOutError {
    /// Blocks of time that were held out in turn.
    pub blocks: u32,
    /// Samples in them.
    pub samples: u32,
    /// Mean horizontal distance in m from the regressed position to the (noisy) fix.
    pub mean_to_fix_m: f64,
    /// Mean square per axis of that distance, m2.
    pub error_to_fix_m2: f64,
    /// The same less the receiver's own variance, floored: the regression's own error, m2.
    pub e_regression_m2: f64,
    /// Share of the fixes inside the radius that regression and receiver together foretell for 95 %.
    pub coverage95_of_fixes: f64,
}

/// One input of the network: what is subtracted, then what it is multiplied by.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FeatureScale {
    /// `left_px`, `top_px`, `width_px`, `height_px`, `east_m`, ...
    pub feature: String,
    /// Subtracted first.
    pub offset: f64,
    /// Multiplied then.
    pub factor: f64,
}

/// A position in the metadata document.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct OriginDeg {
    /// Degrees east.
    pub longitude_deg: f64,
    /// Degrees north.
    pub latitude_deg: f64,
}

/// Where the receiver's error came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum GnssErrorSource {
    /// The camera's profile, or the fixes themselves.
    Profile,
    /// Estimated from the training samples.
    Estimated,
}

/// A recipe that was tried, and its held-out error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CandidateReport {
    /// The recipe or its variant.
    pub candidate: String,
    /// Its error on the held-out blocks.
    pub held_out: HeldOutError,
}

/// All that a model version says of itself beside its weights. This is a document format: it is
/// stored, downloaded and imported as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ModelMetadata {
    /// Version of this document, now 1.
    pub format: u32,
    /// The recipe that was asked for.
    pub requested_recipe: String,
    /// The recipe that was fitted.
    pub recipe: String,
    /// Inputs of the encoder in their order, with their scaling.
    pub features: Vec<FeatureScale>,
    /// Origin of the local plane, or of the standardised degrees.
    pub origin: OriginDeg,
    /// Seed of the run.
    pub seed: u64,
    /// Passes of the final fit.
    pub epochs: u32,
    /// SHA-256 of the training rows in their order, hexadecimal.
    pub training_rows_sha256: String,
    /// Samples that the final fit used.
    pub samples: u32,
    /// Targets among them.
    pub targets: u32,
    /// Passes (stretches of time without a hole) among them.
    pub passes: u32,
    /// Es of (4), or its robust form.
    pub error_scale: f64,
    /// The receiver's error variance per axis, m2.
    pub e_gnss_m2: f64,
    /// Where that came from.
    pub e_gnss_source: GnssErrorSource,
    /// Error on held-out blocks of time; `None` where the samples make too few blocks.
    pub held_out: Option<HeldOutError>,
    /// What was tried beside it.
    pub candidates: Vec<CandidateReport>,
    /// Names and values of the recipe's own scalars (noise floors, calibration factors).
    pub parameters: std::collections::BTreeMap<String, f64>,
}

/// An immutable model of one camera, without its weights.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelVersion {
    /// Whose.
    pub camera_id: CameraId,
    /// Counts from 1 per camera.
    pub number: u32,
    /// The run that yielded it; `None` if it was imported.
    pub run_id: Option<RunId>,
    /// When it was stored.
    pub created_at: Timestamp,
    /// Size of the weights in bytes.
    pub weights_bytes: u64,
    /// What it says of itself.
    pub metadata: ModelMetadata,
}
