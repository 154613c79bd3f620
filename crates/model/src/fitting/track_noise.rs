//! The correlation of the errors of receiver and model, estimated from the training samples and the model
//! fitted to them, for the tracks that use the model.

use super::gnss_noise::{TimedResidual, estimate_gnss_noise};
use crate::artifact::{ModelParts, TrackNoiseModel};
use crate::domain::{NoiseCorrelation, Sample, SessionBias};
use crate::filters::noise_of_fixes;
use crate::geo::EastNorth;
use crate::recipes::gaussian_process;
use crate::regressor::Regressor;
use crate::samples::sequences::{fix_sequences, sequences};

/// Time constant of the model's own error at one place, s: the error of a map does not change while
/// a target is stationary.
const MODEL_TIME_CONSTANT_S: f64 = 86_400.0;
/// Radius of the scene, in standard deviations of the training positions. Tracks take some radii for the correlation
/// length of the model's own error: most of it is a shift or scale common to the whole scene.
const MODEL_LENGTH_SIGMAS: f64 = 3.0;
/// Share of the receiver's variance that is taken to last for a session where the fit does not estimate it:
/// half the standard deviation of the rest, as the prior of the recipe `gaussian_process`.
const SESSION: SessionBias =
    SessionBias { share: 0.2, time_constant_s: SessionBias::DEFAULT_TIME_CONSTANT_S };
/// Below this many samples the receiver's correlation is not estimated; that of a phone is used.
const MIN_SAMPLES: usize = 200;

/// Estimates the receiver's correlation over time from that of the residuals, the model's from the noise of
/// the detector and the extent of the training positions.
pub(super) fn estimate_track_noise(
    samples: &[Sample],
    regressor: &Regressor,
    parts: &ModelParts,
) -> TrackNoiseModel {
    let plane = regressor.plane();
    let mut variances_m2 = Vec::new();
    let mut positions = Vec::new();
    let mut residual = |sample: &Sample| {
        let fix = plane.to_plane(sample.fix.position);
        let regression = regressor.regress(&sample.bounding_box, Some(fix));
        positions.push(regression.regressed);
        variances_m2.push(regression.e_regression_m2);
        let EastNorth { east_m, north_m } = regression.regressed;
        let difference = EastNorth { east_m: fix.east_m - east_m, north_m: fix.north_m - north_m };
        TimedResidual { time: sample.time, difference }
    };
    let residuals: Vec<Vec<TimedResidual>> =
        sequences(samples).into_iter().map(|it| it.into_iter().map(&mut residual).collect()).collect();
    let regression =
        NoiseCorrelation { white_share: regressor.white_share(), time_constant_s: MODEL_TIME_CONSTANT_S };
    let regression_length_m = MODEL_LENGTH_SIGMAS * position_sigma_m(&positions);
    if let Some((gnss, gnss_session)) = gaussian_process::receiver_correlation(parts) {
        return TrackNoiseModel { gnss, gnss_session, regression, regression_length_m };
    }
    let gnss = if samples.len() < MIN_SAMPLES {
        NoiseCorrelation::PHONE
    } else {
        let e_regression_m2 = variances_m2.iter().sum::<f64>() / variances_m2.len().max(1) as f64;
        let from_fixes = || noise_of_fixes(regressor.e_gnss_m2(), &fix_sequences(samples, plane));
        estimate_gnss_noise(&residuals, e_regression_m2, &regression).unwrap_or_else(from_fixes).correlation
    };
    TrackNoiseModel { gnss, gnss_session: SESSION, regression, regression_length_m }
}

/// Standard deviation per axis of positions, at least 1 m.
fn position_sigma_m(positions: &[EastNorth]) -> f64 {
    let count = positions.len().max(1) as f64;
    let mean = |of: fn(&EastNorth) -> f64| positions.iter().map(of).sum::<f64>() / count;
    let centroid = EastNorth { east_m: mean(|point| point.east_m), north_m: mean(|point| point.north_m) };
    let variance_m2 =
        positions.iter().map(|point| point.distance_m(centroid).powi(2)).sum::<f64>() / (2.0 * count);
    variance_m2.sqrt().max(1.0)
}
