//! Positions as other systems take them: JSON, Cursor on Target, and ONVIF metadata.

use std::fmt::Write as _;

use jiff::{SignedDuration, Timestamp};
use serde::Serialize;

use super::wire::{PlaneCovariance, Position};
use crate::domain::{CameraId, ReceiverMatch, TargetId};
use crate::geo;

/// Where a target is, to be sent.
#[derive(Debug, Clone)]
pub struct OutgoingPosition<'a> {
    /// The same at every attempt to deliver it.
    pub message_id: &'a str,
    /// The camera that tracks the target.
    pub camera_id: &'a CameraId,
    /// The target.
    pub target_id: &'a TargetId,
    /// The receiver that the target carries, where it was found by association.
    pub receiver_match: Option<&'a ReceiverMatch>,
    /// The instant measured.
    pub time: Timestamp,
    /// Where it is.
    pub position: geo::Position,
    /// Covariance of the position's error, of a normal distribution.
    pub covariance: geo::PlaneCovariance,
    /// Radius that holds the true position with 95 % probability, m.
    pub r95_m: f64,
    /// Velocity towards east and north, m/s.
    pub velocity_m_s: [f64; 2],
}

/// The JSON object of a position.
#[derive(Serialize)]
struct PositionJson<'a> {
    id: &'a str,
    camera_id: &'a str,
    target_id: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    receiver_match: Option<ReceiverMatchJson<'a>>,
    time: Timestamp,
    position: Position,
    r95_m: f64,
    covariance: PlaneCovariance,
    velocity_east_m_s: f64,
    velocity_north_m_s: f64,
}

#[derive(Serialize)]
struct ReceiverMatchJson<'a> {
    receiver_id: &'a str,
    probability: f64,
}

/// A position as a JSON object.
#[must_use]
pub fn position_json(position: &OutgoingPosition<'_>) -> Vec<u8> {
    let [velocity_east_m_s, velocity_north_m_s] = position.velocity_m_s;
    let json = PositionJson {
        id: position.message_id,
        camera_id: position.camera_id.as_str(),
        target_id: position.target_id.as_str(),
        receiver_match: position.receiver_match.map(|own| ReceiverMatchJson {
            receiver_id: own.receiver_id.as_str(),
            probability: own.probability,
        }),
        time: position.time,
        position: position.position.into(),
        r95_m: position.r95_m,
        covariance: position.covariance.into(),
        velocity_east_m_s,
        velocity_north_m_s,
    };
    // Numbers, texts and a time can always be written.
    serde_json::to_vec(&json).unwrap_or_default()
}

/// Cursor on Target's number for what is not known.
const UNKNOWN: &str = "9999999.0";

/// A position as a Cursor on Target event (version 2.0, MITRE MTR090284), without a line break within.
///
/// The uid is the same for the life of a target. `ce` is one sigma of the horizontal error per axis, as the schema
/// defines it for measured positions; height and its error are not known. `how` is `m-f`: fused by a machine.
#[must_use]
pub fn cot_event(position: &OutgoingPosition<'_>, cot_type: &str, stale_s: f64) -> Vec<u8> {
    let time = position.time;
    let stale = SignedDuration::try_from_secs_f64(stale_s).ok().and_then(|it| time.checked_add(it).ok());
    let [east, north] = position.velocity_m_s;
    let course_deg = east.atan2(north).to_degrees().rem_euclid(360.0);
    let uid = escaped(&format!("sightfix.{}.{}", position.camera_id, position.target_id));
    let sigma_m = position.covariance.per_axis_m2().sqrt();
    let ce = if sigma_m.is_finite() { format!("{sigma_m:.2}") } else { UNKNOWN.to_owned() };
    let mut event = String::with_capacity(512);
    let _ = writeln!(
        event,
        "<event version=\"2.0\" uid=\"{uid}\" type=\"{cot_type}\" how=\"m-f\" time=\"{time:.3}\" \
         start=\"{time:.3}\" stale=\"{:.3}\"><point lat=\"{:.7}\" lon=\"{:.7}\" hae=\"{UNKNOWN}\" ce=\"{ce}\" \
         le=\"{UNKNOWN}\"/><detail><contact callsign=\"{}\"/><track course=\"{course_deg:.1}\" \
         speed=\"{:.2}\"/></detail></event>",
        stale.unwrap_or(time),
        position.position.latitude_deg(),
        position.position.longitude_deg(),
        escaped(position.target_id.as_str()),
        east.hypot(north),
    );
    event.into_bytes()
}

/// A position as a frame of an ONVIF metadata stream (`tt:MetadataStream`, Analytics Service Specification), without a line
/// break within: the object's `GeoLocation` and speed, without a shape.
///
/// The frame's `Source` is the camera. An `ObjectId` must be a whole number: the CRC-32 of the target's id, which is itself
/// an attribute beside it, as is the 95 % radius; the schema allows attributes of other namespaces.
#[must_use]
pub fn onvif_frame(position: &OutgoingPosition<'_>) -> Vec<u8> {
    let [east, north] = position.velocity_m_s;
    let mut frame = String::with_capacity(512);
    let _ = writeln!(
        frame,
        "<tt:MetadataStream xmlns:tt=\"http://www.onvif.org/ver10/schema\" xmlns:sf=\"urn:sightfix\"><tt:VideoAnalytics>\
         <tt:Frame UtcTime=\"{:.3}\" Source=\"{}\"><tt:Object ObjectId=\"{}\" sf:target_id=\"{}\" sf:r95_m=\"{:.2}\">\
         <tt:Appearance><tt:GeoLocation lon=\"{:.7}\" lat=\"{:.7}\"/></tt:Appearance>\
         <tt:Behaviour><tt:Speed>{:.2}</tt:Speed></tt:Behaviour>\
         </tt:Object></tt:Frame></tt:VideoAnalytics></tt:MetadataStream>",
        position.time,
        escaped(position.camera_id.as_str()),
        crc32fast::hash(position.target_id.as_str().as_bytes()),
        escaped(position.target_id.as_str()),
        position.r95_m,
        position.position.longitude_deg(),
        position.position.latitude_deg(),
        east.hypot(north),
    );
    frame.into_bytes()
}

/// Text of an XML attribute or element.
pub(super) fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            other => escaped.push(other),
        }
    }
    escaped
}
