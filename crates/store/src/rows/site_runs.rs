//! Rows of training runs of sites, and what finishes them.

use super::models::NewModel;
use super::runs::ReadRun;
use crate::domain::{CameraId, CameraKey, Result, SiteId, SiteTrainingOptions, SiteTrainingReport};
use crate::jobs::{JobEnd, JobTable, SITE_RUNS};
use crate::query::Dialect;
use crate::row_decoder::RowDecoder;

/// The output of a run: a model for each camera, which are activated together or not at all.
#[derive(Debug, Clone, PartialEq)]
pub struct SiteRunOutput<'a> {
    /// The run's findings. The store enters the versions' numbers into its cameras, which are in the order of
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

impl ReadRun for SiteId {
    const JOBS: &'static JobTable = &SITE_RUNS;
    const KIND: &'static str = "site";
    const SUBJECTS: &'static str = "sites";
    const OPTIONS: &'static str = "runs.seed, runs.from_us, runs.until_us";

    fn results(_: Dialect) -> String {
        "CAST(NULL AS BIGINT), runs.report".to_owned()
    }

    fn read_subject(fields: &mut RowDecoder<'_>) -> Result<Self> {
        fields.parse(Self::new)
    }

    fn read_options(fields: &mut RowDecoder<'_>) -> Result<SiteTrainingOptions> {
        Ok(SiteTrainingOptions {
            seed: fields.get::<i64>()?.cast_unsigned(),
            from: fields.optional_timestamp()?,
            until: fields.optional_timestamp()?,
        })
    }

    fn read_report(fields: &mut RowDecoder<'_>) -> Result<Option<SiteTrainingReport>> {
        fields.parse_optional(serde_json::from_str)
    }
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
