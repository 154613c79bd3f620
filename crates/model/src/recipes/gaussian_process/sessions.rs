//! By how much sessions contradict each other.
//!
//! Half an hour without any row ends a session. Within one, no filter can tell a receiver's lasting bias
//! from the map; between them, the means of their residuals about one map scatter by it.

use super::noise::{Epoch, ReceiverNoise, ReceiverWhitener};
use crate::samples::rows::SESSION_GAP_S;

/// Sessions with fewer rows say nothing.
const MIN_ROWS: usize = 20;

/// How sessions differ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SessionBiases {
    pub(crate) count: usize,
    /// Variance per axis between the sessions' mean residuals, beyond what short-lived noise leaves of a
    /// mean, m2.
    pub(crate) between_m2: f64,
}

impl SessionBiases {
    /// From residuals about one map, rows in the order of target and time; `None` for fewer than two.
    pub(crate) fn new(epochs: &[Epoch], residuals_m: &[[f64; 2]], noise: &ReceiverNoise) -> Option<Self> {
        let mut order: Vec<usize> = (0..epochs.len()).collect();
        order.sort_by(|one, other| epochs[*one].time_s.total_cmp(&epochs[*other].time_s));
        let short = ReceiverNoise { session_m2: 0.0, ..*noise };
        let (mut means, mut noise_m2) = (Vec::new(), 0.0);
        for session in order.chunk_by(|one, next| epochs[*next].time_s - epochs[*one].time_s <= SESSION_GAP_S)
        {
            if session.len() < MIN_ROWS {
                continue;
            }
            let mut rows = session.to_vec();
            rows.sort_unstable();
            let own: Vec<Epoch> = rows.iter().map(|row| epochs[*row]).collect();
            let own_m: Vec<[f64; 2]> = rows.iter().map(|row| residuals_m[*row]).collect();
            let (mean_m, variance_m2) = weighted_mean(&own, &short, &own_m);
            means.push(mean_m);
            noise_m2 += variance_m2;
        }
        let count = means.len();
        if count < 2 {
            return None;
        }
        let centre = [0, 1].map(|axis| means.iter().map(|mean| mean[axis]).sum::<f64>() / count as f64);
        let square = |mean: &[f64; 2]| (mean[0] - centre[0]).powi(2) + (mean[1] - centre[1]).powi(2);
        let scatter_m2 = means.iter().map(square).sum::<f64>() / (2.0 * (count as f64 - 1.0));
        Some(Self { count, between_m2: (scatter_m2 - noise_m2 / count as f64).max(0.0) })
    }
}

/// Generalised least-squares mean of residuals, m, and its variance per axis, m2. Gross errors are weighed
/// down as in the fit.
pub(crate) fn weighted_mean(
    epochs: &[Epoch],
    noise: &ReceiverNoise,
    residuals_m: &[[f64; 2]],
) -> ([f64; 2], f64) {
    let plain = ReceiverWhitener::new(epochs, noise, &vec![0.0; epochs.len()]);
    let whitener = ReceiverWhitener::new(epochs, noise, &plain.inflation_m2(residuals_m));
    let mut ones = vec![1.0; residuals_m.len()];
    whitener.apply(&mut ones);
    let information = ones.iter().map(|one| one * one).sum::<f64>();
    let mean_m = [0, 1].map(|axis| {
        let mut column: Vec<f64> = residuals_m.iter().map(|residual| residual[axis]).collect();
        whitener.apply(&mut column);
        ones.iter().zip(&column).map(|(one, value)| one * value).sum::<f64>() / information
    });
    (mean_m, 1.0 / information)
}
