//! Positions as Home Assistant takes them from MQTT: attributes of device trackers, which their configurations announce
//! (the discovery of its MQTT integration, `device_tracker`).

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::fix_quality::radius_68_m;
use super::outgoing::OutgoingPosition;

/// Where Home Assistant looks for configurations unless it is told otherwise.
const DISCOVERY_PREFIX: &str = "homeassistant";

/// The attributes of a device tracker.
#[derive(Serialize, Deserialize)]
struct Attributes<'a> {
    latitude: f64,
    longitude: f64,
    /// Radius that contains the true position in 68 of 100 cases, m, as phones state it.
    gps_accuracy: f64,
    r95_m: f64,
    time: jiff::Timestamp,
    camera_id: &'a str,
    #[serde(borrow)]
    target_id: std::borrow::Cow<'a, str>,
}

/// A position as attributes of a device tracker: a JSON object with `latitude`, `longitude` (degrees) and `gps_accuracy` (m).
#[must_use]
pub fn home_assistant_attributes(position: &OutgoingPosition<'_>) -> Vec<u8> {
    let attributes = Attributes {
        latitude: position.position.latitude_deg(),
        longitude: position.position.longitude_deg(),
        gps_accuracy: radius_68_m(position.covariance.per_axis_m2()),
        r95_m: position.r95_m,
        time: position.time,
        camera_id: position.camera_id.as_str(),
        target_id: position.target_id.as_str().into(),
    };
    // Numbers, texts and a time can always be written.
    serde_json::to_vec(&attributes).unwrap_or_default()
}

/// The configuration that announces a device tracker: its topic, and a JSON object.
///
/// `topic` is that of the attributes, `availability_topic` has `online` or `offline`, and `version` is that of the sender.
/// `None` for attributes that are not those of [`home_assistant_attributes`].
#[must_use]
pub fn home_assistant_discovery(
    topic: &str,
    attributes: &[u8],
    availability_topic: &str,
    version: &str,
) -> Option<(String, Vec<u8>)> {
    let Attributes { target_id, .. } = serde_json::from_slice(attributes).ok()?;
    let level = |it: char| if it.is_ascii_alphanumeric() || it == '-' { it } else { '_' };
    let object_id: String = topic.chars().map(level).collect();
    let configuration = json!({
        "name": target_id,
        "unique_id": topic,
        "source_type": "gps",
        "json_attributes_topic": topic,
        "availability_topic": availability_topic,
        "origin": {"name": "sightfix", "sw_version": version},
    });
    let config_topic = format!("{DISCOVERY_PREFIX}/device_tracker/{object_id}/config");
    Some((config_topic, configuration.to_string().into_bytes()))
}
