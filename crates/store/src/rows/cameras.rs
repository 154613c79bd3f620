//! Rows of cameras.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::domain::{
    Camera, CameraId, CameraKey, CameraMoved, ClockOffset, Error, ErrorKind, ExpectedVersion, GnssBiasSigma,
    GnssError, ImageSize, ModelMetadata, NewCamera, Receiver, ReceiverId, Receivers, Result, Revision,
    SampleCount, SigmaM, SiteId, TargetClass, TargetId,
};
use crate::refusals::unknown_site;
use crate::row_decoder::{RowDecoder, StoredRow};

/// Which camera there is, and in which state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraVersion {
    /// Its id.
    pub id: CameraId,
    /// Which one of those that had this id.
    pub key: CameraKey,
    /// Revision of its profile.
    pub revision: Revision,
    /// Its active model version.
    pub active_model: Option<u32>,
}

/// Until where changes of cameras have been read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChangeMark(pub(crate) u64);

/// Which cameras there are, or what has changed among them.
#[derive(Debug)]
pub struct CameraVersions {
    /// Those that have changed, and maybe some that have not; or all.
    pub versions: Vec<CameraVersion>,
    /// Those that were deleted; `None` where `versions` has all that there are.
    pub deleted: Option<Vec<(CameraId, CameraKey)>>,
    /// The mark to ask with next; `None` on a store that reads all in any case.
    pub upto: Option<ChangeMark>,
}

/// All that is needed to answer for a camera, of one moment.
pub struct CameraContent {
    /// Its profile.
    pub camera: Camera,
    /// The pose change that was detected with its active model.
    pub moved: Option<CameraMoved>,
    /// Metadata and weights of its active model, or why they cannot be used.
    pub model: Option<Result<(ModelMetadata, Vec<u8>)>>,
}

/// Columns: id, key, revision, active model.
pub(crate) fn read_version(row: &StoredRow) -> Result<CameraVersion> {
    let mut fields = RowDecoder::new("cameras", row);
    Ok(CameraVersion {
        id: fields.parse(CameraId::new)?,
        key: CameraKey(fields.get()?),
        revision: fields.revision()?,
        active_model: fields.optional_count()?,
    })
}

/// Columns to select, in the order of [`read_camera`].
macro_rules! camera_columns {
    () => {
        "key, id, display_name, image_width_px, image_height_px, gnss_sigma_m, gnss_bias_sigma_m, recipe, \
         target_classes, labels, receivers, retrain_when_moved, learn_automatically, revision, created_at_us, \
         updated_at_us, active_model, (SELECT samples FROM sample_counts WHERE camera_key = key) AS samples_with_fix, \
         (SELECT without_fix FROM sample_counts WHERE camera_key = key) AS samples_without_fix, \
         (SELECT sites.id FROM sites WHERE sites.key = site_key) AS site"
    };
}

pub(crate) fn check_version(camera: &Camera, expected: Option<ExpectedVersion>) -> Result<()> {
    expected.map_or(Ok(()), |expected| expected.check("camera", camera.key, camera.revision))
}

/// Refuses a stored camera whose site was looked up and not found.
pub(crate) fn check_site(stored: &Camera, wanted: &NewCamera) -> Result<()> {
    match &wanted.site {
        Some(site) if stored.profile.site.is_none() => Err(unknown_site(site)),
        _ => Ok(()),
    }
}

