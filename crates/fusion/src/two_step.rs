//! The two-step fusion of Liang et al. 2022: (5) the regression's error from its reconstruction
//! error, (6) and (7) the confidences, (8) the weighted mean; before it a chi-square test of box against
//! fix, because a weighted mean of contradicting sources is wrong with confidence.

use super::observed::{ObservedBox, ObservedPositions, PAIR_GATE, PairInnovation};
use super::track::MeasurementSource;
use crate::domain::{Confidences, Flag, FusedFix, ImageSize, Observation};
use crate::geo::{EastNorth, LocalPlane, PLANE_RANGE_M, PlaneCovariance, distance_m};
use crate::model::{R95_PER_SIGMA, Regression, Regressor};
use crate::statistics::{CHI_SQUARE_95, ONE_SIDED_95};

/// From here to [`PAIR_GATE`] the stated radius grows from that of consistent sources to one that holds the truth
/// whichever is right.
const WIDENING_STARTS_AT: f64 = CHI_SQUARE_95;

const ALL_REGRESSION: Confidences = Confidences { regression: 1.0, gnss: 0.0 };
const ALL_GNSS: Confidences = Confidences { regression: 0.0, gnss: 1.0 };

/// The weights (6) and (7): each source by the inverse of its error variance (m2, per axis).
///
/// They sum to 1 exactly, since the second is what the first leaves.
#[must_use]
pub fn confidences(e_regression_m2: f64, e_gnss_m2: f64) -> Confidences {
    let regression = e_gnss_m2 / (e_regression_m2 + e_gnss_m2);
    Confidences { regression, gnss: 1.0 - regression }
}

/// The weighted mean (8) in the local plane, and the 95 % radius of it in m.
///
/// The radius takes the two errors for independent; the regression's is first brought to its
/// calibrated size by [`Regression::r95_scale`].
#[must_use]
pub fn two_step(regression: &Regression, fix: EastNorth, e_gnss_m2: f64) -> (EastNorth, Confidences, f64) {
    let weights = confidences(regression.e_regression_m2, e_gnss_m2);
    let fused = EastNorth {
        east_m: weights.regression * regression.regressed.east_m + weights.gnss * fix.east_m,
        north_m: weights.regression * regression.regressed.north_m + weights.gnss * fix.north_m,
    };
    let regression_r95_m = weights.regression * regression.r95_m();
    let gnss_r95_m = weights.gnss * gnss_r95_m(e_gnss_m2);
    (fused, weights, (regression_r95_m * regression_r95_m + gnss_r95_m * gnss_r95_m).sqrt())
}

/// Answers one observation.
///
/// `model` is the active model and its version number, `image_size` that of the profile,
/// `e_gnss_m2` the receiver's variance per axis for fixes that do not state their own. `None` where
/// there is a box but no model.
#[must_use]
pub fn fuse(
    observation: &Observation,
    model: Option<(&Regressor, u32)>,
    image_size: Option<ImageSize>,
    e_gnss_m2: Option<f64>,
) -> Option<FusedFix> {
    let regressor = model.map(|(regressor, _)| regressor);
    let observed = ObservedPositions::of(observation, regressor, image_size, e_gnss_m2, None);
    fuse_observed(observation, &observed, model, image_size)
}

