//! Order statistics and moments of plain numbers.

/// Standard deviation about the mean (divided by the count); 0 for no values.
#[must_use]
pub fn std_dev(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / count;
    (values.map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// The order statistic of rank `n / 2` (from 0), which is the upper median of an even count; 0 for no
/// values.
#[must_use]
pub fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let rank = values.len() / 2;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}

/// A residual beyond this many robust standard deviations per axis is a gross error of the fix or of the box.
pub const GROSS_SIGMAS: f64 = 7.0;

/// Radius that contains 95 % of an isotropic normal distribution in the plane, in standard deviations per
/// axis: `sqrt(-2 ln 0.05)`.
pub const R95_PER_SIGMA: f64 = 2.447_746_830_680_816;

/// Half the width of the interval that holds 95 % of a normal distribution, in standard deviations.
pub const NORMAL_95: f64 = 1.959_964;
/// Quantiles of chi-square with 2 degrees of freedom: 95 %, -2 ln(0.05), and 99.9 %.
pub const CHI_SQUARE_95: f64 = 5.991;
/// See [`CHI_SQUARE_95`].
pub const CHI_SQUARE_99_9: f64 = 13.816;
/// 95 % quantile of the standard normal distribution, one-sided.
pub const ONE_SIDED_95: f64 = 1.645;
