//! A kinematic fixed-interval smoother over the fixes of one traverse, for training labels (the paper's
//! future work).
//!
//! State per axis: `[position velocity bias]`, the bias being the Gauss-Markov part of the receiver's
//! error; a Kalman filter forward and the smoother of Rauch, Tung and Striebel (1965) backward. Both
//! axes have the same model and share one covariance. The caller splits samples by target and gap.

use nalgebra::{Matrix3, Matrix3x2, RowVector2, Vector3};

use super::Traverse;
use crate::domain::{GaussMarkovNoise, NoiseCorrelation};
use crate::geo::EastNorth;

/// Initial variance per axis of position (m2) and velocity (m2/s2).
const INITIAL_M2: f64 = 1e6;
const INITIAL_SPEED_M2_S2: f64 = 400.0;
/// The variance of a fix is inflated until its NIS (two axes) is at most this.
const MAX_NIS: f64 = 9.0;
/// Least standard deviation of the white part, m.
const MIN_WHITE_SIGMA_M: f64 = 0.01;
/// Candidate accelerations of [`tune_acceleration`], m/s2.
const ACCELERATIONS_M_S2: [f64; 9] = [0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0, 4.0];

/// The noise of fixes whose variance per axis (m2) is known, decomposed by their second differences, whose
/// variance is six times that of the white part. The rest is modelled with the time constant of phones.
/// Accelerations of the target inflate the white part.
#[must_use]
pub fn noise_of_fixes(variance_m2: f64, traverses: &[Traverse]) -> GaussMarkovNoise {
    let mut squared_m2: Vec<f64> =
        traverses.iter().flat_map(|(times_s, fixes)| squared_second_differences_m2(times_s, fixes)).collect();
    let time_constant_s = NoiseCorrelation::PHONE.time_constant_s;
    let white =
        GaussMarkovNoise { variance_m2, correlation: NoiseCorrelation { white_share: 1.0, time_constant_s } };
    let Some(median) = squared_m2.len().checked_sub(1).map(|last| last / 2) else {
        return white;
    };
    squared_m2.sort_by(f64::total_cmp);
    // The squared length of a bivariate normal vector has the median 2 ln 2 times the variance.
    let white_m2 = squared_m2[median] / (2.0 * std::f64::consts::LN_2) / 6.0;
    let sigma_m = variance_m2.sqrt();
    let white_m = white_m2.sqrt().min(sigma_m);
    // Within the uncertainty of that estimate all of it is white.
    if white_m > 0.9 * sigma_m {
        return white;
    }
    let white_share = white_m.max(0.01 * sigma_m).powi(2) / variance_m2;
    GaussMarkovNoise { variance_m2, correlation: NoiseCorrelation { white_share, time_constant_s } }
}

/// Squared lengths of second differences of evenly spaced fixes, m2.
fn squared_second_differences_m2(times_s: &[f64], fixes: &[EastNorth]) -> Vec<f64> {
    let is_even = |window: &[f64]| {
        let (first_s, second_s) = (window[1] - window[0], window[2] - window[1]);
        first_s > 0.0 && second_s < 3.0 && (first_s - second_s).abs() < 0.1 * first_s
    };
    let squared_length_m2 = |fixes: &[EastNorth]| {
        let east_m = fixes[2].east_m - 2.0 * fixes[1].east_m + fixes[0].east_m;
        let north_m = fixes[2].north_m - 2.0 * fixes[1].north_m + fixes[0].north_m;
        east_m * east_m + north_m * north_m
    };
    let windows = times_s.windows(3).zip(fixes.windows(3));
    windows.filter(|(times, _)| is_even(times)).map(|(_, fixes)| squared_length_m2(fixes)).collect()
}

/// A smoothed position.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SmoothedPosition {
    /// Estimated position given all fixes of the traverse.
    pub position: EastNorth,
    /// Error variance per axis, m2. Errors of neighbouring positions are strongly correlated.
    pub variance_m2: f64,
}

/// Estimate of both axes at one fix: rows of the mean are position, velocity and bias, columns east and
/// north; the covariance is that of each axis.
#[derive(Debug, Clone, Copy)]
struct StateEstimate {
    mean: Matrix3x2<f64>,
    covariance: Matrix3<f64>,
}

