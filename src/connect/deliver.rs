//! From the outbox to the receiver.

use std::convert::Infallible;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use super::credentials::PeerError;
use super::kinds;
use super::sink::Outcomes;
use crate::app::{App, ConnectionLease, ConnectionState, LastMessage, LiveConnection};
use crate::domain::{ConnectionId, ConnectionKey, OutboxMessage};
use crate::exchange::{Secrets, SinkSettings};

/// Messages that are read from the outbox at a time.
const BATCH: u32 = 256;
/// The outbox is looked at this often without a notice: other nodes fill it, and dead letters may have been put back.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// The publisher of the same process begins beside the delivery.
const PUBLISHER_WAIT: Duration = Duration::from_secs(1);

/// The results of an attempt that the next one needs.
#[derive(Default)]
pub(super) struct Attempt {
    /// True once a message was taken or delivered.
    pub(super) progressed: AtomicBool,
    /// The pause that the peer asks for.
    pub(super) retry_after: OnceLock<Duration>,
}

/// Delivers the outbox of one sink.
pub(super) struct Delivery<'a> {
    pub(super) app: &'a App,
    pub(super) id: &'a ConnectionId,
    pub(super) key: ConnectionKey,
    pub(super) settings: &'a SinkSettings,
    pub(super) secrets: &'a Secrets,
    pub(super) client_id: &'a str,
    pub(super) live: &'a Arc<LiveConnection>,
    pub(super) lease: &'a ConnectionLease,
}

impl Delivery<'_> {
    /// Opens the sink and delivers until it fails.
    pub(super) async fn run(&self, attempt: &Attempt) -> Result<Infallible, PeerError> {
        let clock = &self.app.clock;
        let mut sink =
            kinds::sink(self.app, self.id, self.settings, self.secrets, (self.client_id, true)).await?;
        // A sink that is seen running misses no position of this process's cameras.
        let _ = tokio::time::timeout(PUBLISHER_WAIT, self.live.publishing.wait()).await;
        self.live.enter(ConnectionState::Running, clock.now());
        self.live.update(|status| status.connects += 1);
        loop {
            let messages = self.app.store.outbox(self.key, BATCH).await?;
            if messages.is_empty() {
                tokio::select! {
                    // Elapsed is no failure.
                    _ = tokio::time::timeout(LOOK_EVERY, self.live.queued.notified()) => continue,
                    error = sink.failed() => return Err(error),
                }
            }
            // A process that was stopped delivers nothing that the next owner has delivered since.
            if !self.lease.is_valid(clock.monotonic()) {
                return std::future::pending().await;
            }
            let mut outcomes = Outcomes::new();
            let delivered = sink.deliver(&messages, &mut outcomes).await;
            if !outcomes.is_empty() {
                self.app.store.settle_outbox(self.key, &outcomes).await?;
                self.report(&messages, &outcomes);
                attempt.progressed.store(true, Ordering::Relaxed);
            }
            if let (Err(_), Some(pause)) = (&delivered, sink.retry_after()) {
                // The only one to set it, before this attempt ends.
                let _ = attempt.retry_after.set(pause);
            }
            delivered?;
        }
    }

    fn report(&self, messages: &[OutboxMessage], outcomes: &Outcomes) {
        let now = self.app.clock.now();
        let refused = outcomes.iter().filter_map(|(_, outcome)| outcome.as_ref().err());
        let last = outcomes.last().and_then(|(number, outcome)| {
            let message = messages.iter().find(|message| message.number == *number)?;
            let reading = outcome.as_ref().map_or_else(Clone::clone, |()| "delivered".to_owned());
            Some(LastMessage::new(now, message.subject.clone(), &message.payload, vec![reading]))
        });
        self.live.update(|status| {
            let refusals = refused.clone().count() as u64;
            status.messages += outcomes.len() as u64 - refusals;
            status.rejected += refusals;
            if let Some(reason) = refused.clone().next_back() {
                status.last_error = Some((now, reason.clone()));
            }
            status.last_message = last;
        });
    }
}
