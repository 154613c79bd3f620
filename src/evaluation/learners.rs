//! Learns what a set of methods needs, from the training samples alone, once per seed.

use std::ops::ControlFlow;

use super::runner::EvaluateOptions;
use crate::domain::{EpochReport, GnssError, Method, Recipe, Sample};
use crate::filters::{FixError, ImmUkf, ImmUkfOptions};
use crate::fusion::track::{GnssNoise, RegressionNoise, ResidualAt, TrackSettings, estimate_gnss_noise};
use crate::geo::{EastNorth, LocalPlane};
use crate::model::{FitEvent, FitOptions, Regressor, fit};

/// A hole longer than this ends a pass, s.
const PASS_HOLE_S: f64 = 10.0;
/// Accelerations that the IMM-UKF is tuned over, m/s2.
const ACCELERATIONS_MPS2: [f64; 7] = [0.03, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2];

/// Time in which a track takes the model's own error for the same, s.
const MODEL_STAYS_S: f64 = 86_400.0;
/// The same for its place, in standard deviations of the training positions: most of what a map errs
/// is the same shift or stretch all over the scene.
const MODEL_REACHES: f64 = 3.0;

/// Fewer samples do not tell how a receiver's error stays; then it is taken for a phone's.
const FEWEST_FOR_COLOUR: usize = 200;

/// Something learnt, or why it could not be, with what it cost.
pub(super) struct Learnt<T> {
    pub(super) outcome: Result<T, String>,
    pub(super) cpu_s: f64,
}

impl<T> Learnt<T> {
    /// Runs and times.
    pub(super) fn by(options: &EvaluateOptions, learn: impl FnOnce() -> Result<T, String>) -> Self {
        let begun_s = (options.cpu_s)();
        let outcome = learn();
        Self { outcome, cpu_s: (options.cpu_s)() - begun_s }
    }
}

/// A recipe's model with the curve of its fit.
pub(super) struct RecipeModel {
    pub(super) regressor: Regressor,
    pub(super) curve: Vec<EpochReport>,
}

/// The recipes that some methods need, each once.
pub(super) fn recipes_of(methods: &[Method], default: Recipe) -> Vec<Recipe> {
    Recipe::ALL
        .into_iter()
        .filter(|recipe| methods.iter().any(|method| method.recipe(default) == Some(*recipe)))
        .collect()
}

/// Fits one recipe.
pub(super) fn learn_recipe(
    recipe: Recipe,
    seed: u64,
    train: &[Sample],
    options: &EvaluateOptions,
    progress: &mut dyn FnMut(&str) -> ControlFlow<()>,
) -> Learnt<RecipeModel> {
    let fit_options = FitOptions {
        recipe,
        seed,
        epochs: options.epochs,
        image_size: options.image_size,
        gnss_error: options.gnss_sigma.map_or(GnssError::Unknown, GnssError::Known),
    };
    Learnt::by(options, || {
        let mut curve = Vec::new();
        let artifact = fit(train, &fit_options, &mut |event| match event {
            FitEvent::Progress(run) => {
                progress(&format!("{recipe}, seed {seed}, {} {}/{}", run.phase, run.epoch, run.epochs))
            }
            FitEvent::Epoch(epoch) => {
                curve.push(*epoch);
                ControlFlow::Continue(())
            }
            FitEvent::Note(_) => ControlFlow::Continue(()),
        });
        let regressor =
            artifact.map_err(|error| error.to_string())?.load().map_err(|error| error.to_string())?;
        Ok(RecipeModel { regressor, curve })
    })
}

/// Fixes of one target in one pass: times in s, and where in the plane.
pub(super) type Pass = (Vec<f64>, Vec<EastNorth>);

/// The training fixes by target and pass, in order of time.
pub(super) fn passes(train: &[Sample], plane: &LocalPlane) -> Vec<Pass> {
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

/// The IMM-UKF whose acceleration makes the training fixes likeliest, the receiver's variance given.
///
/// Coloured errors look like motion, so the likelihood alone would follow every fix; the track's own
/// split into white and coloured is not this baseline's to know.
pub(super) fn tune_imm_ukf(passes: &[Pass], variance_m2: f64) -> ImmUkfOptions {
    let likelihood = |acceleration_mps2: f64| -> f64 {
        let mut filter = ImmUkf::new(ImmUkfOptions::of_acceleration(acceleration_mps2));
        let mut sum = 0.0;
        for (times_s, fixes) in passes {
            filter.step(1e9, None);
            for (index, fix) in fixes.iter().enumerate() {
                let seconds = if index == 0 { 0.0 } else { times_s[index] - times_s[index - 1] };
                let estimate = filter.step(seconds, Some((*fix, variance_m2)));
                sum += estimate.map_or(0.0, |estimate| estimate.log_likelihood);
            }
        }
        sum
    };
    let scored = ACCELERATIONS_MPS2.map(|candidate| (likelihood(candidate), candidate));
    let best = scored.into_iter().max_by(|one, other| one.0.total_cmp(&other.0));
    ImmUkfOptions::of_acceleration(best.map_or(0.4, |(_, candidate)| candidate))
}

/// How a track should take the receiver: its error's colour, from the training residuals.
pub(super) fn track_settings(train: &[Sample], regressor: &Regressor, variance_m2: f64) -> TrackSettings {
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
        .map_or_else(|| split(train, plane, variance_m2), |estimate| estimate.noise);
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