pub(crate) fn read_camera(row: &StoredRow) -> Result<Camera> {
    let mut fields = RowDecoder::new("cameras", row);
    let key = CameraKey(fields.get()?);
    let id = fields.parse(CameraId::new)?;
    let display_name = fields.get()?;
    let width_px = fields.optional_count()?;
    let height_px = fields.optional_count()?;
    let image_size = width_px.zip(height_px).map(|(width, height)| ImageSize::new(width, height)).transpose();
    let image_size = fields.checked(image_size)?;
    let gnss_error = fields.parse_optional(SigmaM::new)?.map_or(GnssError::Unknown, GnssError::Known);
    let gnss_bias_sigma = fields.parse_optional(GnssBiasSigma::new)?;
    let recipe = fields.parse(|name: &str| name.parse())?;
    let target_classes = fields.parse(read_classes)?;
    let labels = fields.parse(serde_json::from_str::<BTreeMap<String, String>>)?;
    let receivers = fields.parse(read_receivers)?;
    let retrain_when_moved = fields.get()?;
    let learn_automatically = fields.get()?;
    let revision = fields.revision()?;
    let (created_at, updated_at) = (fields.timestamp()?, fields.timestamp()?);
    let active_model = fields.optional_count()?;
    let mut samples = || fields.parse(|stored: Option<i64>| u64::try_from(stored.unwrap_or_default()));
    let (with_fix, without_fix) = (samples()?, samples()?);
    let samples = SampleCount { all: with_fix + without_fix, without_fix };
    let site = fields.parse_optional(SiteId::new)?;
    let profile = NewCamera {
        id,
        display_name,
        image_size,
        gnss_error,
        gnss_bias_sigma,
        recipe,
        target_classes,
        labels,
        receivers,
        retrain_when_moved,
        learn_automatically,
        site,
    };
    Ok(Camera { key, profile, revision, created_at, updated_at, active_model, samples })
}

fn read_classes(json: &str) -> Result<Vec<TargetClass>> {
    let names: Vec<String> = serde_json::from_str(json).map_err(Error::fault)?;
    names.iter().map(|name| TargetClass::new(name)).collect()
}

/// A receiver as it is stored.
#[derive(Serialize, Deserialize)]
struct StoredReceiver {
    receiver_id: String,
    target_id: String,
    clock_offset_us: i64,
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma_m: Option<f64>,
}

pub(crate) fn write_receivers(receivers: &Receivers) -> Result<String> {
    let stored = receivers.iter().map(|receiver| StoredReceiver {
        receiver_id: receiver.receiver_id.as_str().to_owned(),
        target_id: receiver.target_id.as_str().to_owned(),
        clock_offset_us: receiver.clock_offset.microseconds(),
        sigma_m: receiver.sigma.map(SigmaM::metres),
    });
    serde_json::to_string(&stored.collect::<Vec<_>>()).map_err(Error::fault)
}

fn read_receivers(json: &str) -> Result<Receivers> {
    let stored: Vec<StoredReceiver> = serde_json::from_str(json).map_err(Error::fault)?;
    let receiver = |stored: &StoredReceiver| {
        Ok(Receiver {
            receiver_id: ReceiverId::new(&stored.receiver_id)?,
            target_id: TargetId::new(&stored.target_id)?,
            clock_offset: ClockOffset::from_microseconds(stored.clock_offset_us)?,
            sigma: stored.sigma_m.map(SigmaM::new).transpose()?,
        })
    };
    Receivers::new(stored.iter().map(receiver).collect::<Result<Vec<_>>>()?)
}

pub(crate) use camera_columns;

/// The refusal of a camera whose id is taken.
pub(crate) fn camera_exists(id: &CameraId) -> Error {
    Error::field(ErrorKind::CameraExists, "id", format!("a camera of the id {id} exists already"))
}

/// The refusal of a deletion while a training run has not ended.
pub(crate) fn has_live_run() -> Error {
    Error::refused(ErrorKind::RunLive, "the camera has a training run that has not ended; cancel it first")
}

/// Refuses the camera that was just inserted if it is one too many.
pub(crate) fn check_limit(cameras: i64, limit: u32) -> Result<()> {
    if cameras <= i64::from(limit) {
        return Ok(());
    }
    let message =
        format!("limits.cameras is {limit}; delete a camera that is no longer needed, or raise the limit");
    Err(Error::refused(ErrorKind::InsufficientStorage, message))
}
