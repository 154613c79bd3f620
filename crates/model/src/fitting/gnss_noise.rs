//! Estimates the temporal correlation of a receiver's error from residuals, fix less regressed
//! position: a least-squares fit of a Gauss-Markov autocovariance.
//!
//! A phone's error is almost entirely a bias of tens of seconds, a simulated receiver's may be
//! white; a track needs to know which. The mean over a traverse is not subtracted, because a
//! traverse is short compared with the bias.

use jiff::Timestamp;

use crate::artifact::LEAST_GNSS_WHITE_SHARE;
use crate::domain::{GaussMarkovNoise, NoiseCorrelation};
use crate::geo::EastNorth;
use crate::statistics::GROSS_SIGMAS;
use crate::uncertainty::variance_components::robust_variance_m2;

/// Lags of the autocovariance, in units of the fixes' interval (at least one second).
const LAGS: [u32; 11] = [1, 2, 3, 4, 6, 8, 12, 18, 26, 36, 50];
/// Candidate time constants of the bias, in the same units.
const TIME_CONSTANTS: [f64; 14] =
    [2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 40.0, 55.0, 75.0, 100.0, 150.0, 240.0];
/// A lag needs this many pairs of residuals.
const MIN_PAIRS: u32 = 30;
/// The estimate is at least this share of the residuals' variance, however large the regression's
/// own variance is stated.
const MIN_VARIANCE_SHARE: f64 = 0.05;

/// Fix less regressed position at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedResidual {
    /// Time of the fix.
    pub time: Timestamp,
    /// Fix less regressed position, m.
    pub difference: EastNorth,
}

/// Fits `bias_m2 * exp(-lag / tau)` to the residuals' autocovariance at eleven lags by least squares,
/// weighted by their number of pairs; what the fit leaves of the variance at lag 0 is white.
///
/// `traverses` are gap-free sequences in order of time; residuals of held-out traverses are
/// preferable, because a fit follows the bias of its training samples. `e_regression_m2` is the error
/// variance per axis of the regressed positions and `regression` its temporal correlation; both parts
/// are subtracted from the receiver's. `None` for fewer than 30 pairs at the first lag, or residuals without variance.
#[must_use]
pub fn estimate_gnss_noise(
    traverses: &[Vec<TimedResidual>],
    e_regression_m2: f64,
    regression: &NoiseCorrelation,
) -> Option<GaussMarkovNoise> {
    let traverses = without_gross_errors(traverses);
    let unit_s = median_interval_s(&traverses)?.max(1.0);
    let (variance, lags) = autocovariance(&traverses, unit_s)?;
    let (fitted_bias, time_constant) = fit_exponential(&lags);
    let residual_bias_m2 = fitted_bias.min(variance);
    let residual_white_m2 = variance - residual_bias_m2;
    let white_m2 = (residual_white_m2 - regression.white_share * e_regression_m2).max(0.0);
    let bias_m2 = (residual_bias_m2 - (1.0 - regression.white_share) * e_regression_m2).max(0.0);
    let variance_m2 = (white_m2 + bias_m2).max(MIN_VARIANCE_SHARE * variance);
    let white_share = (white_m2 / variance_m2).clamp(LEAST_GNSS_WHITE_SHARE, 1.0);
    let correlation = NoiseCorrelation { white_share, time_constant_s: time_constant * unit_s };
    Some(GaussMarkovNoise { variance_m2, correlation })
}

/// A few errors of 1 km are most of a variance, and white, so that a track would average the fixes of a phone.
fn without_gross_errors(traverses: &[Vec<TimedResidual>]) -> Vec<Vec<TimedResidual>> {
    let residual = |it: &TimedResidual| [it.difference.east_m, it.difference.north_m];
    let residuals: Vec<[f64; 2]> = traverses.iter().flatten().map(residual).collect();
    let limit_m = GROSS_SIGMAS * robust_variance_m2(&residuals).sqrt();
    let is_credible = |it: &&TimedResidual| it.difference.distance_m(EastNorth::default()) <= limit_m;
    traverses.iter().map(|traverse| traverse.iter().filter(is_credible).copied().collect()).collect()
}

