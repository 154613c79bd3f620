//! Camera profiles. No calibration is part of them.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::bounding_box::ImageSize;
use super::error::{Error, ErrorKind, Result};
use super::gnss_error::{GnssBiasSigma, GnssError};
use super::history::HistorySettings;
use super::known_point::KnownPoint;
use super::names::{CameraId, SiteId, TargetClass, check_labels, check_text};
use super::receiver::Receivers;
use super::recipe::Recipe;
use super::sample::SampleCount;
use super::snapshot::SnapshotSource;
use crate::geo::Position;

/// Revision number of a profile, from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Revision(pub u64);

/// A camera's profile as the operator defines it.
#[derive(Debug, Clone, PartialEq)]
pub struct NewCamera {
    /// The slug chosen by the operator.
    pub id: CameraId,
    /// Display name.
    pub display_name: String,
    /// Without it, truncation by the right or lower border is not detected.
    pub image_size: Option<ImageSize>,
    /// The receiver's error.
    pub gnss_error: GnssError,
    /// Rough position of the camera itself. Imported fixes are compared with it.
    pub location: Option<Position>,
    /// The bias that all fixes have in common; `None` for the model's own prior.
    pub gnss_bias_sigma: Option<GnssBiasSigma>,
    /// Recipe of training runs.
    pub recipe: Recipe,
    /// Classes of targets that the camera is used for; empty for all.
    pub target_classes: Vec<TargetClass>,
    /// Free-form labels.
    pub labels: BTreeMap<String, String>,
    /// The targets that carry the GNSS receivers, and the receivers' clock offsets.
    pub receivers: Receivers,
    /// True if a training run starts automatically after the camera has moved.
    pub retrain_when_moved: bool,
    /// True if the camera, while it has no model, records boxes of trackers and fixes of receivers and is trained on
    /// those that certainly belong together.
    pub learn_automatically: bool,
    /// The site whose tracks the camera contributes to.
    pub site: Option<SiteId>,
    /// Where a still picture of what the camera sees is fetched.
    pub snapshot: Option<SnapshotSource>,
    /// How finished tracks are kept; `None` keeps none.
    pub history: Option<HistorySettings>,
    /// Points of the ground whose place is known, evidence of training runs.
    pub known_points: Vec<KnownPoint>,
}

impl NewCamera {
    /// A profile with an id and defaults.
    #[must_use]
    pub fn named(id: CameraId) -> Self {
        Self {
            display_name: id.as_str().to_owned(),
            id,
            image_size: None,
            gnss_error: GnssError::default(),
            location: None,
            gnss_bias_sigma: None,
            recipe: Recipe::default(),
            target_classes: Vec::new(),
            labels: BTreeMap::new(),
            receivers: Receivers::default(),
            retrain_when_moved: false,
            learn_automatically: true,
            site: None,
            snapshot: None,
            history: None,
            known_points: Vec::new(),
        }
    }

    /// # Errors
    /// Names the field that is too long, duplicated or not printable.
    pub fn check(self) -> Result<Self> {
        check_text("display_name", &self.display_name, 200)?;
        check_labels(&self.labels)?;
        KnownPoint::check_all(&self.known_points, self.image_size)?;
        if self.target_classes.len() > 64 {
            return Err(Error::invalid("target_classes", "must be at most 64"));
        }
        for (index, class) in self.target_classes.iter().enumerate() {
            if self.target_classes[..index].contains(class) {
                return Err(Error::invalid(
                    format!("target_classes[{index}]"),
                    "is a duplicate; name each class once",
                ));
            }
        }
        Ok(self)
    }

    /// Consequences of missing fields, as sentences.
    #[must_use]
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.image_size.is_none() {
            warnings.push(
                "image_size is not set: truncation of boxes by the right or lower border is not detected, so \
                 their positions have the same confidence as others, and boxes outside of the image are \
                 not refused"
                    .to_owned(),
            );
        }
        if self.gnss_error == GnssError::Unknown {
            warnings.push(
                "gnss_error is unknown: it is estimated from the training samples; \
                 many fixes at one fixed point give a better estimate (POST .../gnss-error)"
                    .to_owned(),
            );
        }
        warnings
    }
}

