//! Noise of detectors and receivers, each kind from its own seeded stream.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::domain::GaussMarkovNoise;
use crate::geo::EastNorth;

/// An independent stream of a seed: enabling one kind of noise does not change the draws of another.
#[must_use]
pub fn stream(seed: u64, number: u64) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(number);
    random
}

/// A draw from the standard normal distribution.
pub fn standard_normal(random: &mut impl Rng) -> f64 {
    random.sample(StandardNormal)
}

/// A stationary first-order Gauss-Markov process of standard deviation 1.
#[derive(Debug, Clone)]
pub(super) struct GaussMarkov {
    value: f64,
    time_constant_s: f64,
}

impl GaussMarkov {
    pub(super) fn new(time_constant_s: f64, random: &mut impl Rng) -> Self {
        Self { value: standard_normal(random), time_constant_s }
    }

    /// The value that many seconds later: `x' = phi x + sqrt(1 - phi^2) n`, `phi = exp(-t / tau)`.
    pub(super) fn advance(&mut self, seconds: f64, random: &mut impl Rng) -> f64 {
        let decay = (-seconds / self.time_constant_s).exp();
        self.value = decay * self.value + (1.0 - decay * decay).sqrt() * standard_normal(random);
        self.value
    }
}

/// One receiver with independent errors on both axes.
#[derive(Debug)]
pub struct SimulatedReceiver {
    error: GaussMarkovNoise,
    bias: EastNorth,
    east: GaussMarkov,
    north: GaussMarkov,
    random: ChaCha8Rng,
}

impl SimulatedReceiver {
    /// `bias` is the part of the error that never changes, m.
    pub(super) fn new(error: GaussMarkovNoise, bias: EastNorth, mut random: ChaCha8Rng) -> Self {
        let east = GaussMarkov::new(error.correlation.time_constant_s, &mut random);
        let north = GaussMarkov::new(error.correlation.time_constant_s, &mut random);
        Self { error, bias, east, north, random }
    }

    /// A receiver without a constant bias, drawn from a numbered stream of a seed.
    #[must_use]
    pub fn seeded(error: GaussMarkovNoise, seed: u64, number: u64) -> Self {
        Self::new(error, EastNorth::default(), stream(seed, number))
    }

    /// The measured position, that many seconds after the previous one.
    pub fn measure(&mut self, truth: EastNorth, seconds: f64) -> EastNorth {
        let (white_m, coloured_m) = (self.error.white_sigma_m(), self.error.coloured_sigma_m());
        let east_m = coloured_m * self.east.advance(seconds, &mut self.random);
        let north_m = coloured_m * self.north.advance(seconds, &mut self.random);
        EastNorth {
            east_m: truth.east_m + east_m + white_m * standard_normal(&mut self.random) + self.bias.east_m,
            north_m: truth.north_m
                + north_m
                + white_m * standard_normal(&mut self.random)
                + self.bias.north_m,
        }
    }
}

/// A two-state Markov chain: on for a given share of the rows, in episodes of a given mean length.
#[derive(Debug)]
pub(super) struct Episodes {
    begin_probability: f64,
    end_probability: f64,
    is_on: bool,
    random: ChaCha8Rng,
}

impl Episodes {
    /// `share` is clamped to 0..=0.95; 0 never begins an episode.
    pub(super) fn new(share: f64, mean_rows: f64, random: ChaCha8Rng) -> Self {
        let share = share.clamp(0.0, 0.95);
        let end_probability = 1.0 / mean_rows;
        let begin_probability = end_probability * share / (1.0 - share);
        Self { begin_probability, end_probability, is_on: false, random }
    }

    /// Returns true if the next row is in an episode, and a uniform number in 0..1 for the use of that row.
    pub(super) fn next_row(&mut self) -> (bool, f64) {
        let draw = self.random.random::<f64>();
        self.is_on = if self.is_on { draw >= self.end_probability } else { draw < self.begin_probability };
        (self.is_on, self.random.random::<f64>())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::NoiseCorrelation;

    #[test]
    fn a_receiver_has_its_variance_and_autocorrelation() {
        let correlation = NoiseCorrelation { white_share: 0.0035, time_constant_s: 45.0 };
        let error = GaussMarkovNoise::new(2.204, correlation);
        let mut receiver = SimulatedReceiver::new(error, EastNorth::default(), stream(3, 1));
        let easts: Vec<f64> =
            (0..40_000).map(|_| receiver.measure(EastNorth::default(), 1.0).east_m).collect();
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
    fn episodes_cover_their_share() {
        let mut episodes = Episodes::new(0.2, 5.0, stream(4, 0));
        let rows = (0..20_000).filter(|_| episodes.next_row().0).count();
        assert!((3_400..4_600).contains(&rows), "{rows}");
        let mut never = Episodes::new(0.0, 5.0, stream(4, 0));
        assert!((0..1_000).all(|_| !never.next_row().0));
    }
}
