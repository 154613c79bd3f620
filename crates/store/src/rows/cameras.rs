//! Rows of cameras.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::domain::{
    Camera, CameraId, CameraKey, CameraMoved, ClockOffset, Error, ErrorKind, ExpectedVersion, GnssBiasSigma,
    GnssError, ImageSize, KnownPoint, NewCamera, Receiver, ReceiverId, Receivers, Result, Revision,
    SampleCount, SigmaM, SiteId, SnapshotSource, TargetClass, TargetId,
};
use crate::geo::Position;
use crate::refusals::unknown_site;
use crate::row_decoder::{RowDecoder, StoredRow};
use crate::rows::history::StoredHistory;
use crate::rows::models::StoredModel;

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
    /// Its active model, which is yet to be read.
    pub model: Option<StoredModel>,
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
        "key, id, profile, learn_automatically, revision, created_at_us, updated_at_us, active_model, (SELECT samples FROM sample_counts WHERE camera_key = key) AS samples_with_fix, \
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
    let profile = fields.parse(|json: &str| read_profile(json, id))?;
    let learn_automatically = fields.get()?;
    let revision = fields.revision()?;
    let (created_at, updated_at) = (fields.timestamp()?, fields.timestamp()?);
    let active_model = fields.optional_count()?;
    let mut samples = || fields.parse(|stored: Option<i64>| u64::try_from(stored.unwrap_or_default()));
    let (with_fix, without_fix) = (samples()?, samples()?);
    let samples = SampleCount { all: with_fix + without_fix, without_fix };
    let site = fields.parse_optional(SiteId::new)?;
    let profile = NewCamera { learn_automatically, site, ..profile };
    Ok(Camera { key, profile, revision, created_at, updated_at, active_model, samples })
}

/// The stored part of a profile that no statement asks for. A field that was added later is missing in older rows.
#[derive(Serialize, Deserialize)]
struct StoredProfile {
    display_name: String,
    /// Width and height.
    image_size_px: Option<(u32, u32)>,
    gnss_sigma_m: Option<f64>,
    /// Longitude and latitude.
    location_deg: Option<(f64, f64)>,
    gnss_bias_sigma_m: Option<f64>,
    recipe: String,
    target_classes: Vec<String>,
    labels: BTreeMap<String, String>,
    receivers: Vec<StoredReceiver>,
    retrain_when_moved: bool,
    snapshot: Option<StoredSnapshot>,
    history: Option<StoredHistory>,
    #[serde(default)]
    known_points: Vec<StoredKnownPoint>,
}

/// A known point as it is stored.
#[derive(Serialize, Deserialize)]
struct StoredKnownPoint {
    image_px: [f64; 2],
    /// Longitude and latitude.
    position_deg: (f64, f64),
    sigma_m: f64,
}

/// Where a still picture is fetched, as it is stored.
#[derive(Serialize, Deserialize)]
struct StoredSnapshot {
    url: String,
    username: Option<String>,
    password: Option<String>,
}

/// A receiver as it is stored.
#[derive(Serialize, Deserialize)]
struct StoredReceiver {
    receiver_id: String,
    target_id: String,
    clock_offset_us: i64,
    sigma_m: Option<f64>,
}

pub(crate) fn write_profile(profile: &NewCamera) -> Result<String> {
    let receiver = |receiver: &Receiver| StoredReceiver {
        receiver_id: receiver.receiver_id.as_str().to_owned(),
        target_id: receiver.target_id.as_str().to_owned(),
        clock_offset_us: receiver.clock_offset.microseconds(),
        sigma_m: receiver.sigma.map(SigmaM::metres),
    };
    let stored = StoredProfile {
        display_name: profile.display_name.clone(),
        image_size_px: profile.image_size.map(|size| (size.width_px(), size.height_px())),
        gnss_sigma_m: match profile.gnss_error {
            GnssError::Known(sigma) => Some(sigma.metres()),
            GnssError::Unknown => None,
        },
        location_deg: profile.location.map(|at| (at.longitude_deg(), at.latitude_deg())),
        gnss_bias_sigma_m: profile.gnss_bias_sigma.map(GnssBiasSigma::metres),
        recipe: profile.recipe.as_str().to_owned(),
        target_classes: profile.target_classes.iter().map(|class| class.as_str().to_owned()).collect(),
        labels: profile.labels.clone(),
        receivers: profile.receivers.iter().map(receiver).collect(),
        retrain_when_moved: profile.retrain_when_moved,
        snapshot: profile.snapshot.as_ref().map(|source| StoredSnapshot {
            url: source.url().to_owned(),
            username: source.username().map(str::to_owned),
            password: source.password().map(str::to_owned),
        }),
        history: profile.history.map(StoredHistory::from),
        known_points: profile.known_points.iter().map(StoredKnownPoint::from).collect(),
    };
    serde_json::to_string(&stored).map_err(Error::fault)
}

fn read_profile(json: &str, id: CameraId) -> Result<NewCamera> {
    let stored: StoredProfile = serde_json::from_str(json).map_err(Error::fault)?;
    let image_size = stored.image_size_px.map(|(width_px, height_px)| ImageSize::new(width_px, height_px));
    let location = stored.location_deg.map(|(longitude, latitude)| Position::new(longitude, latitude));
    let target_classes = stored.target_classes.iter().map(|class| TargetClass::new(class));
    let receivers = stored.receivers.iter().map(StoredReceiver::to_domain);
    let snapshot = stored.snapshot.map(|it| SnapshotSource::new(&it.url, it.username, it.password));
    Ok(NewCamera {
        display_name: stored.display_name,
        image_size: image_size.transpose()?,
        gnss_error: match stored.gnss_sigma_m {
            Some(sigma_m) => GnssError::Known(SigmaM::new(sigma_m)?),
            None => GnssError::Unknown,
        },
        location: location.transpose().map_err(Error::fault)?,
        gnss_bias_sigma: stored.gnss_bias_sigma_m.map(GnssBiasSigma::new).transpose()?,
        recipe: stored.recipe.parse().map_err(Error::fault)?,
        target_classes: target_classes.collect::<Result<_>>()?,
        labels: stored.labels,
        receivers: Receivers::new(receivers.collect::<Result<Vec<_>>>()?)?,
        retrain_when_moved: stored.retrain_when_moved,
        snapshot: snapshot.transpose()?,
        history: stored.history.as_ref().map(StoredHistory::to_domain).transpose()?,
        known_points: stored.known_points.iter().map(StoredKnownPoint::to_domain).collect::<Result<_>>()?,
        ..NewCamera::named(id)
    })
}

impl From<&KnownPoint> for StoredKnownPoint {
    fn from(point: &KnownPoint) -> Self {
        Self {
            image_px: point.image_px,
            position_deg: (point.position.longitude_deg(), point.position.latitude_deg()),
            sigma_m: point.sigma_m.metres(),
        }
    }
}

impl StoredKnownPoint {
    fn to_domain(&self) -> Result<KnownPoint> {
        let (longitude, latitude) = self.position_deg;
        Ok(KnownPoint {
            image_px: self.image_px,
            position: Position::new(longitude, latitude).map_err(Error::fault)?,
            sigma_m: SigmaM::new(self.sigma_m)?,
        })
    }
}

impl StoredReceiver {
    fn to_domain(&self) -> Result<Receiver> {
        Ok(Receiver {
            receiver_id: ReceiverId::new(&self.receiver_id)?,
            target_id: TargetId::new(&self.target_id)?,
            clock_offset: ClockOffset::from_microseconds(self.clock_offset_us)?,
            sigma: self.sigma_m.map(SigmaM::new).transpose()?,
        })
    }
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
