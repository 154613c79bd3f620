//! From an observation to measured positions: where the box and the fix of one instant say their target
//! is, each with its error variance. [`super::two_step`] and [`super::target_track`] both start here, so
//! a box goes through the model once and both test the same numbers.

use jiff::Timestamp;

use super::track::MeasurementSource;
use crate::domain::{BoundingBox, ImageSize, Observation, SigmaM};
use crate::geo::{EastNorth, LocalPlane, PLANE_RANGE_M, PlaneCovariance, Position};
use crate::model::{RecentBoxes, Regression, Regressor};
use crate::statistics::CHI_SQUARE_99_9;

/// Beyond this quantile of chi-square, 99.9 %, box and fix are taken to contradict each other. One consistent pair in
/// 1,000 is.
pub const PAIR_GATE: f64 = CHI_SQUARE_99_9;

/// Error variance per axis of an unknown receiver, m2: a phone in the open.
pub const UNKNOWN_RECEIVER_M2: f64 = 25.0;

/// Least radius of a camera's scene, m: a target may be beyond what few samples of one place have shown.
const LEAST_SCENE_RADIUS_M: f64 = 100.0;
/// Standard deviations of a fix beyond the scene's radius from which it cannot be of a target in view.
const SCENE_MARGIN_SIGMAS: f64 = 4.0;

/// The error variance per axis, m2, of an observation's fix: its own, else the camera profile's, else the
/// model's, else that of a phone in the open.
#[must_use]
pub fn fix_variance_m2(
    observation: &Observation,
    regressor: Option<&Regressor>,
    e_gnss_m2: Option<f64>,
) -> f64 {
    let own_m2 = observation.fix().and_then(|fix| fix.sigma_m).map(SigmaM::variance_m2);
    own_m2.or(e_gnss_m2).or(regressor.map(Regressor::e_gnss_m2)).unwrap_or(UNKNOWN_RECEIVER_M2)
}

/// A fix as a measured position.
#[derive(Debug, Clone, Copy)]
pub struct ObservedFix {
    /// As the receiver reports it.
    pub position: Position,
    /// Error variance per axis, m2.
    pub variance_m2: f64,
    /// In the model's plane; `None` without a model, or beyond the plane's range.
    pub in_plane: Option<EastNorth>,
    /// True if it may be of a target in view: within [`Regressor::scene_radius_m`] (at least
    /// [`LEAST_SCENE_RADIUS_M`]) and four of its standard deviations of the scene's centre.
    pub is_in_scene: bool,
    /// For how long the target's fixes have been the same to the last digit, s.
    pub repeated_s: f64,
}

/// A box as a measured position.
#[derive(Debug, Clone, Copy)]
pub struct ObservedBox {
    /// The recipe's one-step answer. The network of `paper` has the fix among its inputs.
    pub one_step: Regression,
    /// From the box alone, so independent of the fix.
    pub independent: Regression,
    /// True if `independent` and its covariance are finite and within the plane's range. If not, both regressions are
    /// replaced by the plane's origin with [`PLANE_RANGE_M`] as their 95 % radius.
    pub is_usable: bool,
    /// True if the box is unlike those of training or cut by the image's border.
    pub is_unusual: bool,
    /// True if its error is as large as the scene: it says no more than that a target is in view.
    pub is_vague: bool,
    /// True if something hides the lower part of the target, more probably than not.
    pub is_foot_hidden: bool,
    /// For how long the target's boxes have been the same to the pixel, s.
    pub repeated_s: f64,
    /// True if that is longer than a standing target shows: the picture or the detector stands still, and the target
    /// may be anywhere in the scene.
    pub is_frozen: bool,
}

/// The positions that an observation measures.
#[derive(Debug, Clone, Copy)]
pub struct ObservedPositions<'a> {
    /// The instant of the measurement.
    pub time: Timestamp,
    /// The plane of the camera's model; `None` without a model.
    pub plane: Option<&'a LocalPlane>,
    /// The fix, if there is one.
    pub fix: Option<ObservedFix>,
    /// The box, if there are one and a model.
    pub regressed: Option<ObservedBox>,
}

/// Box and fix held against each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairInnovation {
    /// Distance of the regressed position (from the box alone) and the fix, m.
    pub distance_m: f64,
    /// Normalised innovation squared, e' S^-1 e with S the sum of both error covariances (Bar-Shalom, Li
    /// and Kirubarajan 2001, 5.4): chi-square with 2 degrees of freedom for consistent sources.
    pub nis: f64,
}

impl ObservedFix {
    fn of(observation: &Observation, regressor: Option<&Regressor>, e_gnss_m2: Option<f64>) -> Option<Self> {
        let position = observation.fix()?.position;
        let variance_m2 = fix_variance_m2(observation, regressor, e_gnss_m2);
        let in_plane = regressor.and_then(|regressor| regressor.plane().to_plane_within_range(position));
        let is_in_scene = regressor.zip(in_plane).is_some_and(|(regressor, point)| {
            let radius_m = regressor.scene_radius_m().max(LEAST_SCENE_RADIUS_M);
            point.distance_m(EastNorth::default()) <= radius_m + SCENE_MARGIN_SIGMAS * variance_m2.sqrt()
        });
        Some(Self { position, variance_m2, in_plane, is_in_scene, repeated_s: 0.0 })
    }
}

