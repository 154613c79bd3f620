//! Messages of other systems, read one by one as they come: detections and fixes.
//!
//! A decoder is a value that may remember earlier messages, such as the first part of an AIS sentence. What it cannot
//! read is an error of that message alone. A new format is a file here and a line in [`decoder`].

mod ais;
mod deepstream;
mod frigate;
mod gpsd;
mod nmea;
mod onvif;
mod traccar;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::domain::{ReceivedFix, Score, TargetClass, TargetId, TimeBounds};

/// Format of a source's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum MessageFormat {
    /// Tracked objects of Frigate, of the topic `frigate/events`.
    Frigate,
    /// DeepStream's message schema, minimal or full.
    Deepstream,
    /// A metadata stream of ONVIF's analytics (XML).
    Onvif,
    /// NMEA 0183 sentences: GGA of a receiver, and AIS (AIVDM).
    Nmea,
    /// Reports of gpsd (JSON lines).
    Gpsd,
    /// Positions as Traccar forwards them (JSON).
    Traccar,
}

impl MessageFormat {
    /// Whether its messages contain fixes, not detections.
    #[must_use]
    pub const fn brings_fixes(self) -> bool {
        matches!(self, Self::Nmea | Self::Gpsd | Self::Traccar)
    }
}

/// When a message came, and which times it may have.
#[derive(Debug, Clone, Copy)]
pub struct MessageContext {
    /// Time of the server at which it came.
    pub received_at: Timestamp,
    /// The bounds of its times.
    pub time_bounds: TimeBounds,
}

/// A rectangle as the detector states it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DetectedBox {
    /// Left, top, right and bottom edge, px of the detector's stream.
    Pixels([f64; 4]),
    /// Left, top, right and bottom edge as fractions of the image, from its upper left corner.
    Fractions([f64; 4]),
}

/// A box of one target at one instant, of a camera by the name that the sender gives it.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedDetection {
    /// The sender's name of the camera; empty where its messages name none.
    pub camera: String,
    /// Time of the frame.
    pub time: Timestamp,
    /// The sender's id of the object: a tracker's number, unless the connection says that it names a target.
    pub target_id: TargetId,
    /// The rectangle.
    pub detected_box: DetectedBox,
    /// Class reported by the detector.
    pub class: Option<TargetClass>,
    /// Confidence score of the detector.
    pub score: Option<Score>,
}

/// What a message says.
#[derive(Debug, Clone, PartialEq)]
pub enum MessageItem {
    /// A target was seen.
    Detection(NamedDetection),
    /// A receiver's position. Without an id it is the connection's only receiver.
    Fix(ReceivedFix),
}

/// What was read from a message.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reading {
    /// In the order of the message.
    pub items: Vec<MessageItem>,
    /// Parts that contain nothing to take, each with the reason.
    pub skipped: Vec<String>,
}

impl Reading {
    fn skip(&mut self, reason: impl Into<String>) {
        // One message of a hostile sender must not fill the memory with reasons.
        if self.skipped.len() < 16 {
            self.skipped.push(reason.into());
        }
    }
}

/// Reads the messages of one sender.
pub trait MessageDecoder: Send {
    /// What a message says.
    ///
    /// # Errors
    /// Why it cannot be read.
    fn decode(&mut self, payload: &[u8], context: &MessageContext) -> Result<Reading, String>;
}

/// A decoder of messages of a format.
#[must_use]
pub fn decoder(format: MessageFormat) -> Box<dyn MessageDecoder> {
    match format {
        MessageFormat::Frigate => Box::new(frigate::Frigate),
        MessageFormat::Deepstream => Box::new(deepstream::DeepStream),
        MessageFormat::Onvif => Box::new(onvif::Onvif),
        MessageFormat::Nmea => Box::new(nmea::Nmea::default()),
        MessageFormat::Gpsd => Box::new(gpsd::Gpsd::default()),
        MessageFormat::Traccar => Box::new(traccar::Traccar),
    }
}

/// A JSON document of another program, which may have fields that are not known here.
fn parse<'a, T: Deserialize<'a>>(payload: &'a [u8]) -> Result<T, String> {
    serde_json::from_slice(payload).map_err(|error| format!("is not the JSON of this format: {error}"))
}

/// Seconds since 1970 as an instant.
fn unix_seconds(seconds: f64) -> Result<Timestamp, String> {
    // The cast saturates, and NaN becomes 0; neither is within the bounds of valid times.
    Timestamp::from_microsecond((seconds * 1e6).round() as i64)
        .map_err(|_| format!("{seconds} s since 1970 is not a time"))
}

/// A class by a detector's name of it; one that is not printable is left out.
fn class(name: &str) -> Option<TargetClass> {
    TargetClass::new(name).ok()
}

/// A score; one that is not from 0 to 1 is left out.
fn score(value: Option<f64>) -> Option<Score> {
    Score::new(value?).ok()
}
