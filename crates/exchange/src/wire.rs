//! The JSON shapes of positions, boxes, samples, observations and fused positions.
//!
//! The same shapes serve files and REST. They are not checked: the conversions into [`crate::domain`]
//! check them and name an invalid field by its path in the JSON.

use std::borrow::Cow;
use std::fmt;

use jiff::Timestamp;
use serde::de::DeserializeSeed;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use serde_path_to_error::Track;
use utoipa::ToSchema;

use super::json_errors::refusal_of;
use super::json_violations::all_violations;
use super::objects_only;
use crate::domain::{self, Error, Result, SigmaM, TimeBounds, parse_time};
use crate::geo::{self, PositionError};

/// Text borrowed from the JSON document if it has no escapes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Text<'a>(#[serde(borrow)] Cow<'a, str>);

impl Text<'_> {
    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl<'a> From<&'a str> for Text<'a> {
    fn from(text: &'a str) -> Self {
        Self(Cow::Borrowed(text))
    }
}

impl From<String> for Text<'_> {
    fn from(text: String) -> Self {
        Self(Cow::Owned(text))
    }
}

/// A position on WGS 84.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Position {
    /// Degrees east of Greenwich.
    #[schema(minimum = -180.0, maximum = 180.0, example = 103.98678)]
    pub longitude_deg: f64,
    /// Degrees north of the equator.
    #[schema(minimum = -90.0, maximum = 90.0, example = 30.6280135)]
    pub latitude_deg: f64,
}

impl Position {
    /// # Errors
    /// Names the coordinate that is not finite or out of range.
    pub fn to_domain(self) -> Result<geo::Position> {
        geo::Position::new(self.longitude_deg, self.latitude_deg).map_err(|error| {
            let field = match error {
                PositionError::Longitude => "longitude_deg",
                PositionError::Latitude => "latitude_deg",
            };
            Error::invalid(field, error.to_string())
        })
    }
}

impl From<geo::Position> for Position {
    fn from(position: geo::Position) -> Self {
        Self { longitude_deg: position.longitude_deg(), latitude_deg: position.latitude_deg() }
    }
}

/// A GNSS position, with the error reported by the receiver, if any.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Fix {
    /// Degrees east of Greenwich, WGS 84.
    #[schema(minimum = -180.0, maximum = 180.0, example = 103.98678)]
    pub longitude_deg: f64,
    /// Degrees north of the equator, WGS 84.
    #[schema(minimum = -90.0, maximum = 90.0, example = 30.6280135)]
    pub latitude_deg: f64,
    /// Standard deviation per horizontal axis in metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.001, maximum = 10000.0, example = 2.2)]
    pub sigma_m: Option<f64>,
}

impl Fix {
    /// # Errors
    /// Names the invalid coordinate or `sigma_m`.
    pub fn to_domain(self) -> Result<domain::Fix> {
        let Self { longitude_deg, latitude_deg, sigma_m } = self;
        Ok(domain::Fix {
            position: Position { longitude_deg, latitude_deg }.to_domain()?,
            sigma_m: sigma_m.map(SigmaM::new).transpose()?,
        })
    }

    /// The position alone.
    #[must_use]
    pub const fn position(self) -> Position {
        Position { longitude_deg: self.longitude_deg, latitude_deg: self.latitude_deg }
    }
}

impl From<domain::Fix> for Fix {
    fn from(fix: domain::Fix) -> Self {
        Self {
            longitude_deg: fix.position.longitude_deg(),
            latitude_deg: fix.position.latitude_deg(),
            sigma_m: fix.sigma_m.map(SigmaM::metres),
        }
    }
}

/// A covariance on the ground in m2, axes east and north.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct PlaneCovariance {
    /// Variance along east.
    pub east_m2: f64,
    /// Variance along north.
    pub north_m2: f64,
    /// Covariance of east and north.
    pub east_north_m2: f64,
}

impl From<geo::PlaneCovariance> for PlaneCovariance {
    fn from(covariance: geo::PlaneCovariance) -> Self {
        let geo::PlaneCovariance { east_m2, north_m2, east_north_m2 } = covariance;
        Self { east_m2, north_m2, east_north_m2 }
    }
}

