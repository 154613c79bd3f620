//! The noises of detectors and receivers, each from its own seeded stream.
//!
//! What never happens here: any source of randomness that was not handed in.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::geo::EastNorth;

/// One independent stream of a seed, so that switching one noise on or off leaves the others as
/// they were.
pub(super) fn stream(seed: u64, number: u64) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(number);
    random
}

/// A draw from the standard normal distribution (Box and Muller).
pub(super) fn normal(random: &mut impl Rng) -> f64 {
    let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
}

/// A stationary Gauss-Markov value of standard deviation 1, times whatever its user says.
#[derive(Debug, Clone)]
pub(super) struct GaussMarkov {
    value: f64,
    time_constant_s: f64,
}

impl GaussMarkov {
    pub(super) fn new(time_constant_s: f64, random: &mut impl Rng) -> Self {
        Self { value: normal(random), time_constant_s }
    }

    /// The value after some seconds, standard deviation 1.
    pub(super) fn after(&mut self, seconds: f64, random: &mut impl Rng) -> f64 {
        let keep = (-seconds / self.time_constant_s).exp();
        self.value = keep * self.value + (1.0 - keep * keep).sqrt() * normal(random);
        self.value
    }
}

/// Standard deviations per axis (m) of a receiver, and the time constant of its coloured part (s).
#[derive(Debug, Clone, Copy)]
pub(super) struct ReceiverError {
    pub(super) white_m: f64,
    pub(super) coloured_m: f64,
    pub(super) time_constant_s: f64,
}

/// One receiver: a white and a coloured error per axis.
#[derive(Debug)]
pub(super) struct Receiver {
    error: ReceiverError,
    east: GaussMarkov,
    north: GaussMarkov,
    random: ChaCha8Rng,
}

impl Receiver {
    pub(super) fn new(error: ReceiverError, mut random: ChaCha8Rng) -> Self {
        let east = GaussMarkov::new(error.time_constant_s, &mut random);
        let north = GaussMarkov::new(error.time_constant_s, &mut random);
        Self { error, east, north, random }
    }

    /// Where the receiver says it is, some seconds after it was asked last.
    pub(super) fn fix(&mut self, truth: EastNorth, seconds: f64) -> EastNorth {
        let ReceiverError { white_m, coloured_m, .. } = self.error;
        let east_m = coloured_m * self.east.after(seconds, &mut self.random);
        let north_m = coloured_m * self.north.after(seconds, &mut self.random);
        EastNorth {
            east_m: truth.east_m + east_m + white_m * normal(&mut self.random),
            north_m: truth.north_m + north_m + white_m * normal(&mut self.random),
        }
    }
}

/// Comes and goes: holds for a given share of the rows, in episodes of a mean length.
#[derive(Debug)]
pub(super) struct Episodes {
    begin: f64,
    end: f64,
    on: bool,
    random: ChaCha8Rng,
}

impl Episodes {
    /// A share of 0 never begins; shares are kept below 0.95.
    pub(super) fn new(share: f64, mean_rows: f64, random: ChaCha8Rng) -> Self {
        let share = share.clamp(0.0, 0.95);
        let end = 1.0 / mean_rows;
        Self { begin: end * share / (1.0 - share), end, on: false, random }
    }

    /// Whether it holds in the next row, and a number in 0..1 that is the row's own.
    pub(super) fn next_row(&mut self) -> (bool, f64) {
        let draw = self.random.random::<f64>();
        self.on = if self.on { draw >= self.end } else { draw < self.begin };
        (self.on, self.random.random::<f64>())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_receiver_has_the_variance_and_the_colour_it_was_given() {
        let error = ReceiverError { white_m: 0.13, coloured_m: 2.2, time_constant_s: 45.0 };
        let mut receiver = Receiver::new(error, stream(3, 1));
        let easts: Vec<f64> = (0..40_000).map(|_| receiver.fix(EastNorth::default(), 1.0).east_m).collect();
        let mean = |values: &mut dyn Iterator<Item = f64>| {
            let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
            sum / count
        };
        let variance_m2 = mean(&mut easts.iter().map(|east| east * east));
        let lagged_m2 = mean(&mut easts.iter().zip(&easts[20..]).map(|(now, later)| now * later));
        // About 440 independent values: the variance is known to 7 %.
        assert!((variance_m2 / (2.2 * 2.2 + 0.13 * 0.13) - 1.0).abs() < 0.25, "{variance_m2}");
        assert!((lagged_m2 / variance_m2 - (-20.0f64 / 45.0).exp()).abs() < 0.1, "{lagged_m2}");
    }

    #[test]
    fn episodes_hold_for_their_share() {
        let mut episodes = Episodes::new(0.2, 5.0, stream(4, 0));
        let rows = (0..20_000).filter(|_| episodes.next_row().0).count();
        assert!((3_400..4_600).contains(&rows), "{rows}");
        let mut never = Episodes::new(0.0, 5.0, stream(4, 0));
        assert!((0..1_000).all(|_| !never.next_row().0));
    }
}
