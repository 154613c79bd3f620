//! Latencies in bounded memory, in a high dynamic range histogram.

use std::time::Duration;

use hdrhistogram::Histogram;

/// Decimal digits that are kept: a quantile is at most 1 % above the true one.
const SIGNIFICANT_DIGITS: u8 = 2;
/// Largest resolved latency, microseconds: an hour.
const MAX_US: u64 = 3_600_000_000;

/// A histogram of latencies in microseconds; its memory grows with the logarithm of the largest.
#[derive(Debug, Clone)]
pub(super) struct LatencyHistogram {
    histogram: Histogram<u64>,
    max: Duration,
}

impl Default for LatencyHistogram {
    fn default() -> Self {
        let histogram = Histogram::new(SIGNIFICANT_DIGITS).expect("up to five digits are supported");
        Self { histogram, max: Duration::ZERO }
    }
}

impl LatencyHistogram {
    pub(super) fn record(&mut self, latency: Duration) {
        let us = u64::try_from(latency.as_micros()).unwrap_or(u64::MAX).min(MAX_US);
        self.histogram.record(us).expect("a histogram without bounds resizes itself");
        self.max = self.max.max(latency);
    }

    /// Adds all values of another histogram.
    pub(super) fn add(&mut self, other: &Self) {
        self.histogram.add(&other.histogram).expect("a histogram without bounds resizes itself");
        self.max = self.max.max(other.max);
    }

    /// The latency that a share (0 to 1) of all values does not exceed; zero for an empty histogram.
    pub(super) fn quantile(&self, share: f64) -> Duration {
        Duration::from_micros(self.histogram.value_at_quantile(share)).min(self.max)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.histogram.is_empty()
    }

    /// The largest value; exact.
    pub(super) const fn max(&self) -> Duration {
        self.max
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn an_empty_histogram_is_zero() {
        assert_eq!(LatencyHistogram::default().quantile(0.99), Duration::ZERO);
    }

    #[test]
    fn latencies_beyond_the_range_keep_their_maximum() {
        let mut latencies = LatencyHistogram::default();
        latencies.record(Duration::MAX);
        assert_eq!(latencies.max(), Duration::MAX);
        assert!(latencies.quantile(1.0) >= Duration::from_micros(MAX_US));
    }

    proptest! {
        #[test]
        fn quantiles_are_within_one_percent_of_the_sorted_latencies(
            mut us in proptest::collection::vec(0_u64..3_000_000_000, 1..300),
            share in 0.001..=1.0_f64,
        ) {
            let (mut one, mut other) = (LatencyHistogram::default(), LatencyHistogram::default());
            for (index, us) in us.iter().enumerate() {
                if index % 2 == 0 { &mut one } else { &mut other }.record(Duration::from_micros(*us));
            }
            one.add(&other);
            us.sort_unstable();
            let rank = ((share * us.len() as f64).ceil() as usize).max(1);
            let exact = us[rank - 1] as f64;
            let quantile = one.quantile(share).as_micros() as f64;
            prop_assert!(quantile >= exact && quantile <= 1.01 * exact + 1.0, "{quantile} for {exact}");
        }
    }
}