/// Median interval between neighbouring residuals, s.
fn median_interval_s(traverses: &[Vec<TimedResidual>]) -> Option<f64> {
    let mut intervals: Vec<f64> = traverses
        .iter()
        .flat_map(|traverse| traverse.windows(2))
        .map(|pair| pair[1].time.duration_since(pair[0].time).as_secs_f64())
        .filter(|interval_s| *interval_s > 0.0)
        .collect();
    intervals.sort_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied()
}

/// The autocovariance at one lag.
struct LagCovariance {
    /// In units of the fixes' interval.
    lag: f64,
    covariance_m2: f64,
    pairs: f64,
}

/// Variance per axis, and the autocovariance at the lags with enough pairs; the mean over all
/// residuals is subtracted.
fn autocovariance(traverses: &[Vec<TimedResidual>], unit_s: f64) -> Option<(f64, Vec<LagCovariance>)> {
    let all = || traverses.iter().flatten();
    let count = all().count() as f64;
    let mean = all().fold([0.0; 2], |sum, it| {
        [sum[0] + it.difference.east_m / count, sum[1] + it.difference.north_m / count]
    });
    let centred = |it: &TimedResidual| [it.difference.east_m - mean[0], it.difference.north_m - mean[1]];
    // Mean over both axes.
    let product = |a: &TimedResidual, b: &TimedResidual| {
        let (a, b) = (centred(a), centred(b));
        0.5 * (a[0] * b[0] + a[1] * b[1])
    };
    let variance = all().map(|it| product(it, it)).sum::<f64>() / count;
    let mut lags = Vec::new();
    for lag in LAGS {
        let lag_s = f64::from(lag) * unit_s;
        let (mut sum, mut pairs) = (0.0, 0_u32);
        for traverse in traverses {
            let mut lagged = 0;
            for it in traverse {
                let age_s = |other: &TimedResidual| it.time.duration_since(other.time).as_secs_f64();
                while age_s(&traverse[lagged]) > lag_s + 0.01 * unit_s {
                    lagged += 1;
                }
                if age_s(&traverse[lagged]) > lag_s - 0.3 * unit_s {
                    sum += product(it, &traverse[lagged]);
                    pairs += 1;
                }
            }
        }
        if pairs >= MIN_PAIRS {
            let (lag, pairs) = (f64::from(lag), f64::from(pairs));
            lags.push(LagCovariance { lag, covariance_m2: sum / pairs, pairs });
        }
    }
    let is_usable = lags.first().is_some_and(|first| first.lag < 1.5) && variance > 1e-12;
    is_usable.then_some((variance, lags))
}

/// Variance (m2) and time constant (units) of the best-fitting exponential. For a given time constant
/// the least-squares variance is `sum(n s c) / sum(n s^2)`, with `s = exp(-lag / tau)`.
fn fit_exponential(lags: &[LagCovariance]) -> (f64, f64) {
    let mut best = (f64::INFINITY, 0.0, TIME_CONSTANTS[0]);
    for constant in TIME_CONSTANTS {
        let (mut shape_squared, mut shape_covariance) = (0.0, 0.0);
        for LagCovariance { lag, covariance_m2, pairs } in lags {
            let shape = (-lag / constant).exp();
            shape_squared += pairs * shape * shape;
            shape_covariance += pairs * shape * covariance_m2;
        }
        let variance = (shape_covariance / shape_squared).max(0.0);
        let cost: f64 = lags
            .iter()
            .map(|LagCovariance { lag, covariance_m2, pairs }| {
                pairs * (covariance_m2 - variance * (-lag / constant).exp()).powi(2)
            })
            .sum();
        if cost < best.0 {
            best = (cost, variance, constant);
        }
    }
    (best.1, best.2)
}