/// Speed and course of a target.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct Motion {
    /// Speed, m/s.
    pub speed_mps: f64,
    /// Bounds that hold the true speed with 95 % probability, m/s.
    pub speed_interval_mps: [f64; 2],
    /// Course over ground, clockwise from north, 0 to 360. Missing where the speed's interval holds 0, or the course may
    /// be any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub course_deg: Option<f64>,
    /// Bounds that hold the true course with 95 % probability, clockwise from the first to the second: `[350, 10]`
    /// is 20 degrees wide. Missing with the course.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub course_interval_deg: Option<[f64; 2]>,
    /// Probability that the target is stationary, 0 to 1.
    pub stationary_probability: f64,
}

impl From<domain::Motion> for Motion {
    fn from(motion: domain::Motion) -> Self {
        Self {
            speed_mps: motion.speed_mps,
            speed_interval_mps: motion.speed_interval_mps,
            course_deg: motion.course.map(|course| course.deg),
            course_interval_deg: motion.course.map(|course| course.interval_deg),
            stationary_probability: motion.stationary_probability,
        }
    }
}

/// A position of a finished track.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct HistoryPosition<'a> {
    /// The instant.
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    /// The camera whose track it is, if it is one of a camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera_id: Option<&'a str>,
    /// The site whose world track it is, if it is one of a site.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub site_id: Option<&'a str>,
    /// The track, unique within camera or site.
    pub track_id: &'a str,
    /// The target, if it is known: in a camera as the camera names it, in a site the carrier of a receiver.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target_id: Option<&'a str>,
    /// Class reported by a detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<&'a str>,
    /// The target's position.
    pub position: Position,
    /// Covariance of the position's error.
    pub covariance: PlaneCovariance,
    /// Speed and course.
    #[serde(flatten)]
    pub motion: Motion,
    /// Mean acceleration over the second before; missing at the first position of a track.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acceleration: Option<Acceleration>,
}

/// A mean acceleration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct Acceleration {
    /// Component towards east, m/s2.
    pub east_mps2: f64,
    /// Component towards north, m/s2.
    pub north_mps2: f64,
    /// Variance of the error towards east.
    pub covariance_east_m2_s4: f64,
    /// Variance of the error towards north.
    pub covariance_north_m2_s4: f64,
    /// Covariance of both errors.
    pub covariance_east_north_m2_s4: f64,
}

impl Acceleration {
    /// All of it, in the order of the fields.
    #[must_use]
    pub const fn numbers(&self) -> [f64; 5] {
        let Self { east_mps2, north_mps2, .. } = *self;
        let [east_m2_s4, north_m2_s4] = [self.covariance_east_m2_s4, self.covariance_north_m2_s4];
        [east_mps2, north_mps2, east_m2_s4, north_m2_s4, self.covariance_east_north_m2_s4]
    }
}

impl From<domain::Acceleration> for Acceleration {
    fn from(acceleration: domain::Acceleration) -> Self {
        let covariance = acceleration.covariance;
        Self {
            east_mps2: acceleration.east_m_s2,
            north_mps2: acceleration.north_m_s2,
            covariance_east_m2_s4: covariance.east_m2,
            covariance_north_m2_s4: covariance.north_m2,
            covariance_east_north_m2_s4: covariance.east_north_m2,
        }
    }
}

impl<'a> HistoryPosition<'a> {
    /// A position of a camera or site.
    #[must_use]
    pub fn of(scope: &'a domain::TrackScope, row: &'a domain::ArchivedPosition) -> Self {
        Self {
            time: row.time,
            camera_id: scope.camera().map(domain::CameraId::as_str),
            site_id: scope.site().map(domain::SiteId::as_str),
            track_id: &row.track,
            target_id: row.target.as_ref().map(domain::TargetId::as_str),
            class: row.class.as_ref().map(domain::TargetClass::as_str),
            position: row.position.into(),
            covariance: row.covariance_m2.into(),
            motion: row.motion.into(),
            acceleration: row.acceleration.map(Into::into),
        }
    }
}

