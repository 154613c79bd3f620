//! Messages of other systems, read one by one as they come: detections and fixes.
//!
//! A decoder is a value that may remember earlier messages, such as the first part of an AIS sentence. What it cannot
//! read is an error of that message alone. A new format is a file here, a variant of
//! [`MessageFormat`] and a line in [`decoder`].

mod adsb;
mod ais;
mod ais_report;
mod cot;
mod deepstream;
mod frigate;
mod gpsd;
mod mapped;
mod nmea;
mod onvif;
mod phone;
mod tagged;
mod traccar;

use std::net::SocketAddr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::domain::{Fix, ReceivedFix, ReceiverId, Score, SigmaM, TargetClass, TargetId, TimeBounds};
use crate::wire;

pub use mapped::{BoxMapping, JsonMapping};

/// Format of a source's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum MessageFormat {
    /// Tracked objects of Frigate, of the topic `frigate/events`.
    Frigate,
    /// DeepStream's message schema, minimal or full.
    Deepstream,
    /// Metadata of ONVIF's analytics: XML, or the JSON of MQTT topics `onvif-mj`.
    Onvif,
    /// NMEA 0183 sentences: GGA of a receiver, and AIS (AIVDM).
    Nmea,
    /// Reports of gpsd (JSON lines).
    Gpsd,
    /// Positions as Traccar forwards them (JSON).
    Traccar,
    /// Positions of a phone's application: OwnTracks, Traccar Client, Overland, GPSLogger, Sensor Logger, Home Assistant.
    Phone,
    /// Positions of aircraft: lines of a BaseStation port, or JSON of dump1090 and readsb.
    Adsb,
    /// Cursor on Target events of TAK's applications (XML).
    Cot,
    /// JSON of any program, by the source's `mapping`.
    Json,
}

impl MessageFormat {
    /// True if its messages contain fixes, not detections; those of `json` contain what their mapping says.
    #[must_use]
    pub const fn brings_fixes(self) -> bool {
        match self {
            Self::Frigate | Self::Deepstream | Self::Onvif | Self::Json => false,
            Self::Nmea | Self::Gpsd | Self::Traccar | Self::Phone | Self::Adsb | Self::Cot => true,
        }
    }

    /// The JSON document that the sender of a message expects as the answer to its request; most expect none.
    #[must_use]
    pub fn answer(self, payload: &[u8]) -> Option<&'static str> {
        match self {
            Self::Phone => phone::answer(payload),
            _ => None,
        }
    }
}

/// When and whence a message came, and which times it may have.
#[derive(Debug, Clone, Copy)]
pub struct MessageContext<'a> {
    /// Its topic, the address of its sender, or the name of the key that handed it in.
    pub subject: &'a str,
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

/// An item of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum MessageItem {
    /// A target was seen.
    Detection(NamedDetection),
    /// A receiver's position. Without an id it is the connection's only receiver.
    Fix(ReceivedFix),
}

/// The result of decoding a message.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reading {
    /// In the order of the message.
    pub items: Vec<MessageItem>,
    /// Parts that contain nothing to take, each with the reason.
    pub skipped: Vec<String>,
}

impl Reading {
    /// Takes an item, or the reason why it cannot be taken.
    fn take(&mut self, item: Result<MessageItem, String>) {
        match item {
            Ok(item) => self.items.push(item),
            Err(reason) => self.skip(reason),
        }
    }

    pub(super) fn skip(&mut self, reason: impl Into<String>) {
        // One message of a hostile sender must not fill the memory with reasons.
        if self.skipped.len() < 16 {
            self.skipped.push(reason.into());
        }
    }
}

/// A position as its receiver reports it, not yet checked.
struct ReportedFix<'a> {
    time: Timestamp,
    /// The receiver, where the message names it.
    receiver: Option<&'a str>,
    longitude_deg: f64,
    latitude_deg: f64,
    sigma: Option<SigmaM>,
}

impl ReportedFix<'_> {
    fn checked(self, context: &MessageContext<'_>) -> Result<ReceivedFix, String> {
        let Self { time, receiver, longitude_deg, latitude_deg, sigma } = self;
        let checked = || -> crate::domain::Result<ReceivedFix> {
            Ok(ReceivedFix {
                time: context.time_bounds.check(time)?,
                receiver_id: receiver.map(ReceiverId::new).transpose()?,
                fix: Fix {
                    position: wire::Position { longitude_deg, latitude_deg }.to_domain()?,
                    sigma_m: sigma,
                },
            })
        };
        checked().map_err(|error| error.to_string())
    }
}

/// Reads the messages of one sender.
pub trait MessageDecoder: Send {
    /// Decodes a message.
    ///
    /// # Errors
    /// Why it cannot be read.
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String>;
}

/// A decoder of JSON by a mapping.
pub(super) fn mapped_decoder(mapping: JsonMapping) -> Box<dyn MessageDecoder> {
    Box::new(mapped::Mapped(mapping))
}

/// A decoder of NMEA sentences that tells receivers apart by their talkers.
pub(super) fn talker_decoder() -> Box<dyn MessageDecoder> {
    Box::new(nmea::Nmea::new(nmea::Telling::Talkers))
}

/// A decoder of messages of a format alone; of `json` it has no mapping.
#[must_use]
pub fn decoder(format: MessageFormat) -> Box<dyn MessageDecoder> {
    match format {
        MessageFormat::Frigate => Box::new(frigate::Frigate),
        MessageFormat::Deepstream => Box::new(deepstream::DeepStream),
        MessageFormat::Onvif => Box::new(onvif::Onvif),
        MessageFormat::Nmea => Box::new(nmea::Nmea::new(nmea::Telling::Senders)),
        MessageFormat::Gpsd => Box::new(gpsd::Gpsd::default()),
        MessageFormat::Traccar => Box::new(traccar::Traccar),
        MessageFormat::Phone => Box::new(phone::Phone),
        MessageFormat::Adsb => Box::new(adsb::Adsb),
        MessageFormat::Cot => Box::new(cot::Cot),
        MessageFormat::Json => mapped_decoder(JsonMapping::default()),
    }
}

/// A JSON document of another program, which may have fields that are not known here.
fn parse<'a, T: Deserialize<'a>>(payload: &'a [u8]) -> Result<T, String> {
    serde_json::from_slice(payload).map_err(|error| format!("is not the JSON of this format: {error}"))
}

/// A class by a detector's name of it; one that is not printable is left out.
fn class(name: &str) -> Option<TargetClass> {
    TargetClass::new(name).ok()
}

/// A score; one that is not from 0 to 1 is left out.
fn score(value: Option<f64>) -> Option<Score> {
    Score::new(value?).ok()
}

/// Who sent a message: its topic or key, or its address without the port, which changes with every connection.
pub(super) fn sender(subject: &str) -> String {
    match subject.parse::<SocketAddr>() {
        Ok(address) => address.ip().to_canonical().to_string(),
        Err(_) => subject.to_owned(),
    }
}
