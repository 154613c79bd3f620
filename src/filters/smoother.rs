//! A kinematic smoother over the fixes of one target in one pass, for labels before training (the
//! paper's future work).
//!
//! Per axis: position, velocity, and the coloured part of the receiver's error as a Gauss-Markov
//! bias, forward by a Kalman filter and back by Rauch, Tung and Striebel (1965). Both axes have the
//! same model, so they share one covariance. What never happens here: a pass of another target
//! mixed in; the caller splits by target and by hole in time.

use nalgebra::{Matrix3, Matrix3x2, RowVector2, Vector3};

use crate::geo::EastNorth;

/// Variance of the first position and speed before anything is known, m2 and m2/s2.
const UNKNOWN_M2: f64 = 1e6;
const UNKNOWN_SPEED_M2_PER_S2: f64 = 400.0;
/// A fix whose squared distance in standard deviations (two axes) is beyond this counts less.
const CREDIBLE_NIS: f64 = 9.0;
/// Accelerations (m/s2) that [`tune_acceleration`] tries.
const ACCELERATIONS_MPS2: [f64; 9] = [0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0, 4.0];

/// A receiver's error per axis, split into what is new with each fix and what stays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FixError {
    /// Standard deviation of the white part, m.
    pub white_m: f64,
    /// Standard deviation of the coloured part, m.
    pub coloured_m: f64,
    /// Time in which the coloured part's correlation falls to 1/e, s.
    pub time_constant_s: f64,
}

impl FixError {
    /// A receiver whose fixes err independently.
    #[must_use]
    pub const fn white(sigma_m: f64) -> Self {
        Self { white_m: sigma_m, coloured_m: 0.0, time_constant_s: 40.0 }
    }

    /// Splits a known standard deviation per axis (m) by the fixes of some passes: what jumps from
    /// second difference to second difference is white, the rest is taken to be coloured with the
    /// 40 s that phones show (METHOD.md 2.5). A target's own jerks count as white, so the split
    /// errs to the white side. Passes are (times in s, fixes).
    #[must_use]
    pub fn split(sigma_m: f64, passes: &[(Vec<f64>, Vec<EastNorth>)]) -> Self {
        let mut jumps_m2: Vec<f64> =
            passes.iter().flat_map(|(times_s, fixes)| jumps_m2(times_s, fixes)).collect();
        let Some(middle) = jumps_m2.len().checked_sub(1).map(|last| last / 2) else {
            return Self::white(sigma_m);
        };
        jumps_m2.sort_by(f64::total_cmp);
        // The sum of two squared normal values has its median at 2 ln 2 of one variance; a second
        // difference of white fixes has six times their variance.
        let white_m2 = jumps_m2[middle] / (2.0 * std::f64::consts::LN_2) / 6.0;
        let white_m = white_m2.sqrt().min(sigma_m);
        let coloured_m = (sigma_m * sigma_m - white_m * white_m).sqrt();
        // Within the scatter of that estimate all of it is white.
        if white_m > 0.9 * sigma_m {
            return Self::white(sigma_m);
        }
        Self { white_m: white_m.max(0.01 * sigma_m), coloured_m, time_constant_s: 40.0 }
    }
}

/// Squared second differences of even spacing, both axes added, m2.
fn jumps_m2(times_s: &[f64], fixes: &[EastNorth]) -> Vec<f64> {
    let even = |window: &[f64]| {
        let (first_s, second_s) = (window[1] - window[0], window[2] - window[1]);
        first_s > 0.0 && second_s < 3.0 && (first_s - second_s).abs() < 0.1 * first_s
    };
    let jump = |fixes: &[EastNorth]| {
        let east_m = fixes[2].east_m - 2.0 * fixes[1].east_m + fixes[0].east_m;
        let north_m = fixes[2].north_m - 2.0 * fixes[1].north_m + fixes[0].north_m;
        east_m * east_m + north_m * north_m
    };
    let windows = times_s.windows(3).zip(fixes.windows(3));
    windows.filter(|(times, _)| even(times)).map(|(_, fixes)| jump(fixes)).collect()
}

/// A smoothed position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Smoothed {
    /// Where the target was, given the whole pass.
    pub position: EastNorth,
    /// Error variance per axis, m2. Errors of neighbours are strongly correlated.
    pub variance_m2: f64,
}

/// State of both axes at one fix: columns are east and north; rows position, velocity, bias.
#[derive(Debug, Clone, Copy)]
struct Belief {
    mean: Matrix3x2<f64>,
    covariance: Matrix3<f64>,
}

