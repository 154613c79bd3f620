//! Places: what the operator defines, the events and counts of tracks there.

mod events;
mod monitor;
mod scopes;
mod statistics;

use super::live::{Live, WorldTracks};
use super::{App, Page, page_of};
use crate::clock::Clock;
use crate::domain::{
    Error, ExpectedVersion, NewPlace, Place, PlaceEventFilter, PlaceId, PlaceKey, Result, StoredPlaceEvent,
    TrackScope,
};
use crate::places::settings::PlaceSettings;
use crate::store::Store;

pub use events::{PlaceEvents, StoredEvent, event_kind};
pub use monitor::PlaceMonitor;
pub use statistics::{PlaceStatistics, StatisticsInterval, StatisticsRequest, StatisticsStep};

/// The use cases of places.
#[derive(Clone, Copy)]
pub struct Places<'a> {
    store: &'a Store,
    monitor: &'a PlaceMonitor,
    clock: &'a Clock,
    live: Live<'a>,
    world_tracks: WorldTracks<'a>,
}

impl App {
    /// The use cases of places.
    #[must_use]
    pub fn places(&self) -> Places<'_> {
        Places {
            store: &self.store,
            monitor: &self.place_monitor,
            clock: &self.clock,
            live: self.live(),
            world_tracks: self.world_tracks(),
        }
    }
}

impl Places<'_> {
    /// Stores a new place.
    ///
    /// # Errors
    /// `PlaceExists`; `InvalidArgument` naming the field; `InsufficientStorage` beyond the limit of places.
    pub async fn create(&self, id: PlaceId, scope: TrackScope, settings: &PlaceSettings) -> Result<Place> {
        let profile = NewPlace { id, scope, settings: stored_settings(settings)? };
        self.store.insert_place(&profile, self.clock.now()).await
    }

    /// One place.
    ///
    /// # Errors
    /// `PlaceNotFound`.
    pub async fn get(&self, id: &PlaceId) -> Result<Place> {
        self.store.place(id).await
    }

    /// Places by id, of a scope or of all, after a cursor.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn list(
        &self,
        scope: Option<&TrackScope>,
        after: Option<&PlaceId>,
        limit: u32,
    ) -> Result<Page<Place, PlaceId>> {
        let places = self.store.places(scope, after, limit + 1).await?;
        Ok(page_of(places, limit, |place| place.id().clone()))
    }

    /// Replaces the settings of a place, which were made of a revision of it.
    ///
    /// # Errors
    /// `PlaceNotFound`, `RevisionMismatch`, `InvalidArgument` naming the field.
    pub async fn change(
        &self,
        place: &Place,
        settings: &PlaceSettings,
        expected: Option<ExpectedVersion<PlaceKey>>,
    ) -> Result<Place> {
        let profile = NewPlace { settings: stored_settings(settings)?, ..place.profile.clone() };
        // As for sites: what was read is changed from the revision that was read.
        let expected = expected.unwrap_or(place.version());
        self.store.replace_place(&profile, Some(expected), self.clock.now()).await
    }

    /// Deletes a place with its events and counts.
    ///
    /// # Errors
    /// `PlaceNotFound`, `RevisionMismatch`.
    pub async fn delete(&self, id: &PlaceId, expected: Option<ExpectedVersion<PlaceKey>>) -> Result<()> {
        self.store.delete_place(id, expected, self.clock.now()).await
    }

    /// Events in the order in which they were stored, after a number.
    ///
    /// # Errors
    /// `PlaceNotFound` for a filter by a place that does not exist.
    pub async fn events(
        &self,
        filter: &PlaceEventFilter,
        after: Option<i64>,
        limit: u32,
    ) -> Result<Page<StoredEvent, i64>> {
        self.check_filter(filter).await?;
        let events = self.store.place_events(filter, after.unwrap_or_default(), limit + 1).await?;
        let events = events.into_iter().map(StoredEvent::read).collect::<Result<Vec<_>>>()?;
        Ok(page_of(events, limit, |event| event.number))
    }

    async fn check_filter(&self, filter: &PlaceEventFilter) -> Result<()> {
        match &filter.place {
            Some(id) => self.store.place(id).await.map(drop),
            None => Ok(()),
        }
    }
}

/// Checked settings as they are stored.
fn stored_settings(settings: &PlaceSettings) -> Result<String> {
    crate::places::Place::check(settings)?;
    serde_json::to_string(settings).map_err(Error::fault)
}

/// The settings of a stored place.
///
/// # Errors
/// A fault for settings that this version does not write.
pub fn place_settings(place: &Place) -> Result<PlaceSettings> {
    serde_json::from_str(&place.profile.settings).map_err(Error::fault)
}

impl StoredEvent {
    fn read(stored: StoredPlaceEvent) -> Result<Self> {
        let event = serde_json::from_str(&stored.content).map_err(Error::fault)?;
        Ok(Self { number: stored.number, event })
    }
}
