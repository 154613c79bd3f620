//! A loaded model: from a box to a position with its error, without allocation.

use std::sync::Arc;

use super::artifact::{ModelParts, TrackNoiseModel};
use super::encoder::{Encoder, ErrorContext, Estimate};
use super::recipes::gaussian_process::{HiddenFoot, RecentBoxes};
use super::recipes::{self, ErrorSource};
use super::site::JointMap;
use super::uncertainty::error_model::ErrorModel;
use super::uncertainty::scene::{Limited, Scene};
use crate::domain::{BoundingBox, ImageSize, Result, RunId};
use crate::geo::{EastNorth, LocalPlane, PLANE_RANGE_M, PlaneCovariance};
use crate::statistics::R95_PER_SIGMA;

/// How the error of a box's position divides among cameras that were trained together, m2: parts of
/// [`Regression::covariance`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointError {
    /// The run that trained them.
    pub run: RunId,
    /// The part that their maps have in common: no averaging over them removes it.
    pub common_m2: PlaneCovariance,
    /// The part of the box's noise that lasts while the target moves some metres.
    pub lasting_noise_m2: PlaneCovariance,
}

impl JointError {
    /// The same in other units: covariances times a factor.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        Self {
            common_m2: self.common_m2.scaled(factor),
            lasting_noise_m2: self.lasting_noise_m2.scaled(factor),
            ..self
        }
    }
}

/// White share of a regression's error variance where the model does not state it.
const DEFAULT_WHITE_SHARE: f64 = 0.3;
/// Time after which repeated boxes are frozen where the model does not state it, s.
const DEFAULT_FROZEN_S: f64 = 60.0;
/// Range of the error variance, m2: weights and radii are finite for every box.
pub(super) const VARIANCE_RANGE_M2: [f64; 2] = [1e-6, 1e12];

/// The one-step answer for one box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Regression {
    /// Position in the model's plane.
    pub regressed: EastNorth,
    /// eX of (2), in the recipe's units.
    pub reconstruction_error: f64,
    /// Error variance per axis, m2; above 0.
    pub e_regression_m2: f64,
    /// Covariance of the error, m2; its mean variance is `e_regression_m2`. Isotropic but for the recipe
    /// `gaussian_process`.
    pub covariance: PlaneCovariance,
    /// The part of `covariance` that is independent from box to box (the detector's noise); the rest is the
    /// same whenever the target returns to a place.
    pub box_noise: PlaneCovariance,
    /// True if the box is unlike those of the training samples.
    pub outside_training: bool,
    /// `r95_m = r95_scale * sqrt(e)` of the regressed and of the fused position.
    pub r95_scale: f64,
}

impl Regression {
    /// Variance per axis, m2, of the normal distribution that has the stated 95 % radius.
    #[must_use]
    pub fn variance_m2(&self) -> f64 {
        (self.r95_scale / R95_PER_SIGMA).powi(2) * self.e_regression_m2
    }

    /// The 95 % radius about the regressed position, m.
    #[must_use]
    pub fn r95_m(&self) -> f64 {
        self.r95_scale * self.e_regression_m2.sqrt()
    }

    /// Factor by which `covariance` is multiplied for the normal distribution that has the stated 95 % radius,
    /// which is larger where the covariance itself is uncertain.
    #[must_use]
    pub fn normal_scale(&self) -> f64 {
        (self.r95_m() / self.covariance.r95_m()).powi(2)
    }

    /// The moments of a mixture of answers, whose weights sum to 1; what has no moments is that of the heaviest.
    fn mixture(parts: &[(f64, Self)], heaviest: Self) -> Self {
        let origin = heaviest.regressed;
        let from_origin = |it: &Self| it.regressed.minus(origin);
        let (mut east_m, mut north_m) = (0.0, 0.0);
        for (weight, it) in parts {
            east_m += weight * from_origin(it).east_m;
            north_m += weight * from_origin(it).north_m;
        }
        let mut covariance = PlaneCovariance::default();
        let mut scale = 0.0_f64;
        for (weight, it) in parts {
            let moved = from_origin(it);
            let spread = PlaneCovariance::outer(moved.east_m - east_m, moved.north_m - north_m);
            covariance = covariance.plus(it.covariance.plus(spread).scaled(*weight));
            scale = scale.max(it.normal_scale());
        }
        let e_regression_m2 = covariance.per_axis_m2();
        Self {
            regressed: EastNorth { east_m: origin.east_m + east_m, north_m: origin.north_m + north_m },
            e_regression_m2,
            covariance,
            r95_scale: covariance.scaled(scale).r95_m() / e_regression_m2.sqrt(),
            ..heaviest
        }
    }

    /// Covariance, m2, of the normal distribution that has the stated 95 % radius.
    #[must_use]
    pub fn normal_covariance(&self) -> PlaneCovariance {
        self.covariance.scaled(self.normal_scale())
    }
}