/// Smooths one pass: times in s, ascending, and as many fixes; `acceleration_mps2` is the target's
/// usual one. One answer per fix.
#[must_use]
pub fn smooth_pass(
    times_s: &[f64],
    fixes: &[EastNorth],
    error: &FixError,
    acceleration_mps2: f64,
) -> Vec<Smoothed> {
    let (steps, _) = filter(times_s, fixes, error, acceleration_mps2);
    let Some(last) = steps.last() else { return Vec::new() };
    let mut belief = last.updated;
    let mut backwards = vec![smoothed(&belief)];
    for pair in steps.windows(2).rev() {
        let (now, next) = (&pair[0], &pair[1]);
        let Some(inverse) = next.predicted.covariance.try_inverse() else { break };
        let gain = now.updated.covariance * next.transition.transpose() * inverse;
        belief = Belief {
            mean: now.updated.mean + gain * (belief.mean - next.predicted.mean),
            covariance: now.updated.covariance
                + gain * (belief.covariance - next.predicted.covariance) * gain.transpose(),
        };
        backwards.push(smoothed(&belief));
    }
    backwards.reverse();
    backwards
}

/// The acceleration (m/s2), of a coarse grid, under which the fixes of some passes are likeliest.
#[must_use]
pub fn tune_acceleration(passes: &[(Vec<f64>, Vec<EastNorth>)], error: &FixError) -> f64 {
    let likelihood = |&acceleration_mps2: &f64| -> f64 {
        passes.iter().map(|(times_s, fixes)| filter(times_s, fixes, error, acceleration_mps2).1).sum()
    };
    let scored = ACCELERATIONS_MPS2.iter().map(|candidate| (likelihood(candidate), *candidate));
    scored.max_by(|one, other| one.0.total_cmp(&other.0)).map_or(0.5, |(_, candidate)| candidate)
}

fn smoothed(belief: &Belief) -> Smoothed {
    Smoothed {
        position: EastNorth { east_m: belief.mean[(0, 0)], north_m: belief.mean[(0, 1)] },
        variance_m2: belief.covariance[(0, 0)].max(0.0),
    }
}

struct Step {
    transition: Matrix3<f64>,
    predicted: Belief,
    updated: Belief,
}

/// The forward pass, and the logarithm of the fixes' density.
fn filter(
    times_s: &[f64],
    fixes: &[EastNorth],
    error: &FixError,
    acceleration_mps2: f64,
) -> (Vec<Step>, f64) {
    // A floor keeps the bias invertible where nothing is coloured.
    let coloured_m2 = (error.coloured_m * error.coloured_m).max(1e-6);
    let Some(&first) = fixes.first() else { return (Vec::new(), 0.0) };
    let mut belief = Belief {
        mean: Matrix3x2::new(first.east_m, first.north_m, 0.0, 0.0, 0.0, 0.0),
        covariance: Matrix3::from_diagonal(&Vector3::new(UNKNOWN_M2, UNKNOWN_SPEED_M2_PER_S2, coloured_m2)),
    };
    let (mut steps, mut log_likelihood) = (Vec::with_capacity(fixes.len()), 0.0);
    for (index, fix) in fixes.iter().enumerate() {
        let seconds = if index == 0 { 0.0 } else { times_s[index] - times_s[index - 1] };
        let keep = (-seconds / error.time_constant_s).exp();
        let transition = Matrix3::new(1.0, seconds, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, keep);
        let mut noise = Matrix3::zeros();
        let density = acceleration_mps2 * acceleration_mps2;
        noise[(0, 0)] = density * seconds.powi(3) / 3.0;
        noise[(0, 1)] = density * seconds.powi(2) / 2.0;
        noise[(1, 0)] = noise[(0, 1)];
        noise[(1, 1)] = density * seconds;
        noise[(2, 2)] = coloured_m2 * (1.0 - keep * keep);
        let predicted = Belief {
            mean: transition * belief.mean,
            covariance: transition * belief.covariance * transition.transpose() + noise,
        };
        let (updated, density) = update(&predicted, *fix, error.white_m * error.white_m);
        // The first fix only says where the pass begins.
        log_likelihood += if index == 0 { 0.0 } else { density };
        belief = updated;
        steps.push(Step { transition, predicted, updated });
    }
    (steps, log_likelihood)
}

