//! Readers of a site's events, which may be slow or come back.

use std::sync::Arc;

use super::events::SiteEvent;
use super::state::SiteLive;
use crate::app::cluster::Watch;
use crate::app::live::event_log::{EventReader, NextEvent};
use crate::domain::LiveId;
use crate::telemetry::Metrics;

/// An event with its id.
#[derive(Debug, Clone)]
pub struct StoredSiteEvent {
    /// A reader continues after it.
    pub id: LiveId,
    pub event: Arc<SiteEvent>,
}

/// Events that a reader did not get.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LostSiteEvents {
    /// The last of them; a reader continues after it.
    pub id: LiveId,
    /// Number of lost events; `None` where nobody knows.
    pub events: Option<u64>,
    pub reason: LossReason,
}

/// Why a reader did not get events.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LossReason {
    /// The event that it wanted to continue after is not kept any more.
    TooOld,
    /// The event that it wanted to continue after is of before the start of the server.
    Restarted,
    /// It reads too slowly.
    TooSlow,
}

impl LossReason {
    /// Name in wire formats.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::TooOld => "too_old",
            Self::Restarted => "restarted",
            Self::TooSlow => "too_slow",
        }
    }
}

/// A reader of the events of one site; they end when the site is deleted, or another node has become the owner of its
/// cameras.
pub struct SiteEvents {
    live: Arc<SiteLive>,
    reader: EventReader<SiteEvent>,
    /// The loss to tell of first.
    restarted: Option<LostSiteEvents>,
    /// Why events are missing, if they are: a reader that has read one is too slow for the next.
    reason: LossReason,
    metrics: Metrics,
    watch: Watch,
}

impl SiteEvents {
    pub(super) fn new(live: Arc<SiteLive>, after: Option<LiveId>, watch: Watch, metrics: Metrics) -> Self {
        let is_other_epoch = after.is_some_and(|after| after.epoch != live.epoch);
        let number = match after {
            Some(after) if !is_other_epoch => after.number,
            // All that this epoch has is new to such a reader.
            Some(_) => 0,
            None => live.events.latest(),
        };
        let restarted = is_other_epoch.then(|| LostSiteEvents {
            id: live.id_of(0),
            events: None,
            reason: LossReason::Restarted,
        });
        let reason = if after.is_some() { LossReason::TooOld } else { LossReason::TooSlow };
        Self { reader: live.events.reader(number), live, restarted, reason, metrics, watch }
    }

    /// True if they have ended since they continue on another node: the reader should ask again.
    #[must_use]
    pub fn continue_elsewhere(&self) -> bool {
        self.watch.has_ended()
    }

    /// The next event, or what was lost before it; `None` once the site is deleted or goes on elsewhere. Cancelling the wait loses
    /// nothing.
    pub async fn next(&mut self) -> Option<Result<StoredSiteEvent, LostSiteEvents>> {
        if let Some(lost) = self.restarted.take() {
            return Some(Err(lost));
        }
        let next = tokio::select! {
            biased;
            () = self.live.ended.cancelled() => return None,
            () = self.watch.ended() => return None,
            next = self.reader.next() => next,
        };
        Some(match next {
            NextEvent::Event(number, event) => {
                self.reason = LossReason::TooSlow;
                Ok(StoredSiteEvent { id: self.live.id_of(number), event })
            }
            NextEvent::Lost(events, last) => {
                if self.reason == LossReason::TooSlow {
                    self.metrics.site_events_lost(events);
                }
                Err(LostSiteEvents { id: self.live.id_of(last), events: Some(events), reason: self.reason })
            }
        })
    }
}