impl ObservedBox {
    fn of(
        bounding_box: &BoundingBox,
        regressor: &Regressor,
        fix: Option<EastNorth>,
        image_size: Option<ImageSize>,
        mut recent: Option<&mut RecentBoxes>,
    ) -> Self {
        let hidden = regressor.hidden_foot(bounding_box, recent.as_deref_mut());
        let is_foot_hidden = hidden.is_some_and(|hidden| hidden.probability >= 0.5);
        let seen = match recent.filter(|_| !is_foot_hidden) {
            Some(recent) => regressor.regress_next(bounding_box, None, recent),
            None => regressor.regress(bounding_box, None),
        };
        let independent = hidden.map_or(seen, |hidden| regressor.with_hidden_foot(seen, &hidden));
        let with_fix = fix.filter(|_| regressor.uses_fix());
        let one_step = with_fix.map(|fix| regressor.regress(bounding_box, Some(fix)));
        let is_usable = is_usable(&independent) && one_step.as_ref().is_none_or(is_usable);
        let one_step = one_step.unwrap_or(independent);
        Self {
            one_step: if is_usable { one_step } else { anywhere_in_range(&one_step) },
            independent: if is_usable { independent } else { anywhere_in_range(&independent) },
            is_usable,
            is_unusual: independent.outside_training || bounding_box.touches_border(image_size),
            is_vague: regressor.is_vague(&independent),
            is_foot_hidden,
            repeated_s: 0.0,
            is_frozen: false,
        }
    }

    /// The box after its target's boxes have been the same to the pixel for some time.
    pub(super) fn repeated_for(&mut self, repeated_s: f64, regressor: &Regressor) {
        self.repeated_s = repeated_s;
        self.is_frozen = repeated_s >= regressor.frozen_after_s();
        if self.is_frozen {
            self.independent = regressor.anywhere_in_scene(self.independent);
            self.one_step = regressor.anywhere_in_scene(self.one_step);
        }
    }
}

fn is_usable(regression: &Regression) -> bool {
    regression.regressed.is_within_range()
        && regression.e_regression_m2.is_finite()
        && regression.normal_covariance().is_finite()
}

/// Replaces a regression without a usable position: the origin, with the plane's range as `r95_m`.
fn anywhere_in_range(regression: &Regression) -> Regression {
    let e_regression_m2 = (PLANE_RANGE_M / regression.r95_scale).powi(2);
    Regression {
        regressed: EastNorth::default(),
        e_regression_m2,
        covariance: PlaneCovariance::isotropic(e_regression_m2),
        box_noise: PlaneCovariance::default(),
        outside_training: true,
        ..*regression
    }
}

impl<'a> ObservedPositions<'a> {
    /// `e_gnss_m2` is the receiver's variance per axis by the camera's profile, `image_size` the
    /// profile's. A box without a model measures nothing. `recent` summarises the earlier boxes of the same
    /// target, if it is followed, and takes this one in.
    #[must_use]
    pub fn of(
        observation: &Observation,
        regressor: Option<&'a Regressor>,
        image_size: Option<ImageSize>,
        e_gnss_m2: Option<f64>,
        recent: Option<&mut RecentBoxes>,
    ) -> Self {
        let fix = ObservedFix::of(observation, regressor, e_gnss_m2);
        let in_plane = fix.and_then(|fix| fix.in_plane);
        let bounding_box = observation.bounding_box();
        let regressed = bounding_box.as_ref().zip(regressor);
        Self {
            time: observation.time(),
            plane: regressor.map(Regressor::plane),
            fix,
            regressed: regressed.map(|(bounding_box, regressor)| {
                ObservedBox::of(bounding_box, regressor, in_plane, image_size, recent)
            }),
        }
    }

    /// True if neither the box nor the fix gives a position.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.fix.is_none() && self.usable_box().is_none()
    }

    /// The box, if it gives a position.
    #[must_use]
    pub fn usable_box(&self) -> Option<&ObservedBox> {
        self.regressed.as_ref().filter(|observed| observed.is_usable)
    }

    /// True if the fix lies beyond the range of the model's plane.
    #[must_use]
    pub fn fix_is_out_of_range(&self) -> bool {
        self.plane.is_some() && self.fix.is_some_and(|fix| fix.in_plane.is_none())
    }

    /// Box against fix, where both give a position.
    #[must_use]
    pub fn innovation(&self) -> Option<PairInnovation> {
        let observed = self.usable_box()?;
        let fix = self.fix?;
        let distance_m = observed.independent.regressed.distance_m(fix.in_plane?);
        let variance_m2 = observed.independent.variance_m2() + fix.variance_m2;
        Some(PairInnovation { distance_m, nis: distance_m * distance_m / variance_m2 })
    }

    /// The source not to use where the two contradict each other, or where the box says no more than that the target is in
    /// view and the fix is of none there: the box if it is unusual, for then its
    /// stated error rests on no training box, and the fix is of the scene; else the fix, for multipath, a
    /// frozen receiver and swapped coordinates give it errors that no receiver states.
    #[must_use]
    pub fn contradicting_source(&self) -> Option<MeasurementSource> {
        let PairInnovation { nis, .. } = self.innovation()?;
        let is_in_scene = self.fix.is_some_and(|fix| fix.is_in_scene);
        let says_in_view_alone = self.usable_box().is_some_and(|observed| observed.is_vague);
        let contradicts = nis > PAIR_GATE || (says_in_view_alone && !is_in_scene);
        let is_unusual =
            contradicts.then(|| self.usable_box().is_some_and(|observed| observed.is_unusual))?;
        Some(if is_unusual && is_in_scene { MeasurementSource::Regressed } else { MeasurementSource::Fix })
    }
}