/// Takes a fix in; one that is hard to believe has its variance raised until it is believable.
fn update(predicted: &Belief, fix: EastNorth, white_m2: f64) -> (Belief, f64) {
    let observe = Vector3::new(1.0, 0.0, 1.0);
    let cross = predicted.covariance * observe;
    let foreseen_m2 = observe.dot(&cross);
    let innovation = RowVector2::new(fix.east_m, fix.north_m) - predicted.mean.row(0) - predicted.mean.row(2);
    let squared_m2 = innovation.norm_squared();
    let mut spread_m2 = foreseen_m2 + white_m2;
    if squared_m2 > CREDIBLE_NIS * spread_m2 {
        spread_m2 = squared_m2 / CREDIBLE_NIS;
    }
    let gain = cross / spread_m2;
    let belief = Belief {
        mean: predicted.mean + gain * innovation,
        covariance: predicted.covariance - gain * cross.transpose(),
    };
    let log_density = -0.5 * squared_m2 / spread_m2 - spread_m2.ln() - std::f64::consts::TAU.ln();
    (belief, log_density)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Sample;
    use crate::geo::LocalPlane;
    use crate::simulation::{Options, Scene, simulate};

    type Pass = (Vec<f64>, Vec<EastNorth>);

    /// Passes of fixes with the truth of each.
    fn passes(scene: Scene, seed: u64, samples: usize) -> (Vec<Pass>, Vec<Vec<EastNorth>>) {
        let rows = simulate(&Options { seed, samples, ..Options::new(scene) }).training_samples();
        let plane = LocalPlane::new(rows[0].truth.expect("simulated"));
        let mut passes: Vec<Pass> = Vec::new();
        let mut truths: Vec<Vec<EastNorth>> = Vec::new();
        let mut last_s = f64::NEG_INFINITY;
        for Sample { time, fix, truth, .. } in rows {
            let time_s = time.as_second() as f64;
            if time_s - last_s > 10.0 {
                passes.push(Pass::default());
                truths.push(Vec::new());
            }
            last_s = time_s;
            let (pass, truths) = (passes.last_mut().expect("begun"), truths.last_mut().expect("begun"));
            pass.0.push(time_s);
            pass.1.push(plane.to_plane(fix.position));
            truths.push(plane.to_plane(truth.expect("simulated")));
        }
        (passes, truths)
    }

    /// Mean square per axis of fixes and smoothed positions, and mean of squared error over variance.
    fn judge(scene: Scene, sigma_m: f64) -> (f64, f64, f64) {
        let (passes, truths) = passes(scene, 5, 4_000);
        let error = FixError::split(sigma_m, &passes);
        let acceleration_mps2 = tune_acceleration(&passes, &error);
        let (mut raw, mut smooth, mut ratio, mut count) = (0.0, 0.0, 0.0, 0.0);
        for ((times_s, fixes), truths) in passes.iter().zip(&truths) {
            for ((answer, fix), truth) in
                smooth_pass(times_s, fixes, &error, acceleration_mps2).iter().zip(fixes).zip(truths)
            {
                raw += fix.error_per_axis_m2(*truth);
                smooth += answer.position.error_per_axis_m2(*truth);
                ratio += answer.position.error_per_axis_m2(*truth) / answer.variance_m2;
                count += 1.0;
            }
        }
        (raw / count, smooth / count, ratio / count)
    }

    #[test]
    fn white_fixes_are_smoothed_many_times_better_and_the_variance_is_honest() {
        let (raw_m2, smooth_m2, ratio) = judge(Scene::Airport, 29.5);
        assert!(smooth_m2 < 0.15 * raw_m2, "{smooth_m2} of {raw_m2}");
        assert!((0.7..1.4).contains(&ratio), "{ratio}");
    }

    #[test]
    fn coloured_fixes_gain_little_and_the_smoother_knows_it() {
        let (raw_m2, smooth_m2, ratio) = judge(Scene::Square, 2.2);
        assert!(smooth_m2 < raw_m2, "{smooth_m2} of {raw_m2}");
        assert!((0.5..1.6).contains(&ratio), "{ratio}");
    }

    #[test]
    fn the_split_finds_what_is_white() {
        let (walked, _) = passes(Scene::Square, 6, 3_000);
        let phone = FixError::split(2.2, &walked);
        assert!(phone.white_m < 0.4 && phone.coloured_m > 2.1, "{phone:?}");
        let (taxied, _) = passes(Scene::Airport, 6, 3_000);
        let noisy = FixError::split(29.5, &taxied);
        assert!((noisy.white_m - 29.5).abs() < 1e-9 && noisy.coloured_m == 0.0, "{noisy:?}");
    }

    #[test]
    fn one_wild_fix_does_not_bend_the_pass() {
        let times_s: Vec<f64> = (0..60).map(f64::from).collect();
        let mut fixes: Vec<EastNorth> =
            times_s.iter().map(|&time_s| EastNorth { east_m: 1.2 * time_s, north_m: 0.0 }).collect();
        fixes[30].north_m = 500.0;
        let answers = smooth_pass(&times_s, &fixes, &FixError::white(2.0), 0.1);
        assert_eq!(answers.len(), 60);
        assert!(answers[30].position.north_m.abs() < 3.0, "{:?}", answers[30]);
        assert!(smooth_pass(&[], &[], &FixError::white(2.0), 0.1).is_empty());
    }
}
