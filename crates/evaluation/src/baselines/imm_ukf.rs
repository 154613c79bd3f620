//! The IMM-UKF over fixes, tuned on the training fixes.

use crate::filters::{ImmUkf, ImmUkfOptions, Traverse};

/// Acceleration standard deviations that are tried, m/s2.
const ACCELERATIONS_MPS2: [f64; 7] = [0.03, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2];
/// Taken where there is no training fix, m/s2.
const DEFAULT_ACCELERATION_MPS2: f64 = 0.4;
/// A prediction this far ahead makes the filter forget the previous traverse, s.
const RESET_S: f64 = 1e9;

/// The filter options that maximise the likelihood of the training fixes, given the receiver's error
/// variance per axis (m2).
///
/// Coloured errors look like motion, so a likelihood with a free variance would follow every fix; the
/// track's decomposition into white and coloured noise is not available to this baseline.
#[must_use]
pub fn tune(traverses: &[Traverse], variance_m2: f64) -> ImmUkfOptions {
    let log_likelihood = |acceleration_mps2: f64| -> f64 {
        let mut filter = ImmUkf::new(ImmUkfOptions::from_acceleration(acceleration_mps2));
        let mut sum = 0.0;
        for (times_s, fixes) in traverses {
            filter.step(RESET_S, None);
            for (index, fix) in fixes.iter().enumerate() {
                let seconds = if index == 0 { 0.0 } else { times_s[index] - times_s[index - 1] };
                let estimate = filter.step(seconds, Some((*fix, variance_m2)));
                sum += estimate.map_or(0.0, |estimate| estimate.log_likelihood);
            }
        }
        sum
    };
    let scored = ACCELERATIONS_MPS2.map(|candidate| (log_likelihood(candidate), candidate));
    let best = scored.into_iter().max_by(|one, other| one.0.total_cmp(&other.0));
    ImmUkfOptions::from_acceleration(best.map_or(DEFAULT_ACCELERATION_MPS2, |(_, candidate)| candidate))
}
