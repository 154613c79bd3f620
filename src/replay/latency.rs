//! Times from sending to answer, in bounded memory.

use std::time::Duration;

/// Buckets per doubling: a percentile is at most 1/32 above the true one.
const STEPS: u64 = 32;
const STEPS_BITS: u32 = STEPS.trailing_zeros();
/// The last bucket holds all from some 70 minutes on.
const BUCKETS: usize = 28 * STEPS as usize;

/// A histogram of times: exact to the microsecond below 64 us, then 32 buckets per doubling.
#[derive(Debug, Clone)]
pub struct Latencies {
    counts: Box<[u64]>,
    total: u64,
    longest: Duration,
}

impl Default for Latencies {
    fn default() -> Self {
        Self { counts: vec![0; BUCKETS].into(), total: 0, longest: Duration::ZERO }
    }
}

fn bucket(latency: Duration) -> usize {
    let us = u64::try_from(latency.as_micros()).unwrap_or(u64::MAX);
    let doublings = us.max(1).ilog2().saturating_sub(STEPS_BITS);
    let index = u64::from(doublings) * STEPS + (us >> doublings);
    usize::try_from(index).map_or(BUCKETS - 1, |index| index.min(BUCKETS - 1))
}

/// The longest time that falls into a bucket.
fn upper(index: usize) -> Duration {
    let index = index as u64;
    let doublings = (index / STEPS).saturating_sub(1);
    let step = index - doublings * STEPS;
    Duration::from_micros(((step + 1) << doublings) - 1)
}

impl Latencies {
    /// Takes one time in.
    pub fn record(&mut self, latency: Duration) {
        self.counts[bucket(latency)] += 1;
        self.total += 1;
        self.longest = self.longest.max(latency);
    }

    /// Takes in all that another one holds.
    pub fn add(&mut self, other: &Self) {
        for (count, more) in self.counts.iter_mut().zip(&other.counts) {
            *count += more;
        }
        self.total += other.total;
        self.longest = self.longest.max(other.longest);
    }

    /// The time that a share of all (0 to 1) do not exceed; zero if there are none.
    #[must_use]
    pub fn percentile(&self, share: f64) -> Duration {
        let rank = (share * self.total as f64).ceil().max(1.0);
        let mut seen = 0;
        for (index, count) in self.counts.iter().enumerate() {
            seen += count;
            if seen as f64 >= rank {
                return upper(index).min(self.longest);
            }
        }
        self.longest
    }

    /// The longest; exact.
    #[must_use]
    pub const fn longest(&self) -> Duration {
        self.longest
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn nothing_is_zero() {
        assert_eq!(Latencies::default().percentile(0.99), Duration::ZERO);
    }

    #[test]
    fn times_beyond_all_measure_fall_into_the_last_bucket() {
        let mut latencies = Latencies::default();
        latencies.record(Duration::MAX);
        assert_eq!(bucket(Duration::MAX), BUCKETS - 1);
        assert_eq!(latencies.longest(), Duration::MAX);
    }

    proptest! {
        #[test]
        fn percentiles_are_near_those_of_the_sorted_times(
            mut us in proptest::collection::vec(0_u64..3_000_000_000, 1..300),
            share in 0.0..=1.0_f64,
        ) {
            let (mut one, mut other) = (Latencies::default(), Latencies::default());
            for (index, us) in us.iter().enumerate() {
                if index % 2 == 0 { &mut one } else { &mut other }.record(Duration::from_micros(*us));
            }
            one.add(&other);
            us.sort_unstable();
            let rank = ((share * us.len() as f64).ceil() as usize).max(1);
            let exact = us[rank - 1] as f64;
            let told = one.percentile(share).as_micros() as f64;
            prop_assert!(told >= exact && told <= exact * (1.0 + 1.0 / 32.0) + 1.0, "{told} for {exact}");
        }
    }
}