/// A box around a target, in pixels from the image's upper left corner.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BoundingBox {
    /// Left edge.
    #[schema(example = 475.0)]
    pub left_px: f64,
    /// Upper edge.
    #[schema(example = 11.0)]
    pub top_px: f64,
    /// Width, above 0.
    #[schema(exclusive_minimum = 0.0, example = 28.0)]
    pub width_px: f64,
    /// Height, above 0.
    #[schema(exclusive_minimum = 0.0, example = 77.0)]
    pub height_px: f64,
}

impl BoundingBox {
    /// # Errors
    /// Names the invalid side.
    pub fn to_domain(self) -> Result<domain::BoundingBox> {
        domain::BoundingBox::new(self.left_px, self.top_px, self.width_px, self.height_px)
    }
}

impl From<domain::BoundingBox> for BoundingBox {
    fn from(bounding_box: domain::BoundingBox) -> Self {
        let [left_px, top_px, width_px, height_px] = bounding_box.sides_px();
        Self { left_px, top_px, width_px, height_px }
    }
}

/// A box of one target at one instant and its fix, if it has one, stored for training. Unique by target and
/// time.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct Sample<'a> {
    /// RFC 3339 with an offset; stored to the microsecond.
    #[schema(value_type = String, format = DateTime, example = "2020-12-14T14:41:48+08:00")]
    pub time: Timestamp,
    /// The target.
    #[schema(value_type = String, min_length = 1, max_length = 128, example = "person-1")]
    pub target_id: &'a str,
    /// The detection.
    pub bounding_box: BoundingBox,
    /// The fix. A box without one contributes to the geometry of the camera, not to its place.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fix: Option<Fix>,
    /// Class reported by the detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, example = "person")]
    pub class: Option<&'a str>,
    /// Confidence score of the detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.0, maximum = 1.0)]
    pub score: Option<f64>,
    /// True position; for evaluation only, never used in training.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<Position>,
}

impl<'a, F: Copy + Into<Option<domain::Fix>>> From<&'a domain::Sample<F>> for Sample<'a> {
    fn from(sample: &'a domain::Sample<F>) -> Self {
        Self {
            time: sample.time,
            target_id: sample.target_id.as_str(),
            bounding_box: sample.bounding_box.into(),
            fix: sample.fix.into().map(Fix::from),
            class: sample.class.as_ref().map(domain::TargetClass::as_str),
            score: sample.score.map(domain::Score::value),
            truth: sample.truth.map(Position::from),
        }
    }
}

/// A box, a fix, or both, of one target at one instant.
#[derive(Debug, Clone, PartialEq, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Observation<'a> {
    /// RFC 3339 with an offset.
    #[serde(borrow)]
    #[schema(value_type = String, format = DateTime, example = "2020-12-14T14:41:48+08:00")]
    pub time: Text<'a>,
    /// The target, if known.
    #[serde(borrow, default)]
    #[schema(value_type = Option<String>, min_length = 1, max_length = 128, example = "person-1")]
    pub target_id: Option<Text<'a>>,
    /// The receiver of a fix that does not name its target: the camera's `receivers` say whose it is and how far
    /// its clock is off.
    #[serde(borrow, default)]
    #[schema(value_type = Option<String>, min_length = 1, max_length = 128, example = "phone-1")]
    pub receiver_id: Option<Text<'a>>,
    /// Number that the camera's tracker gave a box whose target is not known; instead of `target_id` and `receiver_id`.
    /// Where targets are followed, the box is matched with the receivers whose fixes come at the same time; until that
    /// is sure, its target is `tracker:` and this number.
    #[serde(borrow, default)]
    #[schema(value_type = Option<String>, min_length = 1, max_length = 120, example = "17")]
    pub tracker_id: Option<Text<'a>>,
    /// The detection.
    #[serde(default)]
    pub bounding_box: Option<BoundingBox>,
    /// The fix.
    #[serde(default)]
    pub fix: Option<Fix>,
    /// Class reported by the detector; a fusion makes no use of it, tracks keep it.
    #[serde(borrow, default)]
    #[schema(value_type = Option<String>, min_length = 1, max_length = 128, example = "person")]
    pub class: Option<Text<'a>>,
}

