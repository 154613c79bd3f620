//! The noise of fixes over time, and the filter that turns residuals with such noise into independent
//! ones.
//!
//! The errors of neighbouring fixes are strongly correlated (METHOD 2.5), so hundreds of rows of a
//! standing target contain little more information than one. Least squares on residuals whitened by a
//! Kalman filter weights them accordingly: with the state `b` (the Gauss-Markov part of the noise), the
//! innovations `v[k] = r[k] - phi[k] b[k-1]` of the residuals `r` are independent with the variances
//! `s[k]`, and the residuals' log-likelihood is `-1/2 sum(v^2 / s + ln s)` (Schweppe 1965).

use super::rows::{TrainingRow, traverses};
use crate::domain::{GaussMarkovNoise, NoiseCorrelation};
use crate::statistics::GROSS_SIGMAS;

/// Candidates of the time constant, s.
const TIME_CONSTANTS_S: [f64; 5] = [5.0, 15.0, 40.0, 100.0, 250.0];
/// Candidates of the white share of the variance.
const WHITE_SHARES: [f64; 6] = [0.01, 0.03, 0.1, 0.25, 0.5, 0.75];
/// Normalised innovation squared (2 degrees of freedom) above which a row is down-weighted.
const NOMINAL_NIS: f64 = 8.0;
/// The same above which a row is a gross error.
const GROSS_NIS: f64 = GROSS_SIGMAS * GROSS_SIGMAS;
/// The inflation of a gross error: its row is taken as missing. A finite one, in units of the noise's variance, would be
/// the likelier the larger that variance is, so that a few gross errors make the noise of all rows large.
const GROSS_ERROR: f64 = f64::INFINITY;

/// The noise of maximum likelihood for residuals.
///
/// `residuals` are east and north (m) of rows sorted by target and time; `inflation` is added to each
/// row's white variance in units of the noise's variance, and is not part of the result. Rows of
/// [`GROSS_ERROR`] say nothing of the noise.
pub(crate) fn fit_noise(
    rows: &[TrainingRow],
    residuals: &[Vec<f64>; 2],
    inflation: &[f64],
) -> GaussMarkovNoise {
    let unit = GaussMarkovNoise::white(1.0);
    let mut best = (f64::INFINITY, unit);
    let credible = inflation.iter().filter(|inflation| inflation.is_finite()).count();
    let coloured = TIME_CONSTANTS_S.iter().flat_map(|time_constant_s| {
        WHITE_SHARES.iter().map(|white_share| GaussMarkovNoise {
            variance_m2: 1.0,
            correlation: NoiseCorrelation { white_share: *white_share, time_constant_s: *time_constant_s },
        })
    });
    for candidate in std::iter::once(unit).chain(coloured) {
        let whitener = Whitener::new(rows, &candidate, inflation);
        let sum: f64 = residuals
            .iter()
            .map(|axis| {
                let mut axis = axis.clone();
                whitener.apply(&mut axis);
                axis.iter().map(|value| value * value).sum::<f64>()
            })
            .sum();
        // The scale of the variance has a closed form; -2 times the profile likelihood remains.
        let count = 2.0 * credible.max(1) as f64;
        let variance_m2 = (sum / count).max(1e-8);
        let deviance = count * variance_m2.ln() + 2.0 * whitener.log_determinant;
        if deviance < best.0 {
            best = (deviance, GaussMarkovNoise { variance_m2, ..candidate });
        }
    }
    best.1
}

/// Inflations with gross errors marked as such, unless a fifth of the rows departs so far: then that is what these rows
/// are like.
pub(crate) fn with_gross_errors(mut inflation: Vec<f64>, is_gross: impl Fn(usize) -> bool) -> Vec<f64> {
    let gross: Vec<usize> = (0..inflation.len()).filter(|row| is_gross(*row)).collect();
    if 5 * gross.len() < inflation.len() {
        gross.into_iter().for_each(|row| inflation[row] = GROSS_ERROR);
    }
    inflation
}

