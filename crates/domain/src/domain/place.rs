//! Places on the ground, as they are stored. The geometry and the rules in their settings belong to the crate `places`.

use jiff::Timestamp;

use super::camera::{ExpectedVersion, Revision};
use super::connection::{ConnectionKey, OutboxMessage};
use super::names::PlaceId;
use super::track_scope::TrackScope;

/// A place as the operator defines it.
#[derive(Debug, Clone, PartialEq)]
pub struct NewPlace {
    /// The slug chosen by the operator.
    pub id: PlaceId,
    /// Whose tracks it watches.
    pub scope: TrackScope,
    /// Name, geometry and rules as a JSON object.
    pub settings: String,
}

/// Identifies a stored place for good: a place that is deleted and created again under the same id has another key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PlaceKey(pub i64);

impl From<i64> for PlaceKey {
    fn from(key: i64) -> Self {
        Self(key)
    }
}

impl From<PlaceKey> for i64 {
    fn from(key: PlaceKey) -> Self {
        key.0
    }
}

/// A stored place.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// Identity of this place among all that had its id.
    pub key: PlaceKey,
    /// The settings that the operator defined.
    pub profile: NewPlace,
    /// Revision of the profile.
    pub revision: Revision,
    /// Time of creation.
    pub created_at: Timestamp,
    /// Time of the latest change of the profile.
    pub updated_at: Timestamp,
}

impl Place {
    /// Returns the version that a change of this place is based on.
    #[must_use]
    pub const fn version(&self) -> ExpectedVersion<PlaceKey> {
        ExpectedVersion { key: Some(self.key), revision: self.revision }
    }

    /// The place's id.
    #[must_use]
    pub const fn id(&self) -> &PlaceId {
        &self.profile.id
    }
}

/// An event of a place, to be stored.
#[derive(Debug, Clone, PartialEq)]
pub struct NewPlaceEvent {
    /// The place.
    pub place: PlaceKey,
    /// The same for an event that is found again.
    pub id: String,
    /// Name of its kind.
    pub kind: &'static str,
    /// The event as a JSON object.
    pub content: String,
    /// The messages that sinks are to have of it.
    pub messages: Vec<(ConnectionKey, OutboxMessage)>,
}

/// An event of a place with its number, which rises in the order of commits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredPlaceEvent {
    /// The number.
    pub number: i64,
    /// The event as a JSON object.
    pub content: String,
}

/// What became of events that were to be stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StoredPlaceEvents {
    /// Events that are new.
    pub stored: u64,
    /// The oldest messages of sinks, which were deleted for the limit of their outboxes.
    pub dropped: u64,
}

/// Which events of places are asked for; `None` is all.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PlaceEventFilter {
    /// Only events of places of this scope.
    pub scope: Option<TrackScope>,
    /// Only events of this place.
    pub place: Option<PlaceId>,
    /// Only events of this kind.
    pub kind: Option<&'static str>,
}

/// One figure of a place in an interval.
#[derive(Debug, Clone, PartialEq)]
pub struct PlaceCount {
    /// The place.
    pub place: PlaceKey,
    /// Beginning of the interval, s since 1970; of a minute where counts are added.
    pub from_s: i64,
    /// The class of the targets, empty if unknown.
    pub class: String,
    /// The figure, such as `enters.count`.
    pub figure: String,
    /// Its value, which is added to the stored one.
    pub value: f64,
}