/// Smooths one traverse: times in s, ascending, and a fix for each; `acceleration_m_s2` is the standard
/// deviation of the target's acceleration. Returns a position per fix.
#[must_use]
pub fn smooth_traverse(
    times_s: &[f64],
    fixes: &[EastNorth],
    noise: &GaussMarkovNoise,
    acceleration_m_s2: f64,
) -> Vec<SmoothedPosition> {
    let (steps, _) = filter(times_s, fixes, noise, acceleration_m_s2);
    let Some(last) = steps.last() else { return Vec::new() };
    let mut estimate = last.updated;
    let mut reversed = vec![smoothed(&estimate)];
    for pair in steps.windows(2).rev() {
        let (now, next) = (&pair[0], &pair[1]);
        let Some(inverse) = next.predicted.covariance.try_inverse() else { break };
        let gain = now.updated.covariance * next.transition.transpose() * inverse;
        estimate = StateEstimate {
            mean: now.updated.mean + gain * (estimate.mean - next.predicted.mean),
            covariance: now.updated.covariance
                + gain * (estimate.covariance - next.predicted.covariance) * gain.transpose(),
        };
        reversed.push(smoothed(&estimate));
    }
    reversed.reverse();
    reversed
}

/// The acceleration (m/s2), of a coarse grid, that maximises the likelihood of the fixes.
#[must_use]
pub fn tune_acceleration(traverses: &[Traverse], noise: &GaussMarkovNoise) -> f64 {
    let likelihood = |&acceleration_m_s2: &f64| -> f64 {
        traverses.iter().map(|(times_s, fixes)| filter(times_s, fixes, noise, acceleration_m_s2).1).sum()
    };
    let scored = ACCELERATIONS_M_S2.iter().map(|candidate| (likelihood(candidate), *candidate));
    scored.max_by(|one, other| one.0.total_cmp(&other.0)).map_or(0.5, |(_, candidate)| candidate)
}

fn smoothed(estimate: &StateEstimate) -> SmoothedPosition {
    SmoothedPosition {
        position: EastNorth { east_m: estimate.mean[(0, 0)], north_m: estimate.mean[(0, 1)] },
        variance_m2: estimate.covariance[(0, 0)].max(0.0),
    }
}

/// One step of the forward filter.
struct FilterStep {
    transition: Matrix3<f64>,
    predicted: StateEstimate,
    updated: StateEstimate,
}

/// The forward filter, and the log-likelihood of the fixes.
fn filter(
    times_s: &[f64],
    fixes: &[EastNorth],
    noise: &GaussMarkovNoise,
    acceleration_m_s2: f64,
) -> (Vec<FilterStep>, f64) {
    // Bounded below to keep the covariance invertible for white noise.
    let coloured_m2 = noise.coloured_sigma_m().powi(2).max(1e-6);
    let white_m2 = noise.white_sigma_m().max(MIN_WHITE_SIGMA_M).powi(2);
    let Some(&first) = fixes.first() else { return (Vec::new(), 0.0) };
    let mut estimate = StateEstimate {
        mean: Matrix3x2::new(first.east_m, first.north_m, 0.0, 0.0, 0.0, 0.0),
        covariance: Matrix3::from_diagonal(&Vector3::new(INITIAL_M2, INITIAL_SPEED_M2_S2, coloured_m2)),
    };
    let (mut steps, mut log_likelihood) = (Vec::with_capacity(fixes.len()), 0.0);
    for (index, fix) in fixes.iter().enumerate() {
        let seconds = if index == 0 { 0.0 } else { times_s[index] - times_s[index - 1] };
        let decay = noise.correlation.decay(seconds);
        let transition = Matrix3::new(1.0, seconds, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, decay);
        let mut process = Matrix3::zeros();
        let density = acceleration_m_s2 * acceleration_m_s2;
        process[(0, 0)] = density * seconds.powi(3) / 3.0;
        process[(0, 1)] = density * seconds.powi(2) / 2.0;
        process[(1, 0)] = process[(0, 1)];
        process[(1, 1)] = density * seconds;
        process[(2, 2)] = coloured_m2 * (1.0 - decay * decay);
        let predicted = StateEstimate {
            mean: transition * estimate.mean,
            covariance: transition * estimate.covariance * transition.transpose() + process,
        };
        let (updated, density) = update(&predicted, *fix, white_m2);
        // The first fix initialises the position and has no likelihood.
        log_likelihood += if index == 0 { 0.0 } else { density };
        estimate = updated;
        steps.push(FilterStep { transition, predicted, updated });
    }
    (steps, log_likelihood)
}