impl Observation<'_> {
    /// # Errors
    /// Names the invalid field, or `bounding_box` if neither box nor fix is given.
    pub fn to_domain(
        &self,
        bounds: &TimeBounds,
        image_size: Option<domain::ImageSize>,
        receivers: &domain::Receivers,
    ) -> Result<domain::Observation> {
        let time = bounds.check(parse_time(self.time.as_str())?)?;
        let target_id = self.target_id.as_ref().map(|id| domain::TargetId::new(id.as_str())).transpose()?;
        let receiver_id =
            self.receiver_id.as_ref().map(|id| domain::ReceiverId::new(id.as_str())).transpose()?;
        let bounding_box = self.bounding_box.map(|sides| box_within(sides, image_size)).transpose()?;
        let fix = self.fix.map(|fix| fix.to_domain().map_err(|error| error.under("fix"))).transpose()?;
        let (target_id, time, fix) = match (target_id, receiver_id) {
            (None, Some(receiver_id)) => {
                let (target_id, time) = receivers.resolve(&receiver_id, time);
                (Some(target_id), time, fix.map(|fix| receivers.with_sigma(&receiver_id, fix)))
            }
            (target_id, _) => (target_id, time, fix),
        };
        let tracker_id =
            self.tracker_id.as_ref().map(|id| domain::TrackerId::new(id.as_str())).transpose()?;
        let class = self.class.as_ref().map(|class| domain::TargetClass::new(class.as_str())).transpose()?;
        let observation = domain::Observation::new(time, target_id, bounding_box, fix)?;
        Ok(observation.with_tracker_id(tracker_id)?.with_class(class))
    }
}

/// A box within an image of that size; fields of errors are below `bounding_box`.
pub fn box_within(sides: BoundingBox, image_size: Option<domain::ImageSize>) -> Result<domain::BoundingBox> {
    let checked = sides.to_domain().and_then(|bounding_box| match image_size {
        Some(size) => bounding_box.within(size),
        None => Ok(bounding_box),
    });
    checked.map_err(|error| error.under("bounding_box"))
}

/// The fused position of one observation.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct FusedFix<'a> {
    /// The observation's time.
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    /// The observation's target.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub target_id: Option<&'a str>,
    /// The best estimate: the two-step position; the regressed position without a fix; the fix without a
    /// box.
    pub fused: Position,
    /// The one-step position, regressed from the box.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub regressed: Option<Position>,
    /// The fix of the observation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gnss: Option<Fix>,
    /// Weight of the regressed position, 0 to 1; both weights sum to 1.
    pub confidence_regression: f64,
    /// Weight of the fix, 0 to 1.
    pub confidence_gnss: f64,
    /// Error variance per axis of the regressed position, m2.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub e_regression_m2: Option<f64>,
    /// Error variance per axis of the fix, m2.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub e_gnss_m2: Option<f64>,
    /// Radius about `fused` that contains the true position with 95 % probability, m.
    pub r95_m: f64,
    /// Covariance of the normal distribution about `fused` that has this radius: its 95 % ellipse.
    pub covariance: PlaneCovariance,
    /// The same about `regressed`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub regressed_covariance: Option<PlaneCovariance>,
    /// Reconstruction error of the auto-encoder, in the recipe's units.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reconstruction_error: Option<f64>,
    /// Number of the model version used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model_version: Option<u32>,
    /// Warnings.
    #[schema(value_type = Vec<Flag>)]
    pub flags: Flags<'a>,
}

impl<'a> From<&'a domain::FusedFix> for FusedFix<'a> {
    fn from(fused: &'a domain::FusedFix) -> Self {
        Self {
            time: fused.time,
            target_id: fused.target_id.as_ref().map(domain::TargetId::as_str),
            fused: fused.fused.into(),
            regressed: fused.regressed.map(Position::from),
            gnss: fused.gnss.map(Fix::from),
            confidence_regression: fused.confidences.regression,
            confidence_gnss: fused.confidences.gnss,
            e_regression_m2: fused.e_regression_m2,
            e_gnss_m2: fused.e_gnss_m2,
            r95_m: fused.r95_m,
            covariance: fused.covariance.into(),
            regressed_covariance: fused.regressed_covariance.map(PlaneCovariance::from),
            reconstruction_error: fused.reconstruction_error,
            model_version: fused.model_version,
            flags: Flags(&fused.flags),
        }
    }
}