/// A loaded model: flat weights, which threads may share.
#[derive(Debug, Clone)]
pub struct Regressor {
    plane: LocalPlane,
    e_gnss_m2: f64,
    pub(super) r95_scale: f64,
    white_share: f64,
    track_noise: Option<TrackNoiseModel>,
    /// Added to every error variance, m2 per axis.
    added_m2: f64,
    /// `None` while the model is fitted.
    pub(super) scene: Option<Scene>,
    frozen_after_s: f64,
    pub(super) error_model: ErrorModel,
    pub(super) encoder: Arc<dyn Encoder>,
    joint_map: Option<JointMap>,
}

impl Regressor {
    /// # Errors
    /// Names the tensor or metadata field that is missing, unknown or cannot be used.
    pub(super) fn build(mut parts: ModelParts) -> Result<Self> {
        let is_formula = recipes::error_source(parts.recipe) == ErrorSource::Formula;
        let error_model = ErrorModel::build(&mut parts, is_formula)?;
        let encoder = recipes::load(&mut parts)?;
        let joint_map = JointMap::take(&mut parts)?;
        let r95_scale = parts.positive_parameter("r95_scale")?;
        let track_noise = TrackNoiseModel::read(&parts)?;
        let scene = Scene::read(&parts)?;
        let frozen_after_s = parts.parameter_or("frozen_after_s", DEFAULT_FROZEN_S)?;
        let white_share = parts.parameter_or("unrest_share", DEFAULT_WHITE_SHARE)?.clamp(0.0, 1.0);
        let ModelParts { plane, e_gnss_m2, tensors, .. } = parts;
        tensors.finish()?;
        Ok(Self {
            plane,
            e_gnss_m2,
            r95_scale,
            white_share,
            track_noise,
            added_m2: 0.0,
            scene,
            frozen_after_s,
            error_model,
            encoder,
            joint_map,
        })
    }

    /// Boxes among which every box of the training lies.
    pub(super) fn training_boxes(&self) -> Vec<BoundingBox> {
        self.error_model.coverage.boxes().collect()
    }

    /// Size of the image that it was trained on, if known.
    #[must_use]
    pub const fn image_size(&self) -> Option<ImageSize> {
        self.error_model.image_size()
    }

    /// The same model with a larger error variance (m2 per axis), for a camera whose pose has changed
    /// since the training.
    #[must_use]
    pub fn with_added_error(&self, added_m2: f64) -> Self {
        Self { added_m2, ..self.clone() }
    }

    /// The plane of its positions.
    #[must_use]
    pub const fn plane(&self) -> &LocalPlane {
        &self.plane
    }

    /// The receiver's error variance per axis, m2.
    #[must_use]
    pub const fn e_gnss_m2(&self) -> f64 {
        self.e_gnss_m2
    }

    /// The correlation of the errors of receiver and model over time, if the model states it.
    #[must_use]
    pub const fn track_noise(&self) -> Option<TrackNoiseModel> {
        self.track_noise
    }

    /// Radius about the plane's origin, the centre of the training positions, that holds these: three of their
    /// standard deviations per axis, m. Infinite while the model is fitted.
    #[must_use]
    pub fn scene_radius_m(&self) -> f64 {
        self.track_noise.map_or(f64::INFINITY, |noise| noise.regression_length_m)
    }

    /// True if an answer says no more than that a target is in view: its error is as large as the ground that training
    /// covers, and larger than twice a fix's.
    #[must_use]
    pub fn is_vague(&self, regression: &Regression) -> bool {
        let anywhere_m2 = self.scene.map_or(f64::INFINITY, |scene| {
            let [east_m2, north_m2] = scene.variance_m2();
            0.5 * (east_m2 + north_m2)
        });
        let least_m2 = anywhere_m2.max(4.0 * self.e_gnss_m2);
        regression.r95_m() > R95_PER_SIGMA * least_m2.sqrt()
    }

    /// An answer whose target may be anywhere in the scene.
    #[must_use]
    pub fn anywhere_in_scene(&self, regression: Regression) -> Regression {
        let reach_m = self.scene.map_or(PLANE_RANGE_M, |scene| scene.reach_m(regression.regressed));
        let e_regression_m2 = (reach_m / regression.r95_scale).powi(2).max(regression.e_regression_m2);
        Regression {
            e_regression_m2,
            covariance: PlaneCovariance::isotropic(e_regression_m2),
            box_noise: PlaneCovariance::default(),
            ..regression
        }
    }

    /// Boxes of a target that are the same to the pixel for this long, s, are frozen: no standing target of the training
    /// showed it.
    #[must_use]
    pub const fn frozen_after_s(&self) -> f64 {
        self.frozen_after_s
    }

    /// White share of the regression's error variance, 0 to 1, which is independent between boxes; the rest
    /// is the same whenever the target returns to a place.
    #[must_use]
    pub const fn white_share(&self) -> f64 {
        self.white_share
    }

    /// True if the regressed position depends on the fix: a network of `paper` has it among its inputs.
    #[must_use]
    pub fn uses_fix(&self) -> bool {
        self.encoder.uses_fix()
    }

