//! Error figures of a method.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use serde::Serialize;
use utoipa::ToSchema;

use crate::statistics::R95_PER_SIGMA;

/// Error bounds, m: the report gives the share of errors within each.
pub const BOUNDS_M: [f64; 8] = [0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0];
/// Ratio of the 50 % radius to the 95 % radius of an isotropic normal distribution in the plane:
/// sqrt(ln 0.5 / ln 0.05).
const R50_PER_R95: f64 = 0.481_015_8;

/// A prediction's error against the truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScoredPrediction {
    /// Horizontal error, m.
    pub error_m: f64,
    /// The 95 % radius that the method states, m, if it states one.
    pub r95_m: Option<f64>,
}

/// Figures of the horizontal error of one method with one seed, or their means over seeds.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
#[schema(as = ErrorFigures)]
pub struct ErrorMetrics {
    /// Mean.
    pub mean_m: f64,
    /// Median.
    pub median_m: f64,
    /// 95th percentile.
    pub p95_m: f64,
    /// Largest.
    pub max_m: f64,
    /// Variance about the mean.
    pub variance_m2: f64,
    /// Root of the mean square.
    pub rmse_m: f64,
    /// Share of errors at most as large as each of [`BOUNDS_M`], by the bound's text.
    pub share_within: BTreeMap<String, f64>,
    /// Share of true positions inside the stated 50 % radius, if the method states one.
    pub coverage50: Option<f64>,
    /// The same of the 95 % radius.
    pub coverage95: Option<f64>,
    /// Mean of the stated 95 % radii, m, if the method states them: of two with the same coverage the smaller one says
    /// more.
    pub mean_r95_m: Option<f64>,
    /// Mean negative log likelihood of the true positions (density per m2) under normal distributions with the stated
    /// 95 % radii. It is a proper score: radii that are too small and radii that are too large both make it larger
    /// (Gneiting and Raftery 2007).
    pub negative_log_likelihood: Option<f64>,
    /// Number of scored predictions.
    pub n: usize,
}

impl ErrorMetrics {
    /// Figures of some predictions; `None` if there are none.
    #[must_use]
    pub fn of(predictions: &[ScoredPrediction]) -> Option<Self> {
        let n = predictions.len();
        let mut errors_m: Vec<f64> = predictions.iter().map(|prediction| prediction.error_m).collect();
        errors_m.sort_by(f64::total_cmp);
        let max_m = *errors_m.last()?;
        let count = n as f64;
        let mean_m = errors_m.iter().sum::<f64>() / count;
        let square_m2 = errors_m.iter().map(|error| error * error).sum::<f64>() / count;
        let within = |bound_m: f64| errors_m.partition_point(|&error_m| error_m <= bound_m) as f64 / count;
        Some(Self {
            mean_m,
            median_m: quantile(&errors_m, 0.5),
            p95_m: quantile(&errors_m, 0.95),
            max_m,
            variance_m2: errors_m.iter().map(|error_m| (error_m - mean_m).powi(2)).sum::<f64>() / count,
            rmse_m: square_m2.sqrt(),
            share_within: BOUNDS_M.iter().map(|&bound_m| (format!("{bound_m}"), within(bound_m))).collect(),
            coverage50: coverage(predictions, R50_PER_R95),
            coverage95: coverage(predictions, 1.0),
            mean_r95_m: mean_stated(predictions, |_, r95_m| r95_m),
            negative_log_likelihood: mean_stated(predictions, negative_log_likelihood),
            n,
        })
    }

    /// The mean of each figure over seeds, except for `max_m`, the largest error of all seeds; `None` if
    /// there is no seed.
    #[must_use]
    pub fn over_seeds(seeds: &[Self]) -> Option<Self> {
        let first = seeds.first()?;
        let count = seeds.len() as f64;
        let mean = |figure: &dyn Fn(&Self) -> f64| seeds.iter().map(figure).sum::<f64>() / count;
        let optional = |figure: &dyn Fn(&Self) -> Option<f64>| {
            seeds.iter().map(figure).sum::<Option<f64>>().map(|sum| sum / count)
        };
        let shares = first.share_within.keys().map(|bound| {
            (bound.clone(), mean(&|one| one.share_within.get(bound).copied().unwrap_or_default()))
        });
        Some(Self {
            mean_m: mean(&|one| one.mean_m),
            median_m: mean(&|one| one.median_m),
            p95_m: mean(&|one| one.p95_m),
            max_m: seeds.iter().map(|one| one.max_m).fold(0.0, f64::max),
            variance_m2: mean(&|one| one.variance_m2),
            rmse_m: mean(&|one| one.rmse_m),
            share_within: shares.collect(),
            coverage50: optional(&|one| one.coverage50),
            coverage95: optional(&|one| one.coverage95),
            mean_r95_m: optional(&|one| one.mean_r95_m),
            negative_log_likelihood: optional(&|one| one.negative_log_likelihood),
            n: first.n,
        })
    }
}

