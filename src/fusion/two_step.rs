//! The two-step fusion of Liang et al. 2022: (5) the regression's error from its reconstruction
//! error, (6) and (7) the confidences, (8) the weighted mean.

use crate::domain::{Confidences, Flag, FusedFix, ImageSize, Observation, SigmaM};
use crate::geo::EastNorth;
use crate::model::{R95_PER_SIGMA, Regression, Regressor};

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
    let regression_r95_m = weights.regression * regression.r95_scale * regression.e_regression_m2.sqrt();
    let gnss_r95_m = weights.gnss * R95_PER_SIGMA * e_gnss_m2.sqrt();
    (fused, weights, regression_r95_m.hypot(gnss_r95_m))
}

/// Answers one observation.
///
/// `serving` is the active model and its version number, `image_size` that of the profile,
/// `e_gnss_m2` the receiver's variance per axis for fixes that do not say their own. `None` where
/// there is a box but no model: then there is no answer, and no guess either.
#[must_use]
pub fn fuse(
    observation: &Observation,
    serving: Option<(&Regressor, u32)>,
    image_size: Option<ImageSize>,
    e_gnss_m2: Option<f64>,
) -> Option<FusedFix> {
    let mut flags = Vec::new();
    let Some(bounding_box) = &observation.bounding_box else {
        return pass_through(observation, serving.is_some(), e_gnss_m2);
    };
    let (regressor, version) = serving?;
    let plane = regressor.plane();
    let fix = observation
        .fix
        .map(|fix| (plane.to_plane(fix.position), fix_variance_m2(observation, Some(regressor), e_gnss_m2)));
    let regression = regressor.regress(bounding_box, fix.map(|(point, _)| point));
    if fix.is_none() {
        flags.push(Flag::GnssDenied);
    }
    if bounding_box.touches_border(image_size) {
        flags.push(Flag::BoxAtBorder);
    }
    if regression.outside_training {
        flags.push(Flag::OutsideTraining);
    }
    let regressed = plane.to_position(regression.regressed);
    let (fused, confidences, r95_m) = match fix {
        Some((point, e_gnss_m2)) => {
            let (fused, confidences, r95_m) = two_step(&regression, point, e_gnss_m2);
            (plane.to_position(fused), confidences, r95_m)
        }
        None => (
            regressed,
            Confidences { regression: 1.0, gnss: 0.0 },
            regression.r95_scale * regression.e_regression_m2.sqrt(),
        ),
    };
    Some(FusedFix {
        time: observation.time,
        target_id: observation.target_id.clone(),
        fused,
        regressed: Some(regressed),
        gnss: observation.fix,
        confidences,
        e_regression_m2: Some(regression.e_regression_m2),
        e_gnss_m2: fix.map(|(_, e_gnss_m2)| e_gnss_m2),
        r95_m,
        reconstruction_error: Some(regression.reconstruction_error),
        model_version: Some(version),
        flags,
    })
}

/// Error variance per axis taken for a receiver of which nothing is known, m2: a phone in the open.
pub const UNKNOWN_RECEIVER_M2: f64 = 25.0;

/// The error variance per axis, m2, of an observation's fix: by its own word, else by the camera's
/// profile, else by the model, else that of a phone in the open.
#[must_use]
pub fn fix_variance_m2(
    observation: &Observation,
    regressor: Option<&Regressor>,
    e_gnss_m2: Option<f64>,
) -> f64 {
    let own_m2 = observation.fix.and_then(|fix| fix.sigma_m).map(SigmaM::variance_m2);
    own_m2.or(e_gnss_m2).or(regressor.map(Regressor::e_gnss_m2)).unwrap_or(UNKNOWN_RECEIVER_M2)
}

/// The answer for an observation without a box: its fix.
fn pass_through(observation: &Observation, has_model: bool, e_gnss_m2: Option<f64>) -> Option<FusedFix> {
    let fix = observation.fix?;
    let e_gnss_m2 = fix_variance_m2(observation, None, e_gnss_m2);
    let mut flags = vec![Flag::BoxMissing];
    if !has_model {
        flags.push(Flag::NoModel);
    }
    Some(FusedFix {
        time: observation.time,
        target_id: observation.target_id.clone(),
        fused: fix.position,
        regressed: None,
        gnss: Some(fix),
        confidences: Confidences { regression: 0.0, gnss: 1.0 },
        e_regression_m2: None,
        e_gnss_m2: Some(e_gnss_m2),
        r95_m: R95_PER_SIGMA * e_gnss_m2.sqrt(),
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
                outside_training: false,
                r95_scale: R95_PER_SIGMA,
            };
            let fix = EastNorth { east_m: 7.0, north_m: -2.0 };
            let (fused, _, r95_m) = two_step(&regression, fix, e_gnss_m2);
            let apart = regression.regressed.distance_m(fix);
            prop_assert!(fused.distance_m(fix) + fused.distance_m(regression.regressed) <= apart + 1e-9);
            prop_assert!(r95_m <= R95_PER_SIGMA * e_regression_m2.min(e_gnss_m2).sqrt() + 1e-9);
        }
    }
}
