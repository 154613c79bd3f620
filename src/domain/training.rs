//! Training runs and the model versions that they produce.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::job::{JobState, RunId};
use super::names::{CameraId, TargetId};
use super::recipe::Recipe;

/// The parameters of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrainingOptions {
    /// The recipe to fit.
    pub recipe: Recipe,
    /// The seed of all random numbers of the run.
    pub seed: u64,
    /// Epochs, from 1; `None` for the recipe's default.
    pub epochs: Option<u32>,
    /// Only samples from this instant on.
    pub from: Option<Timestamp>,
    /// Only samples before this instant.
    pub until: Option<Timestamp>,
}

/// The progress of a fit.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct RunProgress {
    /// The current phase: `held-out block 2 of 4`, `final fit`.
    pub phase: String,
    /// Epochs done, over all phases.
    pub epoch: u32,
    /// Epochs to do, over all phases.
    pub epochs: u32,
    /// eX of (2) in the latest epoch.
    pub reconstruction_error: f64,
    /// eZ of (3) in the latest epoch.
    pub regression_error: f64,
    /// Es of (4) so far.
    pub error_scale: f64,
    /// Estimated seconds left, from the mean duration of the epochs so far; `None` before the first.
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
    /// The camera whose model is fitted.
    pub camera_id: CameraId,
    /// The parameters.
    pub options: TrainingOptions,
    /// The job's state.
    pub state: JobState,
    /// The progress.
    pub progress: RunProgress,
    /// Times a worker has claimed it without returning it to the queue in order.
    pub attempt: u32,
    /// The model version that it produced.
    pub model_version: Option<u32>,
    /// Whether that version became active, and why or why not, or why the run failed.
    pub outcome: Option<String>,
    /// When it was requested.
    pub created_at: Timestamp,
    /// When a worker claimed it last.
    pub started_at: Option<Timestamp>,
    /// When it ended.
    pub ended_at: Option<Timestamp>,
}

/// The error of a fit on blocks of time that it had not seen.
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
    /// The same less the receiver's variance, at least 1 % of it: the regression's own error variance, m2.
    pub e_regression_m2: f64,
    /// Share of the fixes inside the 95 % radius that the variances of regression and receiver predict.
    pub coverage95_of_fixes: f64,
}

/// The error of a held-out sample: predicted by a fit that had not seen its block of time.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOutSampleError {
    /// The sample's time.
    pub time: Timestamp,
    /// The sample's target.
    pub target_id: TargetId,
    /// Distance from the predicted position to the sample's fix, m.
    pub distance_m: f64,
}

/// The scaling of one input: `(value - offset) * factor`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FeatureScale {
    /// `left_px`, `top_px`, `width_px`, `height_px`, `east_m`, ...
    pub feature: String,
    /// Is subtracted, in the feature's unit.
    pub offset: f64,
    /// Multiplies the difference.
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

/// The origin of the receiver's error variance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum GnssErrorSource {
    /// The camera's profile, or the fixes themselves.
    Profile,
    /// Estimated from the training samples.
    Estimated,
}

/// A candidate of the recipe, and its held-out error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CandidateReport {
    /// Name of the candidate.
    pub candidate: String,
    /// Its error on the held-out blocks.
    pub held_out: HeldOutError,
}

/// The description of a model version, beside its weights. This is a document format: it is stored,
/// downloaded and imported as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ModelMetadata {
    /// Version of this document, now 1.
    pub format: u32,
    /// The recipe that was requested.
    pub requested_recipe: String,
    /// The recipe that was fitted.
    pub recipe: String,
    /// Inputs of the encoder in their order, with their scaling.
    pub features: Vec<FeatureScale>,
    /// Origin of the local plane, or of the standardised degrees.
    pub origin: OriginDeg,
    /// Seed of the run.
    pub seed: u64,
    /// Epochs of the final fit.
    pub epochs: u32,
    /// SHA-256 of the training rows in their order, hexadecimal.
    pub training_rows_sha256: String,
    /// Samples that the final fit used.
    pub samples: u32,
    /// Targets among them.
    pub targets: u32,
    /// Passes among them: stretches of one target's time without a gap.
    pub passes: u32,
    /// Es of (4), or its robust form.
    pub error_scale: f64,
    /// The receiver's error variance per axis, m2.
    pub e_gnss_m2: f64,
    /// The origin of that variance.
    pub e_gnss_source: GnssErrorSource,
    /// Error on held-out blocks of time; `None` where the samples make too few blocks.
    pub held_out: Option<HeldOutError>,
    /// All candidates of the recipe, with their held-out errors.
    pub candidates: Vec<CandidateReport>,
    /// Names and values of the recipe's own scalars (noise floors, calibration factors).
    pub parameters: std::collections::BTreeMap<String, f64>,
}

/// An immutable model of one camera, without its weights.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelVersion {
    /// The camera.
    pub camera_id: CameraId,
    /// Counts from 1 per camera.
    pub number: u32,
    /// The run that produced it; `None` if it was imported.
    pub run_id: Option<RunId>,
    /// When it was stored.
    pub created_at: Timestamp,
    /// Size of the weights in bytes.
    pub weights_bytes: u64,
    /// The description.
    pub metadata: ModelMetadata,
}