/// A partial update of a profile; `None` keeps a field.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CameraChange {
    /// New name.
    pub display_name: Option<String>,
    /// New image size; `Some(None)` removes it.
    pub image_size: Option<Option<ImageSize>>,
    /// New receiver error.
    pub gnss_error: Option<GnssError>,
    /// New position of the camera itself; `Some(None)` removes it.
    pub location: Option<Option<Position>>,
    /// New common bias of all fixes; `Some(None)` removes it.
    pub gnss_bias_sigma: Option<Option<GnssBiasSigma>>,
    /// New recipe, for future runs.
    pub recipe: Option<Recipe>,
    /// New classes.
    pub target_classes: Option<Vec<TargetClass>>,
    /// New labels; they replace all.
    pub labels: Option<BTreeMap<String, String>>,
    /// New receivers; they replace all.
    pub receivers: Option<Receivers>,
    /// The new value of [`NewCamera::retrain_when_moved`].
    pub retrain_when_moved: Option<bool>,
    /// The new value of [`NewCamera::learn_automatically`].
    pub learn_automatically: Option<bool>,
    /// New site; `Some(None)` removes the camera from its site.
    pub site: Option<Option<SiteId>>,
    /// New address of a still picture; `Some(None)` removes it. Without a password, that of the same address is kept.
    pub snapshot: Option<Option<SnapshotSource>>,
    /// New settings of the history; `Some(None)` keeps no more tracks.
    pub history: Option<Option<HistorySettings>>,
    /// New known points; they replace all.
    pub known_points: Option<Vec<KnownPoint>>,
}

impl CameraChange {
    /// Names of the fields that can be changed, on both transports.
    pub const FIELDS: [&str; 15] = [
        "display_name",
        "image_size",
        "gnss_error",
        "location",
        "gnss_bias_sigma_m",
        "recipe",
        "target_classes",
        "labels",
        "receivers",
        "retrain_when_moved",
        "learn_automatically",
        "site",
        "snapshot",
        "history",
        "known_points",
    ];

    /// The fields of a profile that are named, by [`Self::FIELDS`].
    #[must_use]
    pub fn of_fields(profile: NewCamera, is_named: impl Fn(&str) -> bool) -> Self {
        Self {
            display_name: is_named("display_name").then_some(profile.display_name),
            image_size: is_named("image_size").then_some(profile.image_size),
            gnss_error: is_named("gnss_error").then_some(profile.gnss_error),
            location: is_named("location").then_some(profile.location),
            gnss_bias_sigma: is_named("gnss_bias_sigma_m").then_some(profile.gnss_bias_sigma),
            recipe: is_named("recipe").then_some(profile.recipe),
            target_classes: is_named("target_classes").then_some(profile.target_classes),
            labels: is_named("labels").then_some(profile.labels),
            receivers: is_named("receivers").then_some(profile.receivers),
            retrain_when_moved: is_named("retrain_when_moved").then_some(profile.retrain_when_moved),
            learn_automatically: is_named("learn_automatically").then_some(profile.learn_automatically),
            site: is_named("site").then_some(profile.site),
            snapshot: is_named("snapshot").then_some(profile.snapshot),
            history: is_named("history").then_some(profile.history),
            known_points: is_named("known_points").then_some(profile.known_points),
        }
    }

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
            location: self.location.unwrap_or(profile.location),
            gnss_bias_sigma: self.gnss_bias_sigma.unwrap_or(profile.gnss_bias_sigma),
            recipe: self.recipe.unwrap_or(profile.recipe),
            target_classes: self.target_classes.unwrap_or(profile.target_classes),
            labels: self.labels.unwrap_or(profile.labels),
            receivers: self.receivers.unwrap_or(profile.receivers),
            retrain_when_moved: self.retrain_when_moved.unwrap_or(profile.retrain_when_moved),
            learn_automatically: self.learn_automatically.unwrap_or(profile.learn_automatically),
            site: self.site.unwrap_or(profile.site),
            snapshot: match self.snapshot {
                Some(new) => new.map(|new| new.with_known_password(profile.snapshot.as_ref())),
                None => profile.snapshot,
            },
            history: self.history.unwrap_or(profile.history),
            known_points: self.known_points.unwrap_or(profile.known_points),
        }
        .check()
    }
}

