//! Sites: cameras whose targets are tracked together.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::camera::{ExpectedVersion, Revision};
use super::error::Result;
use super::history::HistorySettings;
use super::names::{SiteId, check_labels, check_text};
use crate::geo::Position;

/// A site as the operator defines it. Which cameras belong to it is stated by their profiles.
#[derive(Debug, Clone, PartialEq)]
pub struct NewSite {
    /// The slug chosen by the operator.
    pub id: SiteId,
    /// Display name.
    pub display_name: String,
    /// Free-form labels.
    pub labels: BTreeMap<String, String>,
    /// Origin of the plane in which targets are tracked; `None` for that of the first camera's model.
    pub origin: Option<Position>,
    /// How finished world tracks are kept; `None` keeps none.
    pub history: Option<HistorySettings>,
}

impl NewSite {
    /// A site with an id and defaults.
    #[must_use]
    pub fn named(id: SiteId) -> Self {
        Self {
            display_name: id.as_str().to_owned(),
            id,
            labels: BTreeMap::new(),
            origin: None,
            history: None,
        }
    }

    /// # Errors
    /// Names the field that is too long or not printable.
    pub fn check(self) -> Result<Self> {
        check_text("display_name", &self.display_name, 200)?;
        check_labels(&self.labels)?;
        Ok(self)
    }
}

/// A partial update of a site; `None` keeps a field.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SiteChange {
    /// New name.
    pub display_name: Option<String>,
    /// New labels; they replace all.
    pub labels: Option<BTreeMap<String, String>>,
    /// New origin; `Some(None)` removes it.
    pub origin: Option<Option<Position>>,
    /// New settings of the history; `Some(None)` keeps no more tracks.
    pub history: Option<Option<HistorySettings>>,
}

impl SiteChange {
    /// Names of the fields that can be changed, on both transports.
    pub const FIELDS: [&str; 4] = ["display_name", "labels", "origin", "history"];

    /// The fields of a profile that are named, by [`Self::FIELDS`].
    #[must_use]
    pub fn of_fields(profile: NewSite, is_named: impl Fn(&str) -> bool) -> Self {
        Self {
            display_name: is_named("display_name").then_some(profile.display_name),
            labels: is_named("labels").then_some(profile.labels),
            origin: is_named("origin").then_some(profile.origin),
            history: is_named("history").then_some(profile.history),
        }
    }

    /// The site after the change.
    ///
    /// # Errors
    /// As [`NewSite::check`].
    pub fn apply(self, profile: NewSite) -> Result<NewSite> {
        NewSite {
            id: profile.id,
            display_name: self.display_name.unwrap_or(profile.display_name),
            labels: self.labels.unwrap_or(profile.labels),
            origin: self.origin.unwrap_or(profile.origin),
            history: self.history.unwrap_or(profile.history),
        }
        .check()
    }
}

/// Identifies a stored site for good: a site that is deleted and created again under the same id has another
/// key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SiteKey(pub i64);

impl From<i64> for SiteKey {
    fn from(key: i64) -> Self {
        Self(key)
    }
}

impl From<SiteKey> for i64 {
    fn from(key: SiteKey) -> Self {
        key.0
    }
}

/// A stored site.
#[derive(Debug, Clone, PartialEq)]
pub struct Site {
    /// Identity of this site among all that had its id.
    pub key: SiteKey,
    /// The settings that the operator defined.
    pub profile: NewSite,
    /// Revision of the profile.
    pub revision: Revision,
    /// Time of creation.
    pub created_at: Timestamp,
    /// Time of the latest change of the profile.
    pub updated_at: Timestamp,
    /// Number of cameras whose profile names the site.
    pub cameras: u32,
}

impl Site {
    /// Returns the version that a change of this site is based on.
    #[must_use]
    pub const fn version(&self) -> ExpectedVersion<SiteKey> {
        ExpectedVersion { key: Some(self.key), revision: self.revision }
    }

    /// The site's id.
    #[must_use]
    pub const fn id(&self) -> &SiteId {
        &self.profile.id
    }
}