/// As [`fuse`], for an observation whose positions are known.
#[must_use]
pub fn fuse_observed(
    observation: &Observation,
    observed: &ObservedPositions<'_>,
    model: Option<(&Regressor, u32)>,
    image_size: Option<ImageSize>,
) -> Option<FusedFix> {
    let Some(bounding_box) = observation.bounding_box() else {
        return pass_through(observation, observed);
    };
    let ((_, version), plane) = (model?, observed.plane?);
    let regressed = observed.regressed.as_ref()?;
    let mut flags = Vec::new();
    if observation.fix().is_none() {
        flags.push(Flag::GnssDenied);
    }
    if bounding_box.touches_border(image_size) {
        flags.push(Flag::BoxAtBorder);
    }
    if regressed.independent.outside_training {
        flags.push(Flag::OutsideTraining);
    }
    if regressed.is_foot_hidden {
        flags.push(Flag::FootHidden);
    }
    if regressed.is_frozen {
        flags.push(Flag::BoxFrozen);
    }
    let Combined { position, confidences, r95_m, shape } = combine(observed, regressed, &mut flags);
    let Regression { e_regression_m2, reconstruction_error, .. } = regressed.one_step;
    Some(FusedFix {
        time: observation.time(),
        target_id: observation.target_id().cloned(),
        fused: plane.to_position(position),
        regressed: Some(plane.to_position(regressed.one_step.regressed)),
        gnss: observation.fix(),
        confidences,
        e_regression_m2: Some(e_regression_m2),
        e_gnss_m2: observed.fix.map(|fix| fix.variance_m2),
        r95_m,
        covariance: shape.with_r95_m(r95_m),
        regressed_covariance: Some(regressed.one_step.normal_covariance()),
        reconstruction_error: Some(reconstruction_error).filter(|error| error.is_finite()),
        model_version: Some(version),
        flags,
    })
}

/// A position in the model's plane with its weights and 95 % radius.
struct Combined {
    position: EastNorth,
    confidences: Confidences,
    r95_m: f64,
    /// A multiple of the error's covariance, m2.
    shape: PlaneCovariance,
}

/// The position from a box and perhaps a fix; notes in `flags` which of them was not used.
fn combine(observed: &ObservedPositions<'_>, regressed: &ObservedBox, flags: &mut Vec<Flag>) -> Combined {
    let box_alone = || Combined {
        position: regressed.independent.regressed,
        confidences: ALL_REGRESSION,
        r95_m: regressed.independent.r95_m(),
        shape: regressed.independent.covariance,
    };
    if !regressed.is_usable {
        flags.push(Flag::BoxRejected);
    }
    let Some(fix) = observed.fix else { return box_alone() };
    let Some(fix_point) = fix.in_plane else {
        flags.extend([Flag::SourcesDisagree, Flag::FixRejected, Flag::FixOutOfRange]);
        return box_alone();
    };
    let fix_alone = || Combined {
        position: fix_point,
        confidences: ALL_GNSS,
        r95_m: gnss_r95_m(fix.variance_m2),
        shape: PlaneCovariance::isotropic(fix.variance_m2),
    };
    let Some(PairInnovation { distance_m, nis }) = observed.innovation() else { return fix_alone() };
    let regression_sigma_m = regressed.independent.variance_m2().sqrt();
    // The radius about a position that holds the truth if the source at that distance is right.
    let reaching = |distance_m: f64, sigma_m: f64| distance_m + ONE_SIDED_95 * sigma_m;
    match observed.contradicting_source() {
        Some(MeasurementSource::Regressed) => {
            flags.extend([Flag::SourcesDisagree, Flag::BoxRejected]);
            let fix_alone = fix_alone();
            Combined { r95_m: fix_alone.r95_m.max(reaching(distance_m, regression_sigma_m)), ..fix_alone }
        }
        Some(MeasurementSource::Fix) => {
            flags.extend([Flag::SourcesDisagree, Flag::FixRejected]);
            let box_alone = box_alone();
            Combined { r95_m: box_alone.r95_m.max(reaching(distance_m, fix.variance_m2.sqrt())), ..box_alone }
        }
        None => {
            let (position, confidences, r95_m) = two_step(&regressed.one_step, fix_point, fix.variance_m2);
            let to_box_m = position.distance_m(regressed.independent.regressed);
            let to_fix_m = position.distance_m(fix_point);
            let either_m = reaching(to_box_m, regression_sigma_m)
                .max(reaching(to_fix_m, fix.variance_m2.sqrt()))
                .max(r95_m);
            let share = ((nis - WIDENING_STARTS_AT) / (PAIR_GATE - WIDENING_STARTS_AT)).clamp(0.0, 1.0);
            let shape = fused_covariance(&regressed.one_step, fix.variance_m2, confidences);
            Combined { position, confidences, r95_m: r95_m + share * (either_m - r95_m), shape }
        }
    }
}

