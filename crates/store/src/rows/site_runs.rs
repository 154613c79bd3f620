//! Rows of training runs of sites, and what finishes them.

use uuid::Uuid;

use super::models::NewModel;
use crate::domain::{
    CameraId, CameraKey, Error, ErrorKind, Result, RunId, RunProgress, SiteId, SiteTrainingOptions,
    SiteTrainingReport, SiteTrainingRun,
};
use crate::jobs::{JobEnd, read_state};
use crate::refusals::no_run;
use crate::row_decoder::{RowDecoder, StoredRow};

/// The output of a run: a model for each camera, which are activated together or not at all.
#[derive(Debug, Clone, PartialEq)]
pub struct SiteRunOutput<'a> {
    /// What the run found out. The store enters the versions' numbers into its cameras, which are in the order of
    /// the models.
    pub report: SiteTrainingReport,
    /// The fitted models.
    pub models: Vec<SiteCameraOutput<'a>>,
}

/// The model of one camera.
#[derive(Debug, Clone, PartialEq)]
pub struct SiteCameraOutput<'a> {
    /// The camera.
    pub camera: &'a CameraId,
    /// Which one of those that had this id.
    pub key: CameraKey,
    /// The active version that the new one was compared with.
    pub compared_with: Option<u32>,
    /// The model.
    pub model: NewModel<'a>,
}

/// How a worker finishes a run of a site.
pub type SiteRunEnd<'a> = JobEnd<SiteRunOutput<'a>>;

macro_rules! select_site_runs {
    ($rest:literal) => {
        concat!(
            "SELECT runs.id, sites.id, runs.seed, runs.from_us, runs.until_us, ",
            $crate::jobs::job_state!("runs"),
            ", runs.attempt, runs.phase, runs.epoch_done, runs.epochs_planned, runs.reconstruction_error, \
             runs.regression_error, runs.error_scale, runs.remaining_s, runs.outcome, runs.created_at_us, \
             runs.started_at_us, runs.ended_at_us, runs.report \
             FROM site_training_runs AS runs JOIN sites ON sites.key = runs.site_key ",
            $rest
        )
    };
}

pub(crate) use select_site_runs;

pub(crate) fn read_site_run(row: &StoredRow) -> Result<SiteTrainingRun> {
    let mut fields = RowDecoder::new("site_training_runs", row);
    Ok(SiteTrainingRun {
        id: RunId(fields.parse(Uuid::parse_str)?),
        site_id: fields.parse(SiteId::new)?,
        options: SiteTrainingOptions {
            seed: fields.get::<i64>()?.cast_unsigned(),
            from: fields.optional_timestamp()?,
            until: fields.optional_timestamp()?,
        },
        state: fields.parse(read_state)?,
        attempt: fields.count()?,
        progress: RunProgress {
            phase: fields.get()?,
            epoch: fields.count()?,
            epochs: fields.count()?,
            reconstruction_error: fields.nullable_f64()?,
            regression_error: fields.nullable_f64()?,
            error_scale: fields.nullable_f64()?,
            remaining_s: fields.get()?,
        },
        outcome: fields.get()?,
        created_at: fields.timestamp()?,
        started_at: fields.optional_timestamp()?,
        ended_at: fields.optional_timestamp()?,
        report: fields.parse_optional(serde_json::from_str::<SiteTrainingReport>)?,
    })
}

/// The run, if it is one of that site.
pub(crate) fn site_run_of(
    found: Option<SiteTrainingRun>,
    site: &SiteId,
    run: RunId,
) -> Result<SiteTrainingRun> {
    found.filter(|found| found.site_id == *site).ok_or_else(|| no_run(run))
}

/// A site has one live run at most.
pub(crate) fn check_no_live_site_run(live: Option<String>) -> Result<()> {
    let Some(live) = live else { return Ok(()) };
    let message = format!("the site has training run {live}, which has not ended; wait for it or cancel it");
    Err(Error::conflict(ErrorKind::RunLive, live, message))
}

/// Refuses to cancel a run that has ended.
pub(crate) fn check_site_run_not_ended(run: &SiteTrainingRun) -> Result<()> {
    if !run.state.has_ended() {
        return Ok(());
    }
    let ended = format!("the training run has ended already: {}", run.state.as_str());
    Err(Error::refused(ErrorKind::RunEnded, ended))
}

/// Why a camera's model cannot be stored with those of the others, if it cannot. `stored` are the keys of the camera's
/// site and the number of its active version; `None` if the camera was deleted.
pub(crate) fn conflict_of(
    output: &SiteCameraOutput<'_>,
    stored: Option<(Option<i64>, Option<i64>)>,
    site_key: i64,
) -> Option<String> {
    let camera = output.camera;
    match stored {
        Some((site, _)) if site != Some(site_key) => {
            Some(format!("camera {camera} has left the site while the site was trained; start another run"))
        }
        None => Some(format!("camera {camera} was deleted while the site was trained; start another run")),
        Some((_, active)) if active != output.compared_with.map(i64::from) => Some(format!(
            "another version of camera {camera} became active while the site was trained; start another run, which \
             compares with it"
        )),
        Some(_) => None,
    }
}