    /// How the error of a box's position divides among cameras that were trained together. `None` for a camera that
    /// was trained by itself: how much of its error others share is unknown then.
    #[must_use]
    pub fn joint_error(&self, bounding_box: &BoundingBox, regression: &Regression) -> Option<JointError> {
        let joint = self.joint_map.as_ref()?;
        let map_m2 = regression.covariance.minus(regression.box_noise);
        let located = joint.locate(bounding_box);
        let common_m2 = self.encoder.widened(located.common_m2);
        let part_of = |part: PlaneCovariance, whole: PlaneCovariance| {
            let is_part = part.is_finite() && whole.minus(part).is_positive();
            if is_part { part } else { whole }
        };
        Some(JointError {
            run: joint.run(),
            common_m2: part_of(common_m2, map_m2),
            lasting_noise_m2: part_of(located.lasting_noise_m2, regression.box_noise),
        })
    }

    /// The same model with answers that no scene limits.
    pub(crate) fn without_scene(&self) -> Self {
        Self { scene: None, ..self.clone() }
    }

    /// Position of a box's target, with its error. Only the recipe `paper` uses the fix, which is among
    /// the inputs of one of its networks.
    #[must_use]
    pub fn regress(&self, bounding_box: &BoundingBox, fix: Option<EastNorth>) -> Regression {
        self.regress_with(bounding_box, fix, None)
    }

    /// The same for the next box of a target whose earlier boxes are summarised in `recent`, which takes this
    /// one in. A deviation too small to be noticed in one box is noticed when it lasts; only the recipe
    /// `gaussian_process` tests for it.
    #[must_use]
    pub fn regress_next(
        &self,
        bounding_box: &BoundingBox,
        fix: Option<EastNorth>,
        recent: &mut RecentBoxes,
    ) -> Regression {
        self.regress_with(bounding_box, fix, Some(recent))
    }

    /// Covariance of the error that the map makes in the distance between the positions of two boxes, m2: a map that is
    /// stretched makes every speed wrong by the same share. `None` where the recipe does not state how its errors at two
    /// places are correlated; only `gaussian_process` does.
    #[must_use]
    pub fn displacement_covariance(&self, boxes: [&BoundingBox; 2]) -> Option<PlaneCovariance> {
        self.encoder.displacement_covariance(boxes)
    }

    /// Returns the completed boxes if something hides the lower part of a box. Only a model of the recipe
    /// `gaussian_process` knows how tall its targets are; others return `None`.
    /// `recent` summarises the earlier boxes of the same target and takes this one in.
    #[must_use]
    #[inline]
    pub fn hidden_foot(
        &self,
        bounding_box: &BoundingBox,
        recent: Option<&mut RecentBoxes>,
    ) -> Option<HiddenFoot> {
        self.encoder.hidden_foot(bounding_box, recent)
    }

    /// The answer for a box whose foot may be hidden: the mixture of `seen`, the answer for the box as it is, with those
    /// for its completions.
    #[must_use]
    pub fn with_hidden_foot(&self, seen: Regression, hidden: &HiddenFoot) -> Regression {
        let HiddenFoot { probability, completed } = hidden;
        let of = |(weight, whole): &(f64, BoundingBox)| (probability * weight, self.regress(whole, None));
        let [middle, lower, upper] = completed.each_ref().map(of);
        let heaviest = if *probability < 0.5 { seen } else { middle.1 };
        Regression::mixture(&[(1.0 - probability, seen), middle, lower, upper], heaviest)
    }

    #[inline]
    fn regress_with(
        &self,
        bounding_box: &BoundingBox,
        fix: Option<EastNorth>,
        recent: Option<&mut RecentBoxes>,
    ) -> Regression {
        let context = ErrorContext {
            plane: &self.plane,
            error_model: &self.error_model,
            r95_scale: self.r95_scale,
            white_share: self.white_share,
        };
        let estimate = self.encoder.estimate(&context, bounding_box, fix, recent);
        let Estimate { position: regressed, covariance, box_noise, extrapolation_ratio, r95_scale, .. } =
            estimate;
        let unlimited = || Limited { position: regressed, covariance, factor: 1.0 };
        let Limited { position: regressed, covariance, factor } =
            self.scene.map_or_else(unlimited, |scene| {
                let radius_m = |covariance: PlaneCovariance| r95_scale * covariance.per_axis_m2().sqrt();
                scene.limit(regressed, covariance, extrapolation_ratio, radius_m)
            });
        let box_noise = box_noise.scaled(factor);
        let variance_m2 = covariance.per_axis_m2();
        let e_regression_m2 = (variance_m2 + self.added_m2).clamp(VARIANCE_RANGE_M2[0], VARIANCE_RANGE_M2[1]);
        let covariance = covariance.plus(PlaneCovariance::isotropic(e_regression_m2 - variance_m2));
        Regression {
            regressed,
            reconstruction_error: estimate.reconstruction_error,
            e_regression_m2,
            covariance,
            box_noise,
            outside_training: self
                .error_model
                .is_outside_training(extrapolation_ratio, estimate.reconstruction_error),
            r95_scale,
        }
    }
}
