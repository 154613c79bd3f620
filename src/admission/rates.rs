//! Rates: requests per second of each client, and bytes of bodies that were refused.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

use super::ClientId;
use crate::domain::{Error, ErrorKind, Result};

/// A rate as a bucket that holds one second's worth of tokens and is refilled continuously.
#[derive(Debug, Clone, Copy)]
pub struct TokenBucket {
    tokens: f64,
    refilled_at: Instant,
}

impl TokenBucket {
    /// A full bucket.
    #[must_use]
    pub const fn full(per_s: f64, now: Instant) -> Self {
        Self { tokens: per_s, refilled_at: now }
    }

    /// Takes tokens; false, and none taken, if there are too few.
    pub fn take(&mut self, count: f64, per_s: f64, now: Instant) -> bool {
        let refill = now.saturating_duration_since(self.refilled_at).as_secs_f64() * per_s;
        self.tokens = (self.tokens + refill).min(per_s);
        self.refilled_at = now;
        let is_enough = self.tokens >= count;
        if is_enough {
            self.tokens -= count;
        }
        is_enough
    }
}

/// Requests per second of each client. Unlike a [`Quota`] it does not depend on how long they take.
pub struct RateLimit {
    /// The name of the counted unit, in the plural, for the refusal.
    what: &'static str,
    per_s: u32,
    buckets: Mutex<HashMap<ClientId, TokenBucket>>,
}

/// Buckets beyond which those that are full again are dropped before one is added.
const MOST_BUCKETS: usize = 4_096;
/// Time in which an empty bucket is full again.
const REFILL_TIME: Duration = Duration::from_secs(1);

impl RateLimit {
    /// A limit of `per_s` units per second; 0 is no limit.
    #[must_use]
    pub fn new(what: &'static str, per_s: u32) -> Self {
        Self { what, per_s, buckets: Mutex::default() }
    }

    /// Counts a request.
    ///
    /// # Errors
    /// `RateLimited`.
    pub fn count(&self, client: ClientId, now: Instant) -> Result<()> {
        if self.per_s == 0 {
            return Ok(());
        }
        let per_s = f64::from(self.per_s);
        let mut buckets = self.buckets.lock().unwrap_or_else(PoisonError::into_inner);
        if buckets.len() >= MOST_BUCKETS && !buckets.contains_key(&client) {
            buckets.retain(|_, bucket| now.saturating_duration_since(bucket.refilled_at) < REFILL_TIME);
        }
        let bucket = buckets.entry(client).or_insert_with(|| TokenBucket::full(per_s, now));
        if bucket.take(1.0, per_s, now) {
            return Ok(());
        }
        let message = format!("one client may send {} {} per second; send fewer", self.per_s, self.what);
        Err(Error::refused(ErrorKind::RateLimited, message))
    }
}

/// The cost of bodies that are refused for their content: they are read and parsed in vain. Each client has some for
/// free; beyond, it waits before its next body is read.
pub struct RefusedBodies {
    bytes_per_s: f64,
    debts: Mutex<HashMap<ClientId, Debt>>,
}

/// Bytes of refused bodies, less what has been forgiven by the time.
#[derive(Debug, Clone, Copy)]
struct Debt {
    bytes: f64,
    at: Instant,
}

impl Debt {
    fn left(self, bytes_per_s: f64, now: Instant) -> f64 {
        (self.bytes - now.saturating_duration_since(self.at).as_secs_f64() * bytes_per_s).max(0.0)
    }
}

/// The free amount, in seconds of the rate: a wrong file or two.
const FREE_S: f64 = 16.0;
/// Longest wait, s.
const MAX_WAIT_S: f64 = 10.0;