/// Quantile of ascending values (at least one), interpolated linearly between order statistics.
fn quantile(ascending: &[f64], part: f64) -> f64 {
    let rank = part * (ascending.len() - 1) as f64;
    let low = rank.floor() as usize;
    let high = (low + 1).min(ascending.len() - 1);
    ascending[low] + (rank - rank.floor()) * (ascending[high] - ascending[low])
}

fn coverage(predictions: &[ScoredPrediction], factor: f64) -> Option<f64> {
    mean_stated(predictions, |error_m, r95_m| f64::from(u8::from(error_m <= factor * r95_m)))
}

/// Mean of a function of error and stated radius, m; `None` unless every prediction states one.
fn mean_stated(predictions: &[ScoredPrediction], of: impl Fn(f64, f64) -> f64) -> Option<f64> {
    let values = predictions.iter().map(|one| one.r95_m.map(|r95_m| of(one.error_m, r95_m)));
    let sum: Option<f64> = values.sum();
    sum.filter(|_| !predictions.is_empty()).map(|sum| sum / predictions.len() as f64)
}

fn negative_log_likelihood(error_m: f64, r95_m: f64) -> f64 {
    let sigma_m = r95_m / R95_PER_SIGMA;
    (TAU * sigma_m * sigma_m).ln() + 0.5 * (error_m / sigma_m).powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn scored(errors_m: &[f64]) -> Vec<ScoredPrediction> {
        errors_m.iter().map(|&error_m| ScoredPrediction { error_m, r95_m: None }).collect()
    }

    fn near(one: f64, other: f64) -> bool {
        (one - other).abs() < 1e-9
    }

    #[test]
    fn figures_of_known_errors() {
        let metrics = ErrorMetrics::of(&scored(&[4.0, 1.0, 3.0, 2.0, 10.0])).expect("some");
        assert!(near(metrics.mean_m, 4.0) && near(metrics.median_m, 3.0) && near(metrics.max_m, 10.0));
        assert!(near(metrics.variance_m2, 10.0) && near(metrics.rmse_m, 26.0f64.sqrt()));
        assert!(near(metrics.p95_m, 8.8), "{}", metrics.p95_m);
        assert!(near(metrics.share_within["3"], 0.6) && near(metrics.share_within["0.5"], 0.0));
        assert_eq!((metrics.coverage95, metrics.n), (None, 5));
        assert_eq!(ErrorMetrics::of(&[]), None);
    }

    #[test]
    fn a_correct_radius_contains_its_share() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        // Rayleigh errors of sigma 1, whose 95 % radius is known.
        let predictions: Vec<ScoredPrediction> = (0..20_000)
            .map(|_| ScoredPrediction {
                error_m: (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt(),
                r95_m: Some(2.447_746_8),
            })
            .collect();
        let metrics = ErrorMetrics::of(&predictions).expect("some");
        assert!((metrics.coverage95.expect("stated") - 0.95).abs() < 0.006, "{metrics:?}");
        assert!((metrics.coverage50.expect("stated") - 0.5).abs() < 0.015, "{metrics:?}");
        assert!(near(metrics.mean_r95_m.expect("stated"), 2.447_746_8));
        // For sigma 1 the expectation is ln(tau) + 1; every other radius scores worse.
        let score = metrics.negative_log_likelihood.expect("stated");
        assert!((score - TAU.ln() - 1.0).abs() < 0.02, "{score}");
        for factor in [0.8, 1.25] {
            let stated = |one: &ScoredPrediction| ScoredPrediction {
                r95_m: one.r95_m.map(|r95_m| factor * r95_m),
                ..*one
            };
            let other = ErrorMetrics::of(&predictions.iter().map(stated).collect::<Vec<_>>());
            let other = other.expect("some").negative_log_likelihood.expect("stated");
            assert!(other > score + 0.02, "{factor}: {other}, {score}");
        }
    }

    #[test]
    fn seeds_are_averaged_and_the_largest_error_kept() {
        let seeds =
            [&[1.0, 3.0][..], &[2.0, 6.0][..]].map(|errors| ErrorMetrics::of(&scored(errors)).expect("some"));
        let both = ErrorMetrics::over_seeds(&seeds).expect("two");
        assert!(near(both.mean_m, 3.0) && near(both.max_m, 6.0));
        assert_eq!(both.n, 2);
    }
}
