//! A Kalman filter whose columns (the axes of a position, and what is whitened like them) share one covariance.

use crate::domain::NoiseCorrelation;

/// Correlation time of the map's error along a walk, s.
pub(super) const MAP_TIME_CONSTANT_S: f64 = 20.0;

/// `N` states of `M` columns: means by column, common covariance.
#[derive(Debug, Clone, Copy)]
pub(super) struct AxisFilter<const N: usize, const M: usize> {
    pub(super) means: [[f64; N]; M],
    pub(super) covariance: [[f64; N]; N],
}

/// What a measurement says beyond what was expected.
#[derive(Debug, Clone, Copy)]
pub(super) struct Innovation<const N: usize, const M: usize> {
    /// By column.
    pub(super) values: [f64; M],
    /// Variance of each of them.
    pub(super) variance: f64,
    /// Covariance of each state with the measurement.
    rows: [f64; N],
}

impl<const N: usize, const M: usize> AxisFilter<N, M> {
    pub(super) const fn new() -> Self {
        Self { means: [[0.0; N]; M], covariance: [[0.0; N]; N] }
    }

    /// The innovation of a measurement of the sum of the states that `observed` marks, in all columns.
    pub(super) fn innovation(
        &self,
        measured: [f64; M],
        observed: [bool; N],
        noise_variance: f64,
    ) -> Innovation<N, M> {
        let sum = |values: &[f64; N]| -> f64 { (0..N).filter(|at| observed[*at]).map(|at| values[at]).sum() };
        let rows = self.covariance.each_ref().map(sum);
        Innovation {
            values: std::array::from_fn(|column| measured[column] - sum(&self.means[column])),
            variance: sum(&rows) + noise_variance,
            rows,
        }
    }

    /// Updates the states by a measurement.
    pub(super) fn correct(&mut self, Innovation { values, variance, rows }: &Innovation<N, M>) {
        for (mean, innovation) in self.means.iter_mut().zip(values) {
            for (state, row) in mean.iter_mut().zip(rows) {
                *state += row / variance * innovation;
            }
        }
        for (own, row) in self.covariance.iter_mut().zip(rows) {
            for (element, column) in own.iter_mut().zip(rows) {
                *element -= row * column / variance;
            }
        }
    }

    /// Multiplies the states by factors and adds variances.
    pub(super) fn decay(&mut self, factors: [f64; N], added: [f64; N]) {
        for mean in &mut self.means {
            for (state, factor) in mean.iter_mut().zip(factors) {
                *state *= factor;
            }
        }
        for (row, own) in self.covariance.iter_mut().enumerate() {
            for (column, element) in own.iter_mut().enumerate() {
                *element *= factors[row] * factors[column];
            }
            own[row] += added[row];
        }
    }
}

impl<const M: usize> AxisFilter<2, M> {
    /// Moves a receiver's bias and the map's error on, both Gauss-Markov with these variances; begins without a time before.
    pub(super) fn advance(
        &mut self,
        elapsed_s: Option<f64>,
        [bias_m2, map_m2]: [f64; 2],
        gnss: NoiseCorrelation,
    ) {
        let Some(elapsed_s) = elapsed_s.map(|elapsed_s| elapsed_s.max(0.0)) else {
            self.covariance = [[bias_m2, 0.0], [0.0, map_m2]];
            return;
        };
        let (bias, map) = (gnss.decay(elapsed_s), (-elapsed_s / MAP_TIME_CONSTANT_S).exp());
        self.decay([bias, map], [bias_m2 * (1.0 - bias * bias), map_m2 * (1.0 - map * map)]);
    }
}