impl RefusedBodies {
    /// Forgives `bytes_per_s` bytes per second; 0 charges nothing.
    #[must_use]
    pub fn new(bytes_per_s: u32) -> Self {
        Self { bytes_per_s: f64::from(bytes_per_s), debts: Mutex::default() }
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<ClientId, Debt>> {
        self.debts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A body of a client was refused.
    pub fn charge(&self, client: ClientId, bytes: u64, now: Instant) {
        if self.bytes_per_s == 0.0 || bytes == 0 {
            return;
        }
        let mut debts = self.lock();
        if debts.len() >= MOST_BUCKETS && !debts.contains_key(&client) {
            debts.retain(|_, debt| debt.left(self.bytes_per_s, now) > 0.0);
        }
        let left = debts.get(&client).map_or(0.0, |debt| debt.left(self.bytes_per_s, now));
        let most = (FREE_S + MAX_WAIT_S) * self.bytes_per_s;
        debts.insert(client, Debt { bytes: (left + bytes as f64).min(most), at: now });
    }

    /// How long a client waits until its next body is read; `None` for not at all.
    #[must_use]
    pub fn wait(&self, client: ClientId, now: Instant) -> Option<Duration> {
        let debt = *self.lock().get(&client)?;
        let beyond = debt.left(self.bytes_per_s, now) - FREE_S * self.bytes_per_s;
        (beyond > 0.0).then(|| Duration::from_secs_f64(beyond / self.bytes_per_s))
    }
}

#[cfg(test)]
mod tests {
    use std::net::IpAddr;

    use super::*;

    fn client(last: u8) -> ClientId {
        IpAddr::from([127, 0, 0, last]).into()
    }

    #[test]
    fn a_client_has_one_seconds_worth_of_requests() {
        let limit = RateLimit::new("requests", 3);
        let begin = Instant::now();
        let allowed = |client, now| (0..10).filter(|_| limit.count(client, now).is_ok()).count();
        assert_eq!(allowed(client(1), begin), 3);
        assert_eq!(allowed(client(2), begin), 3, "another client has its own");
        assert_eq!(allowed(client(1), begin + Duration::from_millis(340)), 1);
        assert_eq!(allowed(client(1), begin + 100 * REFILL_TIME), 3, "a longer pause adds nothing");
        let refused = limit.count(client(1), begin + 100 * REFILL_TIME).expect_err("the bucket is empty");
        assert_eq!(refused.kind(), ErrorKind::RateLimited);
        let unlimited = RateLimit::new("requests", 0);
        assert!((0..1_000).all(|_| unlimited.count(client(1), begin).is_ok()));
    }

    #[test]
    fn refused_bodies_make_their_sender_wait() {
        let bodies = RefusedBodies::new(1_000);
        let begin = Instant::now();
        bodies.charge(client(1), 16_000, begin);
        assert_eq!(bodies.wait(client(1), begin), None, "that much is free");
        bodies.charge(client(1), 2_000, begin);
        assert_eq!(bodies.wait(client(1), begin), Some(Duration::from_secs(2)));
        assert_eq!(bodies.wait(client(1), begin + Duration::from_secs(2)), None);
        assert_eq!(bodies.wait(client(2), begin), None, "another client");
        bodies.charge(client(1), u64::MAX, begin);
        assert_eq!(bodies.wait(client(1), begin), Some(Duration::from_secs_f64(MAX_WAIT_S)));
        let unlimited = RefusedBodies::new(0);
        unlimited.charge(client(1), u64::MAX, begin);
        assert_eq!(unlimited.wait(client(1), begin), None);
    }

    #[test]
    fn buckets_of_clients_that_are_gone_are_dropped() {
        let limit = RateLimit::new("requests", 1);
        let begin = Instant::now();
        for address in 0..3 * MOST_BUCKETS as u32 {
            let client = ClientId::from(IpAddr::from(address.to_be_bytes()));
            limit.count(client, begin + Duration::from_millis(address.into())).expect("its first");
        }
        assert!(limit.buckets.lock().expect("no panic").len() <= MOST_BUCKETS);
    }
}