/// Kalman update with the position plus bias observed. The variance of an outlier is inflated until its
/// NIS is [`MAX_NIS`]. Returns the log-density of the fix.
fn update(predicted: &StateEstimate, fix: EastNorth, white_m2: f64) -> (StateEstimate, f64) {
    let observe = Vector3::new(1.0, 0.0, 1.0);
    let cross = predicted.covariance * observe;
    let predicted_m2 = observe.dot(&cross);
    let innovation = RowVector2::new(fix.east_m, fix.north_m) - predicted.mean.row(0) - predicted.mean.row(2);
    let squared_m2 = innovation.norm_squared();
    let mut innovation_m2 = predicted_m2 + white_m2;
    if squared_m2 > MAX_NIS * innovation_m2 {
        innovation_m2 = squared_m2 / MAX_NIS;
    }
    let gain = cross / innovation_m2;
    let estimate = StateEstimate {
        mean: predicted.mean + gain * innovation,
        covariance: predicted.covariance - gain * cross.transpose(),
    };
    let log_density = -0.5 * squared_m2 / innovation_m2 - innovation_m2.ln() - std::f64::consts::TAU.ln();
    (estimate, log_density)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Sample;
    use crate::geo::LocalPlane;
    use crate::simulation::{Options, Scene, simulate};

    /// Traverses of fixes, with the true positions of each.
    fn traverses(scene: Scene, seed: u64, samples: usize) -> (Vec<Traverse>, Vec<Vec<EastNorth>>) {
        let rows = simulate(&Options { seed, samples, ..Options::new(scene) }).training_samples();
        let plane = LocalPlane::new(rows[0].truth.expect("simulated"));
        let mut traverses: Vec<Traverse> = Vec::new();
        let mut truths: Vec<Vec<EastNorth>> = Vec::new();
        let mut last_s = f64::NEG_INFINITY;
        for Sample { time, fix, truth, .. } in rows {
            let time_s = time.as_second() as f64;
            if time_s - last_s > 10.0 {
                traverses.push(Traverse::default());
                truths.push(Vec::new());
            }
            last_s = time_s;
            let traverse = traverses.last_mut().expect("begun");
            traverse.0.push(time_s);
            traverse.1.push(plane.to_plane(fix.position));
            truths.last_mut().expect("begun").push(plane.to_plane(truth.expect("simulated")));
        }
        (traverses, truths)
    }

    /// Mean square error per axis of fixes and of smoothed positions, m2, and the mean ratio of squared
    /// error to stated variance.
    fn errors_and_ratio(scene: Scene, sigma_m: f64) -> (f64, f64, f64) {
        let (traverses, truths) = traverses(scene, 5, 4_000);
        let noise = noise_of_fixes(sigma_m * sigma_m, &traverses);
        let acceleration_m_s2 = tune_acceleration(&traverses, &noise);
        let (mut raw, mut smooth, mut ratio, mut count) = (0.0, 0.0, 0.0, 0.0);
        for ((times_s, fixes), truths) in traverses.iter().zip(&truths) {
            for ((answer, fix), truth) in
                smooth_traverse(times_s, fixes, &noise, acceleration_m_s2).iter().zip(fixes).zip(truths)
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
    fn white_noise_is_smoothed_and_the_variance_is_consistent() {
        let (raw_m2, smooth_m2, ratio) = errors_and_ratio(Scene::Airport, 29.5);
        assert!(smooth_m2 < 0.15 * raw_m2, "{smooth_m2} of {raw_m2}");
        assert!((0.7..1.4).contains(&ratio), "{ratio}");
    }

    #[test]
    fn correlated_noise_gains_little_and_the_variance_is_consistent() {
        let (raw_m2, smooth_m2, ratio) = errors_and_ratio(Scene::Square, 2.2);
        assert!(smooth_m2 < raw_m2, "{smooth_m2} of {raw_m2}");
        assert!((0.5..1.6).contains(&ratio), "{ratio}");
    }

    #[test]
    fn the_decomposition_finds_the_white_part() {
        let (walked, _) = traverses(Scene::Square, 6, 3_000);
        let phone = noise_of_fixes(2.2 * 2.2, &walked);
        assert!(phone.white_sigma_m() < 0.4 && phone.coloured_sigma_m() > 2.1, "{phone:?}");
        let (taxied, _) = traverses(Scene::Airport, 6, 3_000);
        let noisy = noise_of_fixes(29.5 * 29.5, &taxied);
        assert!((noisy.white_sigma_m() - 29.5).abs() < 1e-9 && noisy.coloured_sigma_m() == 0.0, "{noisy:?}");
    }

    #[test]
    fn one_outlier_does_not_bend_the_traverse() {
        let times_s: Vec<f64> = (0..60).map(f64::from).collect();
        let mut fixes: Vec<EastNorth> =
            times_s.iter().map(|&time_s| EastNorth { east_m: 1.2 * time_s, north_m: 0.0 }).collect();
        fixes[30].north_m = 500.0;
        let smoothed = smooth_traverse(&times_s, &fixes, &GaussMarkovNoise::white(4.0), 0.1);
        assert_eq!(smoothed.len(), 60);
        assert!(smoothed[30].position.north_m.abs() < 3.0, "{:?}", smoothed[30]);
        assert!(smooth_traverse(&[], &[], &GaussMarkovNoise::white(4.0), 0.1).is_empty());
    }
}
