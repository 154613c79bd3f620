//! Rounds of matching of a site's receivers with its tracks, on a thread beside the site's task.

use std::time::Duration;

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use tokio::sync::OwnedSemaphorePermit;
use tokio::task::JoinHandle;

use super::tracker::SiteTracker;
use crate::app::live::identification::MatchingSlot;
use crate::app::live::matching::{MAX_LOAD, MIN_PERIOD, SEED};
use crate::clock::Clock;
use crate::domain::Result;
use crate::fusion::association::{Cancellation, MatchedReceivers};

/// The rounds of one site.
pub(super) struct Rounds {
    slot: MatchingSlot,
    clock: Clock,
    running: Option<JoinHandle<Finding>>,
    /// Earliest start of the next round, by the monotonic clock.
    next_at: Duration,
}

struct Finding {
    number_offset: u64,
    found: Result<MatchedReceivers>,
    next_at: Duration,
    _slot: OwnedSemaphorePermit,
}

impl Rounds {
    pub(super) const fn new(slot: MatchingSlot, clock: Clock) -> Self {
        Self { slot, clock, running: None, next_at: Duration::ZERO }
    }

    /// Takes the findings of a round that has ended over, and begins the next one if it is time for it.
    pub(super) async fn advance(&mut self, tracker: &mut SiteTracker, now: Duration) {
        if let Some(ended) = self.running.take_if(|running| running.is_finished()) {
            match ended.await {
                Ok(Finding { number_offset, found: Ok(found), next_at, .. }) => {
                    self.next_at = next_at;
                    tracker.accept(number_offset, found);
                }
                Ok(Finding { found: Err(error), next_at, .. }) => {
                    self.next_at = next_at;
                    tracing::warn!(%error, "world tracks cannot be matched with receivers");
                }
                Err(error) => {
                    self.next_at = now + MIN_PERIOD;
                    tracing::warn!(%error, "a round of matching has ended early");
                }
            }
        }
        if self.running.is_none() && now >= self.next_at {
            self.begin(tracker);
        }
    }

    fn begin(&mut self, tracker: &SiteTracker) {
        let Some(slot) = self.slot.take() else { return };
        let Some((number_offset, window)) = tracker.window() else { return };
        let clock = self.clock.clone();
        self.running = Some(tokio::task::spawn_blocking(move || {
            let begun = clock.monotonic();
            let found = window.matched(&mut ChaCha8Rng::seed_from_u64(SEED), Cancellation::NEVER);
            let taken = clock.monotonic().saturating_sub(begun);
            let next_at = begun + MIN_PERIOD.max(taken.div_f64(MAX_LOAD));
            Finding { number_offset, found, next_at, _slot: slot }
        }));
    }
}