/// The number of independent fixes per axis that has the same information about a constant as the rows.
pub(crate) fn effective_sample_size(rows: &[TrainingRow], noise: &NoiseCorrelation) -> f64 {
    let coloured_share = 1.0 - noise.white_share;
    let mut sum = 0.0;
    for traverse in traverses(rows) {
        let count = traverse.len() as f64;
        let seconds = traverse[traverse.len() - 1].time_s - traverse[0].time_s;
        // A Gauss-Markov process of length T averages like 1 + T / (2 tau) independent values.
        let independent = (1.0 + 0.5 * seconds / noise.time_constant_s).min(count);
        sum += 1.0 / (noise.white_share / count + coloured_share / independent);
    }
    sum.max(1.0)
}

/// The Kalman filter's coefficients of one row.
#[derive(Debug, Clone, Copy)]
struct Coefficients {
    /// Decay of the state since the previous row.
    decay: f64,
    gain: f64,
    /// Variance of the innovation without the row's inflation, m2.
    nominal_m2: f64,
    /// Inverse standard deviation of the innovation, 1/m; 0 for a gross error.
    inverse_sigma: f64,
}

/// The whitening filter of rows sorted by target and time; the state restarts with every target.
#[derive(Debug, Clone)]
pub(crate) struct Whitener {
    coefficients: Vec<Coefficients>,
    /// Sum of the logarithms of the innovation variances of one axis.
    log_determinant: f64,
}

impl Whitener {
    /// `inflation` is added to each row's white variance, in units of the noise's variance.
    pub(crate) fn new(rows: &[TrainingRow], noise: &GaussMarkovNoise, inflation: &[f64]) -> Self {
        let coloured_m2 = noise.coloured_variance_m2();
        let white_m2 = noise.white_variance_m2();
        let mut coefficients = Vec::with_capacity(rows.len());
        let (mut state_variance_m2, mut log_determinant) = (coloured_m2, 0.0);
        for (at, row) in rows.iter().enumerate() {
            let same = at > 0 && rows[at - 1].target == row.target;
            let decay = if same { noise.correlation.decay(row.time_s - rows[at - 1].time_s) } else { 0.0 };
            state_variance_m2 = decay * decay * state_variance_m2 + (1.0 - decay * decay) * coloured_m2;
            let nominal_m2 = state_variance_m2 + white_m2;
            let innovation_variance_m2 = nominal_m2 + inflation[at] * noise.variance_m2;
            let gain = state_variance_m2 / innovation_variance_m2;
            state_variance_m2 *= 1.0 - gain;
            if innovation_variance_m2.is_finite() {
                log_determinant += innovation_variance_m2.ln();
            }
            let inverse_sigma = 1.0 / innovation_variance_m2.sqrt();
            coefficients.push(Coefficients { decay, gain, nominal_m2, inverse_sigma });
        }
        Self { coefficients, log_determinant }
    }

    /// Replaces a column (one value per row) by its normalised innovations.
    pub(crate) fn apply(&self, column: &mut [f64]) {
        self.innovate(column);
        for (innovation, Coefficients { inverse_sigma, .. }) in column.iter_mut().zip(&self.coefficients) {
            *innovation *= inverse_sigma;
        }
    }

    /// Replaces a column by its innovations.
    fn innovate(&self, column: &mut [f64]) {
        let mut state = 0.0;
        for (value, Coefficients { decay, gain, .. }) in column.iter_mut().zip(&self.coefficients) {
            state *= decay;
            *value -= state;
            state += gain * *value;
        }
    }

