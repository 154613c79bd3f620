//! Training runs and the model versions they produce.

use std::fmt;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::job::{JobState, RunId};
use super::names::{CameraId, SiteId, TargetId};
use super::recipe::Recipe;
use super::site_training::{SiteTrainingOptions, SiteTrainingReport};

/// The parameters of a training run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrainingOptions {
    /// Recipe to train.
    pub recipe: Recipe,
    /// Seed of all randomness in the run.
    pub seed: u64,
    /// Number of epochs, from 1; `None` for the recipe's default.
    pub epochs: Option<u32>,
    /// Use only samples from this instant on.
    pub from: Option<Timestamp>,
    /// Use only samples before this instant.
    pub until: Option<Timestamp>,
}

/// Progress of a fit.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct RunProgress {
    /// Current phase: `held-out group 2 of 4`, `final fit`.
    pub phase: String,
    /// Completed epochs, over all phases. The map of a recipe that has no network counts as some.
    pub epoch: u32,
    /// Total epochs, over all phases.
    pub epochs: u32,
    /// eX of (2) in the latest epoch.
    pub reconstruction_error: f64,
    /// eZ of (3) in the latest epoch.
    pub regression_error: f64,
    /// Es of (4) so far.
    pub error_scale: f64,
    /// Estimated remaining time, s; `None` before the first epoch.
    pub remaining_s: Option<f64>,
}

/// One point of a run's learning curve: one epoch of the final fit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct EpochReport {
    /// Number of the epoch, from 1.
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

/// The subject of a training run: a camera, or all cameras of a site together.
pub trait TrainingSubject {
    /// The parameters of its runs.
    type Options: fmt::Debug + Clone + PartialEq + Send + Sync + 'static;
    /// The findings of its runs.
    type Report: fmt::Debug + Clone + PartialEq + Send + Sync + 'static;
}

impl TrainingSubject for CameraId {
    type Options = TrainingOptions;
    type Report = TrainingReport;
}

impl TrainingSubject for SiteId {
    type Options = SiteTrainingOptions;
    type Report = SiteTrainingReport;
}

/// A training run as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingRun<S: TrainingSubject> {
    /// The run's id.
    pub id: RunId,
    /// The camera or the site to train.
    pub subject: S,
    /// The parameters.
    pub options: S::Options,
    /// State of the job.
    pub state: JobState,
    /// Progress of the fit; for a site its epochs count fits of all cameras and epochs of networks.
    pub progress: RunProgress,
    /// Number of times that a worker has claimed it without returning it to the queue in order.
    pub attempt: u32,
    /// The model version it produced; `None` for a site, whose report has those of its cameras.
    pub model_version: Option<u32>,
    /// The run's findings: for a camera while the version that it produced is stored, for a site once it has
    /// succeeded.
    pub report: Option<S::Report>,
    /// Says if the run's versions were activated and why, or why the run failed.
    pub outcome: Option<String>,
    /// Time of creation.
    pub created_at: Timestamp,
    /// Time of the latest claim by a worker.
    pub started_at: Option<Timestamp>,
    /// Time of completion.
    pub ended_at: Option<Timestamp>,
}

/// Prediction error on whole targets, or on blocks of time where one target has nearly all samples, held out of the fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct HeldOutError {
    /// Number of groups of targets, or of blocks of time, that were held out in turn.
    pub blocks: u32,
    /// Samples in those blocks.
    pub samples: u32,
    /// Mean horizontal distance in m from the regressed position to the (noisy) fix.
    pub mean_to_fix_m: f64,
    /// Mean square per axis of that distance, m2.
    pub error_to_fix_m2: f64,
    /// That less the receiver's variance, bounded below: the regression's own error variance, m2.
    pub e_regression_m2: f64,
    /// Share of the fixes inside the 95 % radius predicted for regression and receiver together.
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

/// Scaling of one input of the network: `(value - offset) * factor`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FeatureScale {
    /// `left_px`, `top_px`, `width_px`, `height_px`, `east_m`, ...
    pub feature: String,
    /// Subtracted from the value.
    pub offset: f64,
    /// Multiplies the difference.
    pub factor: f64,
}

