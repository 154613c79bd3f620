//! A camera that nobody calibrated.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::bounding_box::ImageSize;
use super::error::{Error, Result};
use super::gnss_error::GnssError;
use super::names::{CameraId, TargetClass, check_labels, check_text};
use super::receiver::Receivers;
use super::recipe::Recipe;

/// Counts the changes of a profile, from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Revision(pub u64);

/// What an operator says of a camera. No calibration is ever asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct NewCamera {
    /// The slug the operator chose.
    pub id: CameraId,
    /// The name for people.
    pub display_name: String,
    /// Without it, boxes cut by the right or lower border cannot be told.
    pub image_size: Option<ImageSize>,
    /// The receiver's error.
    pub gnss_error: GnssError,
    /// How to learn the camera.
    pub recipe: Recipe,
    /// Classes that the camera is used for; empty means all.
    pub target_classes: Vec<TargetClass>,
    /// Free-form labels.
    pub labels: BTreeMap<String, String>,
    /// Whose the GNSS receivers are, and how far their clocks are off.
    pub receivers: Receivers,
    /// Whether a training run is started by itself once the camera is found to have moved.
    pub retrain_when_moved: bool,
}

impl NewCamera {
    /// A camera of which nothing but its id is said.
    #[must_use]
    pub fn named(id: CameraId) -> Self {
        Self {
            display_name: id.as_str().to_owned(),
            id,
            image_size: None,
            gnss_error: GnssError::default(),
            recipe: Recipe::default(),
            target_classes: Vec::new(),
            labels: BTreeMap::new(),
            receivers: Receivers::default(),
            retrain_when_moved: false,
        }
    }

    /// # Errors
    /// Names the field that is too long, doubled or unprintable.
    pub fn check(self) -> Result<Self> {
        check_text("display_name", &self.display_name, 200)?;
        check_labels(&self.labels)?;
        if self.target_classes.len() > 64 {
            return Err(Error::invalid("target_classes", "must be at most 64"));
        }
        for (index, class) in self.target_classes.iter().enumerate() {
            if self.target_classes[..index].contains(class) {
                return Err(Error::invalid(
                    format!("target_classes[{index}]"),
                    "stands twice; name each class once",
                ));
            }
        }
        Ok(self)
    }

    /// What is lost by what the operator left out, in sentences.
    #[must_use]
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.image_size.is_none() {
            warnings.push(
                "image_size is not set: boxes cut by the right or lower border cannot be told, so their \
                 positions are given with the same confidence as others, and boxes outside of the image \
                 are not refused"
                    .to_owned(),
            );
        }
        if self.gnss_error == GnssError::Unknown {
            warnings.push(
                "gnss_error is unknown: it is estimated from the training samples; \
                 many fixes at one fixed point tell it better (POST .../gnss-error)"
                    .to_owned(),
            );
        }
        warnings
    }
}

/// Changes to a profile; `None` leaves a field as it is.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CameraChange {
    /// New name.
    pub display_name: Option<String>,
    /// New image size; `Some(None)` forgets it.
    pub image_size: Option<Option<ImageSize>>,
    /// New receiver error.
    pub gnss_error: Option<GnssError>,
    /// New recipe, for runs to come.
    pub recipe: Option<Recipe>,
    /// New classes.
    pub target_classes: Option<Vec<TargetClass>>,
    /// New labels, all of them.
    pub labels: Option<BTreeMap<String, String>>,
    /// New receivers, all of them.
    pub receivers: Option<Receivers>,
    /// Whether to train anew by itself.
    pub retrain_when_moved: Option<bool>,
}

impl CameraChange {
    /// The profile after the change.
    ///
    /// # Errors
    /// As [`NewCamera::check`].
    pub fn apply(self, profile: NewCamera) -> Result<NewCamera> {
        NewCamera {
            id: profile.id,
            display_name: self.display_name.unwrap_or(profile.display_name),
            image_size: self.image_size.unwrap_or(profile.image_size),
            gnss_error: self.gnss_error.unwrap_or(profile.gnss_error),
            recipe: self.recipe.unwrap_or(profile.recipe),
            target_classes: self.target_classes.unwrap_or(profile.target_classes),
            labels: self.labels.unwrap_or(profile.labels),
            receivers: self.receivers.unwrap_or(profile.receivers),
            retrain_when_moved: self.retrain_when_moved.unwrap_or(profile.retrain_when_moved),
        }
        .check()
    }
}

/// Identifies a stored camera for good: a camera that is deleted and created again under the same id has
/// another key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CameraKey(pub i64);

/// A stored camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// Which one of those that had this id.
    pub key: CameraKey,
    /// What the operator said.
    pub profile: NewCamera,
    /// Counts the changes of the profile.
    pub revision: Revision,
    /// When it was made.
    pub created_at: Timestamp,
    /// When the profile was changed last.
    pub updated_at: Timestamp,
    /// The model version that answers, if any.
    pub active_model: Option<u32>,
}

impl Camera {
    /// The camera's id.
    #[must_use]
    pub const fn id(&self) -> &CameraId {
        &self.profile.id
    }
}

/// A camera no longer looks where it looked when its model was trained: its positions have left the
/// fixes, beyond what the errors of both explain.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraMoved {
    /// The model version that no longer fits.
    pub model_version: u32,
    /// When it began, as well as can be told.
    pub began_at: Timestamp,
    /// When the evidence was enough.
    pub raised_at: Timestamp,
    /// Mean shift of the regressed positions against the fixes since then, m.
    pub shift_east_m: f64,
    /// The same towards north, m.
    pub shift_north_m: f64,
    /// The test's statistic.
    pub statistic: f64,
    /// Targets that bear witness.
    pub targets: u32,
}

impl CameraMoved {
    /// Error variance per axis, m2, that the move adds to what the model says.
    #[must_use]
    pub fn added_m2(&self) -> f64 {
        0.5 * (self.shift_east_m.powi(2) + self.shift_north_m.powi(2))
    }
}