    /// The variance inflation of every row with which its normalised innovation squared is at most
    /// [`NOMINAL_NIS`], or [`GROSS_ERROR`].
    pub(crate) fn inflation(&self, noise: &GaussMarkovNoise, mut residuals: [Vec<f64>; 2]) -> Vec<f64> {
        residuals.iter_mut().for_each(|axis| self.innovate(axis));
        let [east, north] = residuals;
        let nominal_m2 = |row: usize| self.coefficients[row].nominal_m2;
        let nis = |row: usize| (east[row] * east[row] + north[row] * north[row]) / nominal_m2(row);
        let finite =
            |row: usize| nominal_m2(row) * (nis(row) / NOMINAL_NIS - 1.0).max(0.0) / noise.variance_m2;
        with_gross_errors((0..east.len()).map(finite).collect(), |row| nis(row) > GROSS_NIS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::BoundingBox;
    use crate::geo::{EastNorth, Position};
    use crate::simulation::standard_normal;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Rows of targets with 2,000 s each.
    fn rows(count: usize) -> Vec<TrainingRow> {
        let row = |at: usize| TrainingRow {
            sample: 0,
            time_s: at as f64,
            target: (at / 2000) as u32,
            traverse: (at / 2000) as u32,
            bounding_box: BoundingBox::new(0.0, 0.0, 1.0, 1.0).expect("a box"),
            position: Position::new(0.0, 0.0).expect("a position"),
            label: EastNorth::default(),
            stated_variance_m2: None,
        };
        (0..count).map(row).collect()
    }

    #[test]
    fn gross_errors_do_not_make_the_noise_of_all_rows_large() {
        let rows = rows(2000);
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let mut residuals =
            [0, 1].map(|_| (0..2000).map(|_| 30.0 * standard_normal(&mut rng)).collect::<Vec<_>>());
        (0..2000).step_by(20).for_each(|row| residuals[row / 20 % 2][row] += 1_000.0);
        let is_gross = |row: usize| residuals[0][row].hypot(residuals[1][row]) > 400.0;
        let mut inflation = with_gross_errors(vec![0.0; 2000], is_gross);
        for _ in 0..6 {
            let noise = fit_noise(&rows, &residuals, &inflation);
            assert!((noise.variance_m2.sqrt() - 30.0).abs() < 2.0, "{noise:?}");
            assert!(noise.correlation.white_share > 0.7, "{noise:?}");
            inflation = Whitener::new(&rows, &noise, &inflation).inflation(&noise, residuals.clone());
            assert_eq!(inflation.iter().filter(|inflation| !inflation.is_finite()).count(), 100);
        }
        // Half the rows are no gross errors.
        let half = with_gross_errors(vec![1.0; 4], |row| row < 2);
        assert_eq!(half, [1.0; 4]);
    }

    #[test]
    fn coloured_residuals_are_whitened_to_unit_variance() {
        let rows = rows(8000);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let truth = GaussMarkovNoise {
            variance_m2: 4.0,
            correlation: NoiseCorrelation { white_share: 0.1, time_constant_s: 40.0 },
        };
        let decay = truth.correlation.decay(1.0);
        let mut column = || {
            let mut state = 0.0;
            let mut values = Vec::new();
            for at in 0..rows.len() {
                let decay = if at % 2000 == 0 { 0.0 } else { decay };
                state = decay * state + (3.6 * (1.0 - decay * decay)).sqrt() * standard_normal(&mut rng);
                values.push(state + 0.4f64.sqrt() * standard_normal(&mut rng));
            }
            values
        };
        let residuals = [column(), column()];
        let inflation = vec![0.0; rows.len()];
        let fitted = fit_noise(&rows, &residuals, &inflation);
        assert!((15.0..=100.0).contains(&fitted.correlation.time_constant_s), "{fitted:?}");
        assert!((0.03..=0.25).contains(&fitted.correlation.white_share), "{fitted:?}");
        assert!((2.5..=6.0).contains(&fitted.variance_m2), "{fitted:?}");
        let mut whitened = residuals[0].clone();
        Whitener::new(&rows, &truth, &inflation).apply(&mut whitened);
        let count = whitened.len() as f64;
        let variance = whitened.iter().map(|value| value * value).sum::<f64>() / count;
        let product = whitened.windows(2).map(|pair| pair[0] * pair[1]).sum::<f64>() / count;
        // Five standard errors of 8,000 values.
        assert!((variance - 1.0).abs() < 0.08, "{variance}");
        assert!(product.abs() < 0.056, "{product}");
    }
}