/// Covariance of the weighted mean (8) of independent errors, m2.
fn fused_covariance(regression: &Regression, e_gnss_m2: f64, weights: Confidences) -> PlaneCovariance {
    let of_fix = PlaneCovariance::isotropic(weights.gnss * weights.gnss * e_gnss_m2);
    regression.normal_covariance().scaled(weights.regression * weights.regression).plus(of_fix)
}

fn gnss_r95_m(e_gnss_m2: f64) -> f64 {
    R95_PER_SIGMA * e_gnss_m2.sqrt()
}

/// The answer for an observation without a box: its fix. A fix out of range of the camera's scene is
/// answered with a radius that reaches back to the scene.
fn pass_through(observation: &Observation, observed: &ObservedPositions<'_>) -> Option<FusedFix> {
    let (fix, measured) = (observation.fix()?, observed.fix?);
    let mut flags = vec![Flag::BoxMissing];
    if observed.plane.is_none() {
        flags.push(Flag::NoModel);
    }
    let mut r95_m = gnss_r95_m(measured.variance_m2);
    if observed.fix_is_out_of_range() {
        flags.push(Flag::FixOutOfRange);
        let to_scene_m = |plane: &LocalPlane| distance_m(fix.position, plane.origin()) + PLANE_RANGE_M;
        r95_m = r95_m.max(observed.plane.map_or(0.0, to_scene_m));
    }
    Some(FusedFix {
        time: observation.time(),
        target_id: observation.target_id().cloned(),
        fused: fix.position,
        regressed: None,
        gnss: Some(fix),
        confidences: ALL_GNSS,
        e_regression_m2: None,
        e_gnss_m2: Some(measured.variance_m2),
        r95_m,
        covariance: PlaneCovariance::isotropic(measured.variance_m2).with_r95_m(r95_m),
        regressed_covariance: None,
        reconstruction_error: None,
        model_version: None,
        flags,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn confidences_sum_to_one_and_favour_the_better(
            e_regression_m2 in 1e-6..1e6f64, e_gnss_m2 in 1e-6..1e6f64,
        ) {
            let weights = confidences(e_regression_m2, e_gnss_m2);
            prop_assert!((weights.regression + weights.gnss - 1.0).abs() < 1e-12);
            prop_assert_eq!(weights.regression > weights.gnss, e_regression_m2 < e_gnss_m2);
        }

        #[test]
        fn the_fused_position_lies_between_and_is_surer(
            e_regression_m2 in 1e-3..1e3f64, e_gnss_m2 in 1e-3..1e3f64, east_m in -50.0..50.0f64,
        ) {
            let regression = Regression {
                regressed: EastNorth { east_m, north_m: 3.0 },
                reconstruction_error: 1.0,
                e_regression_m2,
                covariance: PlaneCovariance::isotropic(e_regression_m2),
                box_noise: PlaneCovariance::default(),
                outside_training: false,
                r95_scale: R95_PER_SIGMA,
            };
            let fix = EastNorth { east_m: 7.0, north_m: -2.0 };
            let (fused, _, r95_m) = two_step(&regression, fix, e_gnss_m2);
            let apart = regression.regressed.distance_m(fix);
            prop_assert!(fused.distance_m(fix) + fused.distance_m(regression.regressed) <= apart + 1e-9);
            prop_assert!(r95_m <= R95_PER_SIGMA * e_regression_m2.min(e_gnss_m2).sqrt() + 1e-9);
            // For isotropic errors the covariance has the stated radius as it is.
            let covariance = fused_covariance(&regression, e_gnss_m2, confidences(e_regression_m2, e_gnss_m2));
            prop_assert!((covariance.r95_m() / r95_m - 1.0).abs() < 2e-3);
            prop_assert!((covariance.with_r95_m(2.0 * r95_m).r95_m() / r95_m - 2.0).abs() < 1e-9);
        }
    }
}