/// A position in the metadata document.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct OriginDeg {
    /// Longitude, degrees east.
    pub longitude_deg: f64,
    /// Latitude, degrees north.
    pub latitude_deg: f64,
}

/// Source of the receiver's error variance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum GnssErrorSource {
    /// The camera's profile, or the sigma of the fixes.
    Profile,
    /// Estimated from the training samples.
    Estimated,
}

/// A candidate of the model selection, and its held-out error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CandidateReport {
    /// Name of the candidate.
    pub candidate: String,
    /// Its error on the held-out blocks.
    pub held_out: HeldOutError,
}

/// The findings of a run about one candidate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CandidateFinding {
    /// Name of the candidate.
    pub candidate: String,
    /// Share of the model's answers that it has, 0 to 1; all candidates together have 1.
    pub weight: f64,
    /// Mean distance of the held-out fixes from the regressed positions, m.
    pub held_out_miss_m: f64,
    /// Share of the held-out fixes inside the 95 % radius stated for regression and receiver together.
    pub coverage95_of_fixes: f64,
    /// Why it has its weight, in words.
    pub summary: String,
}

/// The candidate that a training run kept, its errors, and advice to reduce them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainingReport {
    /// One per candidate, in the order in which they were tried.
    pub candidates: Vec<CandidateFinding>,
    /// Measures that would reduce the error, one sentence each.
    pub advice: Vec<String>,
}

impl fmt::Display for TrainingReport {
    /// Lines of text, the last without an end.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for CandidateFinding { candidate, held_out_miss_m, coverage95_of_fixes, summary, .. } in
            &self.candidates
        {
            let percent = 100.0 * coverage95_of_fixes;
            writeln!(
                f,
                "{candidate}: {held_out_miss_m:.2} m from held-out fixes, {percent:.1} % of them inside the \
                 stated radius; {summary}"
            )?;
        }
        write!(f, "What would help:")?;
        self.advice.iter().try_for_each(|line| write!(f, "\n- {line}"))
    }
}

/// The site training run that made a model version: its map's error is correlated with those of the other cameras'
/// versions of the same run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct JointTraining {
    /// The site.
    pub site_id: String,
    /// The run.
    pub run_id: String,
    /// The cameras, in the order of the weights.
    pub cameras: Vec<String>,
}

/// Metadata of a model version: all but its weights. This is a document format: it is stored,
/// downloaded and imported as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ModelMetadata {
    /// Version of this document, now 1.
    pub format: u32,
    /// The requested recipe.
    pub requested_recipe: String,
    /// The recipe that was fitted.
    pub recipe: String,
    /// Inputs of the encoder in order, with their scaling.
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
    /// Traverses (gap-free sequences of one target) among them.
    pub passes: u32,
    /// Es of (4), or its robust form.
    pub error_scale: f64,
    /// The receiver's error variance per axis, m2.
    pub e_gnss_m2: f64,
    /// Source of that variance.
    pub e_gnss_source: GnssErrorSource,
    /// Error on held-out blocks of time; `None` if the samples form too few blocks.
    pub held_out: Option<HeldOutError>,
    /// The candidates of the model selection.
    pub candidates: Vec<CandidateReport>,
    /// The run's findings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub report: Option<TrainingReport>,
    /// The run that trained it together with the other cameras of its site, if one did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint_training: Option<JointTraining>,
    /// Names and values of the recipe's scalar parameters (noise floors, calibration factors).
    pub parameters: std::collections::BTreeMap<String, f64>,
}

/// An immutable model of one camera, without its weights.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelVersion {
    /// The camera.
    pub camera_id: CameraId,
    /// Version number, from 1 per camera.
    pub number: u32,
    /// The run that produced it; `None` if it was imported.
    pub run_id: Option<RunId>,
    /// Time of storage.
    pub created_at: Timestamp,
    /// Size of the weights, bytes.
    pub weights_bytes: u64,
    /// The metadata.
    pub metadata: ModelMetadata,
}