/// A warning about a fused position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ToSchema)]
#[schema(rename_all = "snake_case")]
pub enum Flag {
    /// No fix: the position is regressed from the box alone.
    GnssDenied,
    /// No box: the position is the fix.
    BoxMissing,
    /// The image border truncates the box.
    BoxAtBorder,
    /// The box is outside of the domain of the training samples.
    OutsideTraining,
    /// The camera has no model; only fixes are passed through.
    NoModel,
    /// The camera's pose has changed since its model was trained.
    CameraMoved,
    /// Box and fix contradict each other beyond their stated errors (chi-square gate, 99.9 %).
    SourcesDisagree,
    /// The fix was not used for the position: it contradicts the box, or it is out of range.
    FixRejected,
    /// The box was not used for the position: it contradicts the fix and is unusual, or the model
    /// gives no position for it.
    BoxRejected,
    /// The fix lies farther than 20 km from the camera's scene.
    FixOutOfRange,
    /// The target's boxes have been the same to the pixel for longer than a standing target shows: the
    /// picture or the detector stands still. Live answers alone have it.
    BoxFrozen,
    /// Something hides the target's lower part, more probably than not: its box is too short for its width and
    /// place. The position is that of the completed box.
    FootHidden,
}

/// Flags by their names.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Flags<'a>(&'a [domain::Flag]);

impl Serialize for Flags<'_> {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.iter().map(|flag| flag.as_str()))
    }
}

impl fmt::Display for Flags<'_> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, flag) in self.0.iter().enumerate() {
            if index > 0 {
                out.write_str(" ")?;
            }
            out.write_str(flag.as_str())?;
        }
        Ok(())
    }
}

/// The largest memory of the elements of a text, for each byte of the text, bytes.
const MEMORY_PER_BYTE: usize = 8;
/// The same whatever its length: a batch of a thousand short observations.
const FREE_MEMORY_BYTES: usize = 512 * 1024;

const fn memory_bytes(json: &[u8]) -> usize {
    FREE_MEMORY_BYTES + MEMORY_PER_BYTE * json.len()
}

/// Parses a value from JSON text.
///
/// # Errors
/// `MalformedBody` for text that is not JSON, `InvalidArgument` for a value of the wrong shape; both
/// name the path of the field.
pub fn parse_json<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<T> {
    // Tracking the path is slow, so it is done only for an error.
    let mut source = serde_json::Deserializer::from_slice(json);
    let value = objects_only::deserialize(&mut source, memory_bytes(json));
    match value.and_then(|value| source.end().map(|()| value)) {
        Ok(value) => Ok(value),
        Err(_) => parse_with_path(json),
    }
}

/// Parses a field that is read by a rule with a state of its own, such as a limit.
///
/// # Errors
/// As [`parse_json`].
pub fn parse_field<'a, S: DeserializeSeed<'a>>(field: &str, json: &'a RawValue, seed: S) -> Result<S::Value> {
    let mut source = serde_json::Deserializer::from_str(json.get());
    let mut track = Track::new();
    seed.deserialize(serde_path_to_error::Deserializer::new(&mut source, &mut track)).map_err(|error| {
        let path = track.path().to_string();
        refusal_of(&format!("{field}{}", if path == "." { "" } else { &path }), &error)
    })
}

/// Parses a document from JSON text; its refusal names all fields at fault, and takes several passes.
///
/// # Errors
/// As [`parse_json`].
pub fn parse_document<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<T> {
    parse_json(json).map_err(|first| all_violations::<T>(json, first))
}

fn parse_with_path<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<T> {
    let mut source = serde_json::Deserializer::from_slice(json);
    let mut track = Track::new();
    let tracked = serde_path_to_error::Deserializer::new(&mut source, &mut track);
    let value = objects_only::deserialize(tracked, memory_bytes(json)).map_err(|error| {
        let path = track.path().to_string();
        refusal_of(if path == "." { "" } else { &path }, &error)
    })?;
    source.end().map_err(|error| refusal_of("", &error))?;
    Ok(value)
}
