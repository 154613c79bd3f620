//! Estimates the noise parameters of a track from the training samples of a camera and the model
//! fitted to them, and stores them with the model.
//!
//! What never happens here: any use of other than training samples.

use super::gnss_noise::{TimedResidual, estimate_gnss_noise};
use super::settings::{GnssNoise, MIN_WHITE_SHARE, RegressionNoise, TrackSettings};
use crate::domain::Sample;
use crate::filters::{FixError, Traverse};
use crate::geo::{EastNorth, LocalPlane};
use crate::model::{Regressor, TrackNoiseModel};

/// A gap longer than this ends a traverse, s.
const MAX_GAP_S: f64 = 10.0;
/// Time constant of the model's own error at one place, s: the error of a map does not change while
/// a target is stationary.
const MODEL_TIME_CONSTANT_S: f64 = 86_400.0;
/// Correlation length of the model's own error, in standard deviations of the training positions:
/// most of the error of a map is a shift or scale common to the whole scene.
const MODEL_LENGTH_SIGMAS: f64 = 3.0;
/// Below this many samples the receiver's temporal correlation is not estimated; the default, a
/// phone's, is used.
const MIN_SAMPLES: usize = 200;

impl TrackSettings {
    /// Settings estimated from the training samples of a model: the receiver's temporal correlation
    /// from that of the residuals, the model's from its detector noise and the extent of the
    /// training positions.
    #[must_use]
    pub fn estimate(train: &[Sample], regressor: &Regressor) -> Self {
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
            by_traverse(train).into_iter().map(|it| it.into_iter().map(&mut residual).collect()).collect();
        let settings = Self {
            regression: RegressionNoise {
                white_share: regressor.white_share(),
                time_constant_s: MODEL_TIME_CONSTANT_S,
                correlation_length_m: MODEL_LENGTH_SIGMAS * position_sigma_m(&positions),
                ..RegressionNoise::default()
            },
            ..Self::default()
        };
        if train.len() < MIN_SAMPLES {
            return settings;
        }
        let e_regression_m2 = variances_m2.iter().sum::<f64>() / variances_m2.len().max(1) as f64;
        let gnss = estimate_gnss_noise(&residuals, e_regression_m2, &settings.regression)
            .map_or_else(|| noise_from_fixes(train, plane, regressor.e_gnss_m2()), |estimate| estimate.noise);
        Self { gnss, ..settings }
    }

    /// The settings stored with a model; the defaults for a model without them.
    #[must_use]
    pub fn from_model(regressor: &Regressor) -> Self {
        let Some(stored) = regressor.track_noise() else { return Self::default() };
        Self {
            gnss: GnssNoise {
                white_share: stored.gnss_white_share.max(MIN_WHITE_SHARE),
                time_constant_s: stored.gnss_time_constant_s,
            },
            regression: RegressionNoise {
                white_share: stored.regression_white_share,
                time_constant_s: stored.regression_time_constant_s,
                correlation_length_m: stored.regression_length_m,
                ..RegressionNoise::default()
            },
            ..Self::default()
        }
    }

    /// The parameters to store with a model, so that [`Self::from_model`] returns these settings.
    #[must_use]
    pub const fn noise_model(&self) -> TrackNoiseModel {
        TrackNoiseModel {
            gnss_white_share: self.gnss.white_share,
            gnss_time_constant_s: self.gnss.time_constant_s,
            regression_white_share: self.regression.white_share,
            regression_time_constant_s: self.regression.time_constant_s,
            regression_length_m: self.regression.correlation_length_m,
        }
    }
}

/// The training fixes by target and traverse, each in order of time from 0 s.
pub fn traverses(train: &[Sample], plane: &LocalPlane) -> Vec<Traverse> {
    by_traverse(train)
        .into_iter()
        .map(|samples| {
            let elapsed_s = |sample: &&Sample| sample.time.duration_since(samples[0].time).as_secs_f64();
            let fixes = samples.iter().map(|sample| plane.to_plane(sample.fix.position)).collect();
            (samples.iter().map(elapsed_s).collect(), fixes)
        })
        .collect()
}

fn by_traverse(train: &[Sample]) -> Vec<Vec<&Sample>> {
    let mut samples: Vec<&Sample> = train.iter().collect();
    samples.sort_by_key(|sample| (&sample.target_id, sample.time));
    let is_same = |one: &&Sample, next: &&Sample| {
        one.target_id == next.target_id && next.time.duration_since(one.time).as_secs_f64() <= MAX_GAP_S
    };
    samples.chunk_by(is_same).map(<[&Sample]>::to_vec).collect()
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

/// The receiver's temporal correlation from the fixes alone, where there are too few residuals.
fn noise_from_fixes(train: &[Sample], plane: &LocalPlane, variance_m2: f64) -> GnssNoise {
    let error = FixError::split(variance_m2.sqrt(), &traverses(train, plane));
    GnssNoise { white_share: error.white_m.powi(2) / variance_m2, time_constant_s: error.time_constant_s }
}

#[cfg(test)]
mod tests {
    use std::ops::ControlFlow;

    use super::*;
    use crate::domain::{GnssError, Recipe, SigmaM};
    use crate::model::{FitOptions, fit};
    use crate::simulation::{Options, simulate};

    #[test]
    fn settings_are_stored_with_a_model_and_default_without_them() {
        let train = simulate(&Options { samples: 400, ..Options::demo() }).training_samples();
        let options = FitOptions {
            recipe: Recipe::Hybrid,
            seed: 1,
            epochs: Some(5),
            image_size: None,
            gnss_error: GnssError::Known(SigmaM::new(2.2).expect("valid")),
        };
        let mut artifact = fit(&train, &options, &mut |_| ControlFlow::Continue(())).expect("fitted");
        let regressor = artifact.load().expect("a model");
        assert_eq!(TrackSettings::from_model(&regressor), TrackSettings::default());
        let estimated = TrackSettings::estimate(&train, &regressor);
        assert_ne!(estimated, TrackSettings::default());
        estimated.noise_model().write(&mut artifact.metadata.parameters);
        assert_eq!(TrackSettings::from_model(&artifact.load().expect("a model")), estimated);
    }
}
