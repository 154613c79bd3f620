//! Positions of finished tracks, and how a camera or a site keeps them.

use jiff::{SignedDuration, Timestamp};

use super::error::{Error, Result};
use super::motion::{Acceleration, Motion};
use super::names::{TargetClass, TargetId};
use crate::geo::{PlaneCovariance, Position};

/// Time without a measurement after which a track counts as another one.
pub const TRACK_GAP: SignedDuration = SignedDuration::from_secs(60);

/// How long and how exactly finished tracks are kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HistorySettings {
    keep_days: u32,
    max_bytes: u64,
    coarsen_m: f64,
}

impl HistorySettings {
    /// Days that positions are kept if the operator states none.
    pub const KEEP_DAYS: u32 = 30;
    /// Size of the files in bytes if the operator states none.
    pub const MAX_BYTES: u64 = 1 << 30;

    /// Positions older than `keep_days` (1 to 3,650) are deleted, then the oldest ones beyond `max_bytes` (1 MB to
    /// 1 PB) of files. `coarsen_m` is the mesh of the grid that positions are moved to, up to 10,000 m; 0 keeps them.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn new(keep_days: u32, max_bytes: u64, coarsen_m: f64) -> Result<Self> {
        if !(1..=3_650).contains(&keep_days) {
            return Err(Error::invalid("keep_days", "must be 1 to 3650"));
        }
        if !(1_000_000..=1_000_000_000_000_000).contains(&max_bytes) {
            return Err(Error::invalid("max_bytes", "must be 1000000 to 1000000000000000"));
        }
        if !(0.0..=10_000.0).contains(&coarsen_m) {
            return Err(Error::invalid("coarsen_m", "must be a number from 0 to 10000"));
        }
        Ok(Self { keep_days, max_bytes, coarsen_m })
    }

    /// Days that positions are kept.
    #[must_use]
    pub const fn keep_days(&self) -> u32 {
        self.keep_days
    }

    /// Size that the files may have, bytes.
    #[must_use]
    pub const fn max_bytes(&self) -> u64 {
        self.max_bytes
    }

    /// Mesh of the grid that positions are moved to, m; 0 keeps them as they are.
    #[must_use]
    pub const fn coarsen_m(&self) -> f64 {
        self.coarsen_m
    }
}

/// A position of a finished track.
#[derive(Debug, Clone, PartialEq)]
pub struct ArchivedPosition {
    /// The instant.
    pub time: Timestamp,
    /// The track: unique within its scope.
    pub track: String,
    /// The target, if it is known: in a camera as the camera names it, in a site the carrier of a receiver.
    pub target: Option<TargetId>,
    /// Class reported by a detector.
    pub class: Option<TargetClass>,
    /// The target's position.
    pub position: Position,
    /// Covariance of the position's error towards east and north, m2.
    pub covariance_m2: PlaneCovariance,
    /// Speed and course with their intervals.
    pub motion: Motion,
    /// Mean acceleration over the second before; `None` at the first position of a track.
    pub acceleration: Option<Acceleration>,
}

impl ArchivedPosition {
    /// Its place among those of its scope, and its identity.
    #[must_use]
    pub fn key(&self) -> (Timestamp, &str) {
        (self.time, &self.track)
    }
}

/// The place of a position among those of its scope, after which a page begins.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct HistoryKey {
    /// The instant.
    pub time: Timestamp,
    /// The track.
    pub track: String,
}

impl From<&ArchivedPosition> for HistoryKey {
    fn from(row: &ArchivedPosition) -> Self {
        Self { time: row.time, track: row.track.clone() }
    }
}
