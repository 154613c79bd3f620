//! Rows of model versions, their held-out errors and the pose changes found with them.

use uuid::Uuid;

use crate::domain::{
    BoundingBox, CameraId, CameraMoved, Error, ErrorKind, HeldOutSampleError, ModelMetadata, ModelVersion,
    Result, RunId, TargetId, model_sha256,
};
use crate::geo::Position;
use crate::refusals::no_model;
use crate::row_decoder::{RowDecoder, StoredRow};

macro_rules! select_models {
    ($rest:literal) => {
        concat!(
            "SELECT cameras.id, models.number, models.run_id, models.created_at_us, \
             CAST(length(models.weights) AS BIGINT), models.metadata \
             FROM models JOIN cameras ON cameras.key = models.camera_key ",
            $rest
        )
    };
}

/// A model to be stored.
#[derive(Debug, Clone, PartialEq)]
pub struct NewModel<'a> {
    /// The description of the version.
    pub metadata: &'a ModelMetadata,
    /// Its weights.
    pub weights: &'a [u8],
    /// Errors on held-out samples, for the comparison with later versions.
    pub held_out: &'a [HeldOutSampleError],
}

pub(crate) fn no_earlier_model(camera: &CameraId, active: i64) -> Error {
    let message = format!(
        "version {active} of camera {camera} stays active: no other version was active before it; activate one by \
         its number"
    );
    Error::refused(ErrorKind::NoEarlierModel, message)
}

pub(crate) fn unusable(camera: &CameraId, number: u32, reason: &str) -> Error {
    Error::refused(
        ErrorKind::ModelUnusable,
        format!(
            "version {number} of camera {camera} cannot be used: {reason}; activate another version, or \
             import this one again"
        ),
    )
}

/// A held-out error, with the box and the fix of its sample as long as that is stored.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredHeldOutError {
    /// The error.
    pub error: HeldOutSampleError,
    /// The sample's box, and the position of its fix.
    pub sample: Option<(BoundingBox, Position)>,
}

pub(crate) fn read_held_out_error(row: &StoredRow) -> Result<StoredHeldOutError> {
    let mut fields = RowDecoder::new("held_out_errors", row).skip(1);
    let time = fields.timestamp()?;
    let target_id = fields.parse(TargetId::new)?;
    let error = HeldOutSampleError { time, target_id, distance_m: fields.get()? };
    let mut columns = [None; 6];
    for column in &mut columns {
        *column = fields.get::<Option<f64>>()?;
    }
    let [
        Some(left_px),
        Some(top_px),
        Some(width_px),
        Some(height_px),
        Some(longitude_deg),
        Some(latitude_deg),
    ] = columns
    else {
        return Ok(StoredHeldOutError { error, sample: None });
    };
    let bounding_box = fields.checked(BoundingBox::new(left_px, top_px, width_px, height_px))?;
    let position = fields.checked(Position::new(longitude_deg, latitude_deg))?;
    Ok(StoredHeldOutError { error, sample: Some((bounding_box, position)) })
}

pub(crate) fn read_model(row: &StoredRow) -> Result<ModelVersion> {
    let mut fields = RowDecoder::new("models", row);
    Ok(ModelVersion {
        camera_id: fields.parse(CameraId::new)?,
        number: fields.count()?,
        run_id: fields.parse_optional(Uuid::parse_str)?.map(RunId),
        created_at: fields.timestamp()?,
        weights_bytes: fields.parse(|stored: i64| u64::try_from(stored))?,
        metadata: fields.parse(serde_json::from_str)?,
    })
}

pub(crate) use select_models;

pub(crate) fn read_move(row: &StoredRow) -> Result<CameraMoved> {
    let mut fields = RowDecoder::new("camera_moves", row).skip(1);
    Ok(CameraMoved {
        model_version: fields.count()?,
        onset_at: fields.timestamp()?,
        raised_at: fields.timestamp()?,
        shift_east_m: fields.get()?,
        shift_north_m: fields.get()?,
        statistic: fields.get()?,
        targets: fields.count()?,
    })
}

/// The metadata of a model as they are stored.
pub(crate) fn write_metadata(metadata: &ModelMetadata) -> Result<String> {
    let document = serde_json::to_string(metadata).map_err(Error::fault)?;
    // JSON has no NaN: it would be written as null and could never be read again.
    serde_json::from_str::<ModelMetadata>(&document)
        .map_err(|error| Error::fault(format!("the metadata of a model cannot be stored: {error}")))?;
    Ok(document)
}

/// Metadata document, weights and checksum of a version, if it was found.
pub(crate) type StoredContent = Option<(Vec<u8>, Vec<u8>, String)>;

/// A version as it is stored.
pub struct StoredModel {
    pub(crate) camera: CameraId,
    pub(crate) number: u32,
    pub(crate) content: StoredContent,
}

impl StoredModel {
    /// Metadata and weights, with the checksum verified.
    ///
    /// # Errors
    /// [`ErrorKind::ModelNotFound`]; [`ErrorKind::ModelUnusable`] for what is damaged.
    pub fn read(self) -> Result<(ModelMetadata, Vec<u8>)> {
        let Self { camera, number, content } = self;
        let (document, weights, sha256) = content.ok_or_else(|| no_model(&camera, number))?;
        if sha256 != model_sha256(&document, &weights) {
            return Err(unusable(&camera, number, "what is stored does not match its checksum"));
        }
        let metadata = serde_json::from_slice(&document)
            .map_err(|error| unusable(&camera, number, &format!("its metadata cannot be read: {error}")))?;
        Ok((metadata, weights))
    }
}

/// Finds the position to be rolled back and the version that becomes active, in the latest two activations that were
/// not rolled back (position and number, the latest first).
pub(crate) fn roll_back_target(camera: &CameraId, latest: &[(i64, i64)]) -> Result<(i64, i64)> {
    match *latest {
        [(position, _), (_, number)] => Ok((position, number)),
        [(_, active), ..] => Err(no_earlier_model(camera, active)),
        [] => {
            let message = format!("camera {camera} has no active model; activate a version by its number");
            Err(Error::refused(ErrorKind::NoModel, message))
        }
    }
}

/// The refusal to delete the active version.
pub(crate) fn is_active(number: u32) -> Error {
    Error::refused(
        ErrorKind::ModelActive,
        format!("version {number} is active; activate another version first"),
    )
}
