//! What a track should believe of a camera: learnt from the training samples and the model they gave,
//! kept in the model's metadata.
//!
//! What never happens here: a look at anything but training samples.

use super::noise::{ResidualAt, estimate_gnss_noise};
use super::settings::{GnssNoise, RegressionNoise, SMALLEST_WHITE_SHARE, TrackSettings};
use crate::domain::Sample;
use crate::filters::FixError;
use crate::geo::{EastNorth, LocalPlane};
use crate::model::{Regressor, TrackBeliefs};

/// A hole longer than this ends a pass, s.
const PASS_HOLE_S: f64 = 10.0;
/// Time in which a track takes the model's own error for the same, s.
const MODEL_STAYS_S: f64 = 86_400.0;
/// The same for its place, in standard deviations of the training positions: most of what a map errs
/// is the same shift or stretch all over the scene.
const MODEL_REACHES: f64 = 3.0;

/// Fewer samples do not tell how a receiver's error stays; then it is taken for a phone's.
const FEWEST_FOR_COLOUR: usize = 200;

impl TrackSettings {
    /// From the samples that a model was trained on: the receiver's error by its colour in the
    /// residuals, the model's by how restless its boxes are and how far the training reaches.
    #[must_use]
    pub fn learn(train: &[Sample], regressor: &Regressor) -> Self {
        learn(train, regressor)
    }

    /// From a model's metadata; the defaults where it does not say.
    #[must_use]
    pub fn learnt_by(regressor: &Regressor) -> Self {
        let Some(beliefs) = regressor.track_beliefs() else { return Self::default() };
        Self {
            gnss: GnssNoise {
                white_share: beliefs.gnss_white_share.max(SMALLEST_WHITE_SHARE),
                time_constant_s: beliefs.gnss_time_constant_s,
            },
            regression: RegressionNoise {
                white_share: beliefs.regression_white_share,
                time_constant_s: beliefs.regression_time_constant_s,
                length_m: beliefs.regression_length_m,
                ..RegressionNoise::default()
            },
            ..Self::default()
        }
    }

    /// What a model's metadata should say for [`Self::learnt_by`] to give these settings.
    #[must_use]
    pub const fn beliefs(&self) -> TrackBeliefs {
        TrackBeliefs {
            gnss_white_share: self.gnss.white_share,
            gnss_time_constant_s: self.gnss.time_constant_s,
            regression_white_share: self.regression.white_share,
            regression_time_constant_s: self.regression.time_constant_s,
            regression_length_m: self.regression.length_m,
        }
    }
}

/// Fixes of one target in one pass: times in s, and where in the plane.
pub type Pass = (Vec<f64>, Vec<EastNorth>);

/// The training fixes by target and pass, in order of time.
pub fn passes(train: &[Sample], plane: &LocalPlane) -> Vec<Pass> {
    by_pass(train)
        .into_iter()
        .map(|pass| {
            let seconds = |sample: &&Sample| sample.time.duration_since(pass[0].time).as_secs_f64();
            let places = pass.iter().map(|sample| plane.to_plane(sample.fix.position)).collect();
            (pass.iter().map(seconds).collect(), places)
        })
        .collect()
}

fn by_pass(train: &[Sample]) -> Vec<Vec<&Sample>> {
    let mut rows: Vec<&Sample> = train.iter().collect();
    rows.sort_by_key(|sample| (&sample.target_id, sample.time));
    let same = |one: &&Sample, next: &&Sample| {
        one.target_id == next.target_id && next.time.duration_since(one.time).as_secs_f64() <= PASS_HOLE_S
    };
    rows.chunk_by(same).map(<[&Sample]>::to_vec).collect()
}

fn learn(train: &[Sample], regressor: &Regressor) -> TrackSettings {
    let plane = regressor.plane();
    let mut squares_m2 = Vec::new();
    let mut points = Vec::new();
    let residuals: Vec<Vec<ResidualAt>> = by_pass(train)
        .into_iter()
        .map(|pass| {
            pass.into_iter()
                .map(|sample| {
                    let fix = plane.to_plane(sample.fix.position);
                    let regression = regressor.regress(&sample.bounding_box, Some(fix));
                    points.push(regression.regressed);
                    squares_m2.push(regression.e_regression_m2);
                    let EastNorth { east_m, north_m } = regression.regressed;
                    let difference =
                        EastNorth { east_m: fix.east_m - east_m, north_m: fix.north_m - north_m };
                    ResidualAt { time: sample.time, difference }
                })
                .collect()
        })
        .collect();
    let settings = TrackSettings {
        regression: RegressionNoise {
            white_share: regressor.unrest_share(),
            // What the model has learnt wrongly it does not unlearn while a target stands.
            time_constant_s: MODEL_STAYS_S,
            length_m: MODEL_REACHES * spread_m(&points),
            ..RegressionNoise::default()
        },
        ..TrackSettings::default()
    };
    let e_regression_m2 = squares_m2.iter().sum::<f64>() / squares_m2.len().max(1) as f64;
    if train.len() < FEWEST_FOR_COLOUR {
        return settings;
    }
    let gnss = estimate_gnss_noise(&residuals, e_regression_m2, &settings.regression)
        .map_or_else(|| split(train, plane, regressor.e_gnss_m2()), |estimate| estimate.noise);
    TrackSettings { gnss, ..settings }
}

/// Standard deviation per axis of positions, at least 1 m.
fn spread_m(points: &[EastNorth]) -> f64 {
    let count = points.len().max(1) as f64;
    let mean = |of: fn(&EastNorth) -> f64| points.iter().map(of).sum::<f64>() / count;
    let middle = EastNorth { east_m: mean(|point| point.east_m), north_m: mean(|point| point.north_m) };
    let square_m2 = points.iter().map(|point| point.distance_m(middle).powi(2)).sum::<f64>() / (2.0 * count);
    square_m2.sqrt().max(1.0)
}

/// The same from the fixes alone, where residuals are too few.
fn split(train: &[Sample], plane: &LocalPlane, variance_m2: f64) -> GnssNoise {
    let error = FixError::split(variance_m2.sqrt(), &passes(train, plane));
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
    fn a_model_carries_what_was_learnt_and_one_of_before_the_defaults() {
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
        assert_eq!(TrackSettings::learnt_by(&regressor), TrackSettings::default());
        let learnt = TrackSettings::learn(&train, &regressor);
        assert_ne!(learnt, TrackSettings::default());
        learnt.beliefs().write(&mut artifact.metadata.parameters);
        assert_eq!(TrackSettings::learnt_by(&artifact.load().expect("a model")), learnt);
    }
}
