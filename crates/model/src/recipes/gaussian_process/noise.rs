//! The error of a receiver in real time, and the Kalman filter that whitens whatever carries it.
//!
//! Per axis the error of a fix is the sum of a white part and two Ornstein-Uhlenbeck processes: a short
//! one of tens of seconds (multipath, the receiver's own filter) and a slow one of hours, which within
//! one recording is a constant bias of that receiver. Receivers are independent of each other. The
//! filter's innovations are independent with a known variance, so least squares on them is exact
//! generalised least squares in linear time (Bar-Shalom, Li and Kirubarajan 2001, sections 5.2 and 8.2).

use crate::domain::GaussMarkovNoise;

/// Squared normalised innovation of both axes from which a row counts less (2 degrees of freedom, 98 %).
const CREDIBLE_NIS: f64 = 8.0;
/// Least white variance of a fix, m2: its rounding.
const MIN_WHITE_M2: f64 = 1e-4;

/// Variances per axis and time constant of one receiver's error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ReceiverNoise {
    /// Variance that is new with each fix, m2.
    pub(crate) white_m2: f64,
    /// Variance of the short process, m2.
    pub(crate) short_m2: f64,
    /// Correlation time of the short process, s.
    pub(crate) short_time_s: f64,
    /// Variance of the slow process, m2.
    pub(crate) session_m2: f64,
    /// Correlation time of the slow process, s.
    pub(crate) session_time_s: f64,
}

impl ReceiverNoise {
    pub(crate) const fn white(white_m2: f64) -> Self {
        Self { white_m2, short_m2: 0.0, short_time_s: 1.0, session_m2: 0.0, session_time_s: 1.0 }
    }

    /// Noise without a slow process.
    pub(crate) fn of_gauss_markov(noise: &GaussMarkovNoise) -> Self {
        Self {
            short_m2: noise.coloured_variance_m2(),
            short_time_s: noise.correlation.time_constant_s,
            ..Self::white(noise.white_variance_m2().max(MIN_WHITE_M2))
        }
    }

    /// Variance of one fix per axis, m2.
    pub(crate) fn variance_m2(&self) -> f64 {
        self.white_m2 + self.short_m2 + self.session_m2
    }
}

/// When a row was taken, and which whitening sequence it continues. Rows of one sequence stand
/// together in the order of time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Epoch {
    /// Seconds since any fixed instant.
    pub(crate) time_s: f64,
    /// Receiver, or receiver and segment where segments count as independent.
    pub(crate) sequence: u32,
}

#[derive(Debug, Clone, Copy)]
struct WhiteningStep {
    decay: [f64; 2],
    gain: [f64; 2],
    inverse_sigma: f64,
    /// Variance of this row's innovation without its own inflation, m2.
    nominal_m2: f64,
}

/// The filter of one set of rows.
#[derive(Debug, Clone)]
pub(crate) struct ReceiverWhitener {
    steps: Vec<WhiteningStep>,
    /// Sum of the logarithms of the innovations' variances.
    pub(crate) log_determinant: f64,
}

impl ReceiverWhitener {
    /// `inflation_m2` is added to each row's white variance.
    pub(crate) fn new(epochs: &[Epoch], noise: &ReceiverNoise, inflation_m2: &[f64]) -> Self {
        let stationary_m2 = [noise.short_m2, noise.session_m2];
        let mut steps = Vec::with_capacity(epochs.len());
        let (mut p00, mut p01, mut p11) = (0.0, 0.0, 0.0);
        let mut log_determinant = 0.0;
        for (index, epoch) in epochs.iter().enumerate() {
            let decay = match index.checked_sub(1).map(|before| epochs[before]) {
                Some(before) if before.sequence == epoch.sequence => {
                    let elapsed_s = (epoch.time_s - before.time_s).max(0.0);
                    [(-elapsed_s / noise.short_time_s).exp(), (-elapsed_s / noise.session_time_s).exp()]
                }
                _ => [0.0; 2],
            };
            p00 = decay[0] * decay[0] * (p00 - stationary_m2[0]) + stationary_m2[0];
            p01 *= decay[0] * decay[1];
            p11 = decay[1] * decay[1] * (p11 - stationary_m2[1]) + stationary_m2[1];
            let nominal_m2 = p00 + 2.0 * p01 + p11 + noise.white_m2;
            let variance_m2 = nominal_m2 + inflation_m2[index];
            let gain = [(p00 + p01) / variance_m2, (p01 + p11) / variance_m2];
            p00 -= gain[0] * gain[0] * variance_m2;
            p01 -= gain[0] * gain[1] * variance_m2;
            p11 -= gain[1] * gain[1] * variance_m2;
            log_determinant += variance_m2.ln();
            steps.push(WhiteningStep { decay, gain, inverse_sigma: 1.0 / variance_m2.sqrt(), nominal_m2 });
        }
        Self { steps, log_determinant }
    }

    /// Replaces a column by its normalised innovations.
    pub(crate) fn apply(&self, column: &mut [f64]) {
        let mut state = [0.0; 2];
        for (value, step) in column.iter_mut().zip(&self.steps) {
            state[0] *= step.decay[0];
            state[1] *= step.decay[1];
            let innovation = *value - state[0] - state[1];
            state[0] += step.gain[0] * innovation;
            state[1] += step.gain[1] * innovation;
            *value = innovation * step.inverse_sigma;
        }
    }

    /// Extra white variance per row, m2, that brings the normalised innovation of `residuals_m` down to
    /// the credible one: Huber's weights for gross errors.
    pub(crate) fn inflation_m2(&self, residuals_m: &[[f64; 2]]) -> Vec<f64> {
        let axis = |axis: usize| {
            let mut column: Vec<f64> = residuals_m.iter().map(|residual| residual[axis]).collect();
            self.apply(&mut column);
            column
        };
        let (east, north) = (axis(0), axis(1));
        let squares = east.iter().zip(&north).map(|(east, north)| east * east + north * north);
        self.steps
            .iter()
            .zip(squares)
            .map(|(step, nis)| {
                let square_m2 = nis / (step.inverse_sigma * step.inverse_sigma);
                (square_m2 / CREDIBLE_NIS - step.nominal_m2).max(0.0)
            })
            .collect()
    }
}
