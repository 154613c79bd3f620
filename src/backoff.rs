//! Exponential backoff with jitter between attempts to reach another system.

use std::time::Duration;

use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

const INITIAL_DELAY: Duration = Duration::from_millis(100);
const MAX_DELAY: Duration = Duration::from_secs(5);

/// The delays of one client.
#[derive(Debug)]
pub struct Backoff {
    failures: u32,
    max_attempts: u32,
    random: ChaCha8Rng,
}

impl Backoff {
    /// `max_attempts` failures in a row are followed by a delay.
    #[must_use]
    pub const fn new(max_attempts: u32, random: ChaCha8Rng) -> Self {
        Self { failures: 0, max_attempts, random }
    }

    /// Resets the delay and the attempts after a success.
    pub const fn reset(&mut self) {
        self.failures = 0;
    }

    /// The delay after one more failure: 0.1 s, doubled with every failure up to 5 s, times a uniform
    /// factor from 0.5 to 1. `None` once all attempts are used.
    pub fn next_delay(&mut self) -> Option<Duration> {
        if self.failures >= self.max_attempts {
            return None;
        }
        let delay = INITIAL_DELAY.saturating_mul(1 << self.failures.min(16)).min(MAX_DELAY);
        self.failures += 1;
        Some(delay.mul_f64(self.random.random_range(0.5..1.0)))
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;

    use super::*;

    #[test]
    fn delays_grow_to_a_limit_and_end() {
        let mut backoff = Backoff::new(40, ChaCha8Rng::seed_from_u64(1));
        let delays: Vec<_> = std::iter::from_fn(|| backoff.next_delay()).collect();
        assert_eq!(delays.len(), 40);
        for (attempt, delay) in delays.iter().enumerate() {
            let upper = INITIAL_DELAY.saturating_mul(1 << attempt.min(16)).min(MAX_DELAY);
            assert!(*delay >= upper / 2 && *delay <= upper, "{attempt}: {delay:?}");
        }
        backoff.reset();
        assert!(backoff.next_delay().expect("attempts are reset") <= INITIAL_DELAY);
    }

    #[test]
    fn clients_with_different_seeds_have_different_delays() {
        let first = |seed| Backoff::new(1, ChaCha8Rng::seed_from_u64(seed)).next_delay();
        assert_eq!(first(1), first(1));
        assert_ne!(first(1), first(2));
    }
}
