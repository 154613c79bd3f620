//! Positions of Cursor on Target events (MITRE; ATAK, WinTAK, iTAK and TAK servers), in XML.
//!
//! The receiver is the event's `uid`. `ce` is the radius of a circular error of one standard deviation, m, as that
//! specification says, so it is the standard deviation per axis; 9999999 says that it is not known. Events of other
//! types than `a-` (atoms) are no positions of things, and what a person entered (`how` is `h-`) was not measured.

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::{MessageContext, MessageDecoder, MessageItem, Reading, ReportedFix};
use crate::domain::parse_time;
use crate::fix_quality::sigma_of_deviations;
use crate::xml::{Element as _, not_xml, numbers};

pub(super) struct Cot;

/// From this error on, m, nothing is known.
const UNKNOWN_M: f64 = 9_999_999.0;
/// The beginning of the `uid` of the events that a sink sends: what a source of the same group hears again.
const OWN_UID: &str = "sightfix.";
/// The first byte of TAK's binary protocol.
const BINARY: u8 = 0xBF;

/// The attributes of an event that are used.
struct Head {
    uid: String,
    kind: String,
    time: String,
    how: String,
}

impl Head {
    fn of(element: &BytesStart<'_>) -> Result<Self, String> {
        let required =
            |name: &str| element.attribute(name)?.ok_or_else(|| format!("an event has no attribute {name}"));
        Ok(Self {
            uid: required("uid")?,
            kind: required("type")?,
            time: required("time")?,
            how: element.attribute("how")?.unwrap_or_default(),
        })
    }

    fn item(&self, point: &BytesStart<'_>, context: &MessageContext<'_>) -> Result<MessageItem, String> {
        if !self.kind.starts_with("a-") {
            return Err(format!("an event of the type {:.40} is not of a thing with a position", self.kind));
        }
        if self.uid.starts_with(OWN_UID) {
            return Err(format!("{:.80} is a position that a server of this kind has sent", self.uid));
        }
        if self.how.starts_with("h-") {
            return Err(format!("the position of {:.80} was entered by a person", self.uid));
        }
        let [latitude_deg, longitude_deg] = numbers(point, ["lat", "lon"])?;
        let error_m = point.attribute("ce")?.and_then(|text| text.trim().parse().ok());
        let error_m = error_m.filter(|error_m: &f64| *error_m < UNKNOWN_M);
        let fix = ReportedFix {
            time: parse_time(&self.time).map_err(|error| error.to_string())?,
            receiver: Some(&self.uid),
            longitude_deg,
            latitude_deg,
            sigma: error_m.and_then(|error_m| sigma_of_deviations(error_m, error_m)),
        };
        fix.checked(context).map(MessageItem::Fix)
    }
}

impl MessageDecoder for Cot {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        if payload.first() == Some(&BINARY) {
            return Err("is TAK's binary protocol (protobuf); have the sender use XML".to_owned());
        }
        let mut xml = Reader::from_reader(payload);
        let mut buffer = Vec::new();
        let mut reading = Reading::default();
        let mut head = None;
        loop {
            buffer.clear();
            match xml.read_event_into(&mut buffer).map_err(not_xml)? {
                Event::Eof => return Ok(reading),
                Event::Start(element) | Event::Empty(element) => match element.local_name().as_ref() {
                    "event" => head = Some(Head::of(&element)?),
                    "point" => {
                        if let Some(head) = head.take() {
                            reading.take(head.item(&element, context));
                        }
                    }
                    _ => {}
                },
                _ => {}
            }
        }
    }
}
