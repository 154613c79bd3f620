//! How a receiver's error is spread over time, from residuals: fixes less regressed positions.
//!
//! A phone's error is almost wholly a bias of tens of seconds, a simulated receiver's may be new
//! with every fix; the same track serves both once it knows which. What never happens here: the
//! residuals' mean over a pass taken for signal, for a pass is short against the bias.

use jiff::Timestamp;

use super::settings::{GnssNoise, RegressionNoise, SMALLEST_WHITE_SHARE};
use crate::geo::EastNorth;

/// Lags of the correlation, in steps of the fixes' interval (at least one second).
const LAGS: [u32; 11] = [1, 2, 3, 4, 6, 8, 12, 18, 26, 36, 50];
/// Time constants that are tried, in such steps.
const TIME_CONSTANTS: [f64; 14] =
    [2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 40.0, 55.0, 75.0, 100.0, 150.0, 240.0];
/// Fewer pairs at a lag tell nothing.
const FEWEST_PAIRS: u32 = 30;
/// Fix less regressed position of one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResidualAt {
    /// When.
    pub time: Timestamp,
    /// Fix less regressed position, m.
    pub difference: EastNorth,
}

/// What residuals tell of a receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GnssNoiseEstimate {
    /// Spread over time, as a track takes it.
    pub noise: GnssNoise,
    /// Error variance per axis, the regression's own taken out, m2.
    pub variance_m2: f64,
    /// Standard deviation of the part that is new with every fix, m.
    pub white_sigma_m: f64,
    /// Standard deviation of the bias, m.
    pub bias_sigma_m: f64,
    /// Correlation of residuals one second (or one interval, if longer) apart.
    pub first_correlation: f64,
}

/// Splits the residuals' variance into a white part and a Gauss-Markov bias: the curve
/// `bias^2 exp(-lag / tau)` that fits the autocovariance at eleven lags best in the least-squares
/// sense, and what it leaves at lag 0.
///
/// `passes` are stretches without a hole, each in order of time; residuals of held-out passes tell
/// best, for a fit follows the bias of the passes it saw. `e_regression_m2` is the regressed
/// positions' own error variance per axis and `regression` its spread; both are taken out.
/// `None` for fewer than 30 pairs at the first lag, or residuals without variance.
#[must_use]
pub fn estimate_gnss_noise(
    passes: &[Vec<ResidualAt>],
    e_regression_m2: f64,
    regression: &RegressionNoise,
) -> Option<GnssNoiseEstimate> {
    let unit_s = interval_s(passes)?.max(1.0);
    let (variance, curve) = autocovariance(passes, unit_s)?;
    let (bias, constant) = fit(&curve);
    let bias_all_m2 = bias.min(variance);
    let white_all_m2 = variance - bias_all_m2;
    let white_m2 = (white_all_m2 - regression.white_share * e_regression_m2).max(0.0);
    let bias_m2 = (bias_all_m2 - (1.0 - regression.white_share) * e_regression_m2).max(0.0);
    // A regression that claims more error than the residuals hold cannot take all of it away.
    let variance_m2 = (white_m2 + bias_m2).max(0.05 * variance);
    let white_share = (white_m2 / variance_m2).clamp(SMALLEST_WHITE_SHARE, 1.0);
    Some(GnssNoiseEstimate {
        noise: GnssNoise { white_share, time_constant_s: constant * unit_s },
        variance_m2,
        white_sigma_m: (white_share * variance_m2).sqrt(),
        bias_sigma_m: ((1.0 - white_share) * variance_m2).sqrt(),
        first_correlation: curve[0].1 / variance,
    })
}

/// Median interval between neighbours, s.
fn interval_s(passes: &[Vec<ResidualAt>]) -> Option<f64> {
    let mut intervals: Vec<f64> = passes
        .iter()
        .flat_map(|pass| pass.windows(2))
        .map(|pair| pair[1].time.duration_since(pair[0].time).as_secs_f64())
        .filter(|interval_s| *interval_s > 0.0)
        .collect();
    intervals.sort_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied()
}

/// (lag in units, covariance in m2, pairs).
type Lagged = (f64, f64, f64);

/// Variance per axis, and the autocovariance at the lags with pairs enough.
fn autocovariance(passes: &[Vec<ResidualAt>], unit_s: f64) -> Option<(f64, Vec<Lagged>)> {
    let all = || passes.iter().flatten();
    let count = all().count() as f64;
    let mean = all().fold([0.0; 2], |sum, it| {
        [sum[0] + it.difference.east_m / count, sum[1] + it.difference.north_m / count]
    });
    let centred = |it: &ResidualAt| [it.difference.east_m - mean[0], it.difference.north_m - mean[1]];
    let product = |a: &ResidualAt, b: &ResidualAt| {
        let (a, b) = (centred(a), centred(b));
        0.5 * (a[0] * b[0] + a[1] * b[1])
    };
    let variance = all().map(|it| product(it, it)).sum::<f64>() / count;
    let mut curve = Vec::new();
    for lag in LAGS {
        let wanted_s = f64::from(lag) * unit_s;
        let (mut sum, mut pairs) = (0.0, 0_u32);
        for pass in passes {
            let mut behind = 0;
            for it in pass {
                let age_s = |other: &ResidualAt| it.time.duration_since(other.time).as_secs_f64();
                while age_s(&pass[behind]) > wanted_s + 0.01 * unit_s {
                    behind += 1;
                }
                if age_s(&pass[behind]) > wanted_s - 0.3 * unit_s {
                    sum += product(it, &pass[behind]);
                    pairs += 1;
                }
            }
        }
        if pairs >= FEWEST_PAIRS {
            curve.push((f64::from(lag), sum / f64::from(pairs), f64::from(pairs)));
        }
    }
    let whole = curve.first().is_some_and(|first| first.0 < 1.5) && variance > 1e-12;
    whole.then_some((variance, curve))
}

/// Bias variance and time constant (in units) of the best exponential through the curve.
fn fit(curve: &[Lagged]) -> (f64, f64) {
    let mut best = (f64::INFINITY, 0.0, TIME_CONSTANTS[0]);
    for constant in TIME_CONSTANTS {
        let mut moments = [0.0; 2];
        for (lag, covariance, pairs) in curve {
            let shape = (-lag / constant).exp();
            moments[0] += pairs * shape * shape;
            moments[1] += pairs * shape * covariance;
        }
        let bias = (moments[1] / moments[0]).max(0.0);
        let misfit: f64 = curve
            .iter()
            .map(|(lag, covariance, pairs)| pairs * (covariance - bias * (-lag / constant).exp()).powi(2))
            .sum();
        if misfit < best.0 {
            best = (misfit, bias, constant);
        }
    }
    (best.1, best.2)
}