/// Identifies a stored camera for good: a camera that is deleted and created again under the same id has
/// another key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CameraKey(pub i64);

impl From<i64> for CameraKey {
    fn from(key: i64) -> Self {
        Self(key)
    }
}

impl From<CameraKey> for i64 {
    fn from(key: CameraKey) -> Self {
        key.0
    }
}

/// The version that a change of a camera or a site is based on. The change is refused if another version is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExpectedVersion<K = CameraKey> {
    /// The key, if the caller knows which of those that had the id it means.
    pub key: Option<K>,
    /// The revision of its profile.
    pub revision: Revision,
}

impl<K: PartialEq> ExpectedVersion<K> {
    /// `what` names the resource (`camera`, `site`) whose stored key and revision are checked.
    ///
    /// # Errors
    /// `RevisionMismatch` if they are not the expected ones.
    pub fn check(self, what: &str, key: K, revision: Revision) -> Result<()> {
        if self.revision == revision && self.key.is_none_or(|expected| expected == key) {
            return Ok(());
        }
        let message = format!(
            "the {what} is at revision {} and was changed, or created again, since it was read; read it again and \
             repeat the change",
            revision.0
        );
        Err(Error::refused(ErrorKind::RevisionMismatch, message))
    }
}

impl<K> From<Revision> for ExpectedVersion<K> {
    fn from(revision: Revision) -> Self {
        Self { key: None, revision }
    }
}

/// A stored camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// Identity of this camera among all that had its id.
    pub key: CameraKey,
    /// The profile.
    pub profile: NewCamera,
    /// Revision of the profile.
    pub revision: Revision,
    /// Time of creation.
    pub created_at: Timestamp,
    /// Time of the latest change of the profile.
    pub updated_at: Timestamp,
    /// Number of the active model version, if any.
    pub active_model: Option<u32>,
    /// Stored samples.
    pub samples: SampleCount,
}

impl Camera {
    /// Returns the version that a change of this camera is based on.
    #[must_use]
    pub const fn version(&self) -> ExpectedVersion {
        ExpectedVersion { key: Some(self.key), revision: self.revision }
    }

    /// The camera's id.
    #[must_use]
    pub const fn id(&self) -> &CameraId {
        &self.profile.id
    }
}

/// An alarm: the camera's pose has changed since its model was trained. Its positions deviate from the
/// fixes by more than the errors of both explain.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraMoved {
    /// The model version concerned.
    pub model_version: u32,
    /// Estimated onset of the change.
    pub onset_at: Timestamp,
    /// When the alarm was raised.
    pub raised_at: Timestamp,
    /// Mean shift of the regressed positions since the onset relative to the fixes, or to the positions by the other cameras of
    /// the site, towards east, m.
    pub shift_east_m: f64,
    /// Mean shift towards north, m.
    pub shift_north_m: f64,
    /// Statistic of the likelihood ratio test.
    pub statistic: f64,
    /// Number of targets compared since the onset.
    pub targets: u32,
}

impl CameraMoved {
    /// Error variance per axis that the change adds to that of the model, m2: half the squared shift.
    #[must_use]
    pub fn change_variance_m2(&self) -> f64 {
        0.5 * (self.shift_east_m.powi(2) + self.shift_north_m.powi(2))
    }
}
