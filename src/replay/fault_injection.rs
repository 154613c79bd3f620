//! Injects the faults of a path from sensor to client: items lost, duplicated, reordered.

use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

/// Shares of items affected by each fault, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FaultShares {
    /// Share of items that are not sent.
    pub lose: f64,
    /// Sent a second time, some items later, as an item of its own.
    pub duplicate: f64,
    /// Sent some items later.
    pub reorder: f64,
    /// Largest delay of duplicated and reordered items, in items.
    pub max_delay: u32,
}

impl FaultShares {
    pub const NONE: Self = Self { lose: 0.0, duplicate: 0.0, reorder: 0.0, max_delay: 3 };
}

/// Number of items affected by each fault.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct FaultCounts {
    pub(super) lost: u64,
    pub(super) duplicated: u64,
    pub(super) reordered: u64,
}

/// An iterator with faults. Delays at most `2 * max_delay` items at once.
#[derive(Debug)]
pub(super) struct FaultInjector<I: Iterator> {
    source: I,
    shares: FaultShares,
    random: ChaCha8Rng,
    /// Delayed items, with the number of items that still precede each.
    delayed: Vec<(u32, I::Item)>,
    counts: FaultCounts,
}

impl<I: Iterator<Item: Copy>> FaultInjector<I> {
    pub(super) const fn new(source: I, shares: FaultShares, random: ChaCha8Rng) -> Self {
        Self {
            source,
            shares,
            random,
            delayed: Vec::new(),
            counts: FaultCounts { lost: 0, duplicated: 0, reordered: 0 },
        }
    }

    pub(super) const fn counts(&self) -> FaultCounts {
        self.counts
    }

    fn draw(&mut self, share: f64) -> bool {
        share > 0.0 && self.random.random::<f64>() < share
    }

    fn delay(&mut self, item: I::Item) {
        let delay = self.random.random_range(1..=self.shares.max_delay.max(1));
        self.delayed.push((delay, item));
    }
}

impl<I: Iterator<Item: Copy>> Iterator for FaultInjector<I> {
    type Item = I::Item;

    fn next(&mut self) -> Option<I::Item> {
        loop {
            if let Some(due) = self.delayed.iter().position(|(remaining, _)| *remaining == 0) {
                return Some(self.delayed.remove(due).1);
            }
            let Some(item) = self.source.next() else {
                let first = self.delayed.iter().enumerate().min_by_key(|(_, (remaining, _))| *remaining)?.0;
                return Some(self.delayed.remove(first).1);
            };
            for (remaining, _) in &mut self.delayed {
                *remaining -= 1;
            }
            if self.draw(self.shares.lose) {
                self.counts.lost += 1;
                continue;
            }
            if self.draw(self.shares.duplicate) {
                self.counts.duplicated += 1;
                self.delay(item);
            }
            if self.draw(self.shares.reorder) {
                self.counts.reordered += 1;
                self.delay(item);
                continue;
            }
            return Some(item);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng as _;

    use super::*;

    fn faulty(shares: FaultShares, seed: u64, items: u32) -> (Vec<u32>, FaultCounts) {
        let mut injector = FaultInjector::new(0..items, shares, ChaCha8Rng::seed_from_u64(seed));
        let out = injector.by_ref().collect();
        (out, injector.counts())
    }

    #[test]
    fn without_faults_the_order_is_kept() {
        assert_eq!(faulty(FaultShares::NONE, 1, 50).0, (0..50).collect::<Vec<_>>());
    }

    #[test]
    fn faults_affect_their_shares() {
        let shares = FaultShares { lose: 0.1, duplicate: 0.05, reorder: 0.2, max_delay: 3 };
        let (_, counts) = faulty(shares, 7, 20_000);
        // Five standard deviations of a binomial count are at most 285.
        for (count, mean) in [(counts.lost, 2_000), (counts.duplicated, 900), (counts.reordered, 3_600)] {
            assert!(count.abs_diff(mean) < 285, "{count} where {mean} are expected");
        }
    }

    proptest! {
        #[test]
        fn every_item_occurs_as_counted_and_within_the_delay(
            lose in 0.0..0.5_f64, duplicate in 0.0..0.5_f64, reorder in 0.0..0.9_f64,
            max_delay in 1..8_u32, seed in 0..1_000_u64,
        ) {
            let shares = FaultShares { lose, duplicate, reorder, max_delay };
            let (out, counts) = faulty(shares, seed, 400);
            prop_assert_eq!(faulty(shares, seed, 400).0, out.clone(), "the same seed gives the same faults");
            prop_assert_eq!(out.len() as u64, 400 - counts.lost + counts.duplicated);
            let mut times = vec![0_u32; 400];
            let mut newest = 0;
            for item in out {
                times[item as usize] += 1;
                newest = newest.max(item);
                // Lost items count too, so an item arrives at most `max_delay` items after a newer one.
                prop_assert!(newest - item <= max_delay, "{item} after {newest}");
            }
            prop_assert!(times.iter().all(|times| *times <= 2));
            prop_assert_eq!(times.iter().filter(|times| **times == 0).count() as u64, counts.lost);
        }
    }
}
