//! Readers of stored events, which may be slow or come back.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::sync::watch;

use super::Places;
use crate::domain::{PlaceEventFilter, Result};
use crate::places::event::PlaceEvent;
use crate::places::settings::EventKind;
use crate::store::Store;

/// Events that are read at a time.
const PAGE: u32 = 256;
/// How often the events of other processes are looked for.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// An event with its number.
#[derive(Debug, Clone)]
pub struct StoredEvent {
    /// A reader continues after it.
    pub number: i64,
    pub event: PlaceEvent,
}

/// A reader of events, in the order in which they are stored.
pub struct PlaceEvents {
    store: Store,
    filter: PlaceEventFilter,
    after: i64,
    read: VecDeque<StoredEvent>,
    stored: watch::Receiver<u64>,
}

impl Places<'_> {
    /// Events after a number, or from now on. Whoever continues after the number of an event that was deleted by its age goes
    /// on with the oldest one.
    ///
    /// # Errors
    /// `PlaceNotFound` for a filter by a place that does not exist.
    pub async fn watch(&self, filter: PlaceEventFilter, after: Option<i64>) -> Result<PlaceEvents> {
        self.check_filter(&filter).await?;
        let stored = self.monitor.stored.subscribe();
        let after = match after {
            Some(after) => after,
            None => self.store.place_event_bounds().await?.0,
        };
        Ok(PlaceEvents { store: self.store.clone(), filter, after, read: VecDeque::new(), stored })
    }
}

impl PlaceEvents {
    /// The next event. Cancelling the wait loses nothing.
    ///
    /// # Errors
    /// The store cannot be read.
    pub async fn next(&mut self) -> Result<StoredEvent> {
        loop {
            if let Some(event) = self.read.pop_front() {
                return Ok(event);
            }
            self.stored.mark_unchanged();
            let page = self.store.place_events(&self.filter, self.after, PAGE).await?;
            if page.is_empty() {
                // Elapsed is no failure; the sender lives as long as the application.
                let _ = tokio::time::timeout(LOOK_EVERY, self.stored.changed()).await;
                continue;
            }
            let page = page.into_iter().map(StoredEvent::read).collect::<Result<VecDeque<_>>>()?;
            self.after = page.back().map_or(self.after, |last| last.number);
            self.read = page;
        }
    }
}

/// The kind of a filter by its name.
///
/// # Errors
/// `InvalidArgument` naming `kind`.
pub fn event_kind(name: &str) -> Result<&'static str> {
    name.parse::<EventKind>().map(EventKind::as_str)
}
