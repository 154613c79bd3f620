//! Events of places.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use utoipa::ToSchema;

use crate::settings::EventKind;

/// The direction in which a target crosses a line, as one looks along the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// From its left to its right: the direction that is allowed.
    LeftToRight,
    /// From its right to its left.
    RightToLeft,
}

impl Direction {
    /// Name in wire formats.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::LeftToRight => "left_to_right",
            Self::RightToLeft => "right_to_left",
        }
    }
}

/// Something that a rule of a place reports.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PlaceEvent {
    /// The same whenever the same tracks are evaluated: a repetition has the id of the first.
    #[schema(example = "5f1d9a3c7e204b86a1f7c2d8e93b4a60")]
    pub id: String,
    /// The kind of event.
    pub kind: EventKind,
    /// The place.
    pub place_id: String,
    /// The rule of the place.
    pub rule_id: String,
    /// The site whose world tracks were evaluated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub site_id: Option<String>,
    /// The camera whose tracks were evaluated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_id: Option<String>,
    /// When it happened, by the clock of the cameras.
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    /// Standard deviation of the time, s.
    pub time_sigma_s: f64,
    /// Probability that it happened.
    pub probability: f64,
    /// The track: the target of a camera, or the world track of a site.
    pub track_id: String,
    /// The target, if it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target_id: Option<String>,
    /// The class of the target, if the detector states one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// Longitude of the target's position when it was reported, degrees.
    pub longitude_deg: f64,
    /// Latitude of the target's position when it was reported, degrees.
    pub latitude_deg: f64,
    /// Speed, m/s.
    pub speed_mps: f64,
    /// Standard deviation of the speed, m/s.
    pub speed_sigma_mps: f64,
    /// The direction of a crossing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub direction: Option<Direction>,
    /// How long the target was in the area, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dwell_s: Option<f64>,
    /// The track that is near.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub other_track_id: Option<String>,
    /// Distance from it, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance_m: Option<f64>,
    /// Standard deviation of the distance, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance_sigma_m: Option<f64>,
}

/// The id of an event: a hash of what identifies it, hexadecimal.
pub(crate) fn event_id(parts: &[&str], time: Timestamp) -> String {
    let mut hash = Sha256::new();
    for part in parts {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    }
    hash.update(time.as_microsecond().to_le_bytes());
    hash.finalize()[..16].iter().map(|byte| format!("{byte:02x}")).collect()
}
