//! Training runs over all cameras of a site.

use std::fmt;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// The parameters of a training run of a site.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SiteTrainingOptions {
    /// Seed of all randomness in the run.
    pub seed: u64,
    /// Use only samples from this instant on.
    pub from: Option<Timestamp>,
    /// Use only samples before this instant.
    pub until: Option<Timestamp>,
}

/// The findings of a training run of a site. Everything but the counts is measured on receivers that the fits had not
/// seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SiteTrainingReport {
    /// True if the versions of all cameras were activated; otherwise none was.
    pub is_activated: bool,
    /// Receivers that the cameras were trained on.
    pub receivers: u32,
    /// Pairs of boxes of one receiver's carrier in two cameras at one time.
    pub pairs: u32,
    /// Mean distance between the positions of such a pair by cameras that were trained together, m; missing where
    /// no two cameras see a receiver at one time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub disagreement_m: Option<f64>,
    /// The same by cameras that were trained one by one, by maps of the same form, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub disagreement_apart_m: Option<f64>,
    /// The cameras by id.
    pub cameras: Vec<SiteCameraFinding>,
}

/// The findings of a site's training run about one camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SiteCameraFinding {
    /// The camera.
    pub camera_id: String,
    /// The version that the run produced for it.
    pub model_version: u32,
    /// Samples that it was trained on.
    pub samples: u32,
    /// Mean distance of the held-out fixes from the regressed positions, m.
    pub held_out_m: f64,
    /// The same where each camera is trained alone, by a map of the same form, m; missing where it could not be.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out_apart_m: Option<f64>,
    /// Share of the held-out fixes inside the 95 % radius stated for regression and receiver together.
    pub coverage95_of_fixes: f64,
    /// How it compares with the version that was active.
    pub comparison: String,
}

impl fmt::Display for SiteTrainingReport {
    /// Lines of text, the last without an end.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for SiteCameraFinding {
            camera_id, model_version, held_out_m, held_out_apart_m, comparison, ..
        } in &self.cameras
        {
            let apart = held_out_apart_m.map_or(String::new(), |apart_m| format!(" ({apart_m:.2} m alone)"));
            writeln!(
                f,
                "{camera_id}: version {model_version}, {held_out_m:.2} m from held-out fixes{apart}; {comparison}"
            )?;
        }
        write!(f, "{} receivers, {} pairs of boxes", self.receivers, self.pairs)?;
        if let (Some(together_m), Some(apart_m)) = (self.disagreement_m, self.disagreement_apart_m) {
            write!(
                f,
                "; the cameras disagree by {together_m:.2} m on held-out pairs, by {apart_m:.2} m if trained one by one"
            )?;
        }
        Ok(())
    }
}
