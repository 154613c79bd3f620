//! How long to wait before the next attempt: longer each time, and never all clients at once.

use std::time::Duration;

use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

const FIRST: Duration = Duration::from_millis(100);
const LONGEST: Duration = Duration::from_secs(5);

/// Waits between attempts.
#[derive(Debug)]
pub(super) struct Backoff {
    failed: u32,
    attempts: u32,
    random: ChaCha8Rng,
}

impl Backoff {
    pub(super) const fn new(attempts: u32, random: ChaCha8Rng) -> Self {
        Self { failed: 0, attempts, random }
    }

    /// Something went well: the next wait is a short one.
    pub(super) const fn reset(&mut self) {
        self.failed = 0;
    }

    /// How long to wait after one more failure: 0.1 s doubled up to 5 s, of which a random share
    /// between half and all. `None` once all attempts are spent.
    pub(super) fn next_wait(&mut self) -> Option<Duration> {
        if self.failed >= self.attempts {
            return None;
        }
        let doubled = FIRST.saturating_mul(1 << self.failed.min(16)).min(LONGEST);
        self.failed += 1;
        Some(doubled.mul_f64(self.random.random_range(0.5..1.0)))
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;

    use super::*;

    #[test]
    fn waits_grow_to_a_limit_and_end() {
        let mut backoff = Backoff::new(40, ChaCha8Rng::seed_from_u64(1));
        let waits: Vec<_> = std::iter::from_fn(|| backoff.next_wait()).collect();
        assert_eq!(waits.len(), 40);
        for (attempt, wait) in waits.iter().enumerate() {
            let whole = FIRST.saturating_mul(1 << attempt.min(16)).min(LONGEST);
            assert!(*wait >= whole / 2 && *wait <= whole, "{attempt}: {wait:?}");
        }
        backoff.reset();
        assert!(backoff.next_wait().expect("anew") <= FIRST);
    }

    #[test]
    fn clients_of_other_seeds_wait_for_other_times() {
        let first = |seed| Backoff::new(1, ChaCha8Rng::seed_from_u64(seed)).next_wait();
        assert_eq!(first(1), first(1));
        assert_ne!(first(1), first(2));
    }
}
