//! What goes wrong between a sensor and its client: items lost, doubled, out of order.

use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

/// Shares of items to which each fault happens, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FaultShares {
    /// Never sent.
    pub lose: f64,
    /// Sent a second time, some items later, as an item of its own.
    pub duplicate: f64,
    /// Sent some items later.
    pub reorder: f64,
    /// Doubled and reordered items come at most this many items late.
    pub latest: u32,
}

impl FaultShares {
    /// Nothing goes wrong.
    pub const NONE: Self = Self { lose: 0.0, duplicate: 0.0, reorder: 0.0, latest: 3 };
}

/// How often each fault has happened.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct FaultCounts {
    pub(super) lost: u64,
    pub(super) duplicated: u64,
    pub(super) reordered: u64,
}

/// A sequence with faults. Holds back at most `2 * latest` items.
#[derive(Debug)]
pub(super) struct Faults<I: Iterator> {
    source: I,
    shares: FaultShares,
    random: ChaCha8Rng,
    /// Items held back, with the number of items that still go first.
    held: Vec<(u32, I::Item)>,
    counts: FaultCounts,
}

impl<I: Iterator<Item: Copy>> Faults<I> {
    pub(super) const fn new(source: I, shares: FaultShares, random: ChaCha8Rng) -> Self {
        Self {
            source,
            shares,
            random,
            held: Vec::new(),
            counts: FaultCounts { lost: 0, duplicated: 0, reordered: 0 },
        }
    }

    pub(super) const fn counts(&self) -> FaultCounts {
        self.counts
    }

    fn happens(&mut self, share: f64) -> bool {
        // Without the draw a share of 0 would still cost one per item.
        share > 0.0 && self.random.random::<f64>() < share
    }

    fn hold(&mut self, item: I::Item) {
        let late = self.random.random_range(1..=self.shares.latest.max(1));
        self.held.push((late, item));
    }
}

impl<I: Iterator<Item: Copy>> Iterator for Faults<I> {
    type Item = I::Item;

    fn next(&mut self) -> Option<I::Item> {
        loop {
            if let Some(due) = self.held.iter().position(|(left, _)| *left == 0) {
                return Some(self.held.remove(due).1);
            }
            let Some(item) = self.source.next() else {
                let first = self.held.iter().enumerate().min_by_key(|(_, (left, _))| *left)?.0;
                return Some(self.held.remove(first).1);
            };
            for (left, _) in &mut self.held {
                *left -= 1;
            }
            if self.happens(self.shares.lose) {
                self.counts.lost += 1;
                continue;
            }
            if self.happens(self.shares.duplicate) {
                self.counts.duplicated += 1;
                self.hold(item);
            }
            if self.happens(self.shares.reorder) {
                self.counts.reordered += 1;
                self.hold(item);
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
        let mut faults = Faults::new(0..items, shares, ChaCha8Rng::seed_from_u64(seed));
        let out = faults.by_ref().collect();
        (out, faults.counts())
    }

    #[test]
    fn without_faults_all_goes_in_order() {
        assert_eq!(faulty(FaultShares::NONE, 1, 50).0, (0..50).collect::<Vec<_>>());
    }

    #[test]
    fn the_shares_are_kept() {
        let shares = FaultShares { lose: 0.1, duplicate: 0.05, reorder: 0.2, latest: 3 };
        let (_, counts) = faulty(shares, 7, 20_000);
        // Five standard deviations of a binomial count are at most 285.
        for (count, mean) in [(counts.lost, 2_000), (counts.duplicated, 900), (counts.reordered, 3_600)] {
            assert!(count.abs_diff(mean) < 285, "{count} where {mean} are expected");
        }
    }

    proptest! {
        #[test]
        fn every_item_comes_as_often_as_the_counts_say_and_never_too_late(
            lose in 0.0..0.5_f64, duplicate in 0.0..0.5_f64, reorder in 0.0..0.9_f64,
            latest in 1..8_u32, seed in 0..1_000_u64,
        ) {
            let shares = FaultShares { lose, duplicate, reorder, latest };
            let (out, counts) = faulty(shares, seed, 400);
            prop_assert_eq!(faulty(shares, seed, 400).0, out.clone(), "the same seed gives the same faults");
            prop_assert_eq!(out.len() as u64, 400 - counts.lost + counts.duplicated);
            let mut times = vec![0_u32; 400];
            let mut newest = 0;
            for item in out {
                times[item as usize] += 1;
                newest = newest.max(item);
                // Lost items count as places too, so an item is at most `latest` behind the newest read.
                prop_assert!(newest - item <= latest, "{item} after {newest}");
            }
            prop_assert!(times.iter().all(|times| *times <= 2));
            prop_assert_eq!(times.iter().filter(|times| **times == 0).count() as u64, counts.lost);
        }
    }
}
