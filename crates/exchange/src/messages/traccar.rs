//! Positions as Traccar forwards them (`forward.type = json`): `{"position": {...}, "device": {...}}`.
//!
//! `accuracy` is what devices state: of phones, the radius that contains them in 68 of 100 cases, m. 0 means that there
//! is none; then the attribute `hdop` counts, if the device sends it.

use serde::Deserialize;

use super::{MessageContext, MessageDecoder, MessageItem, Reading, ReportedFix, parse};
use crate::domain::{SigmaM, parse_time};
use crate::fix_quality::{Solution, sigma_of_radius_68};

pub(super) struct Traccar;

#[derive(Deserialize)]
struct Forwarded {
    position: Position,
    device: Option<Device>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Position {
    device_id: Option<i64>,
    fix_time: Option<String>,
    #[serde(default = "yes")]
    valid: bool,
    /// True if the receiver had no new fix and this is its last one.
    #[serde(default)]
    outdated: bool,
    latitude: f64,
    longitude: f64,
    accuracy: Option<f64>,
    attributes: Option<Attributes>,
}

#[derive(Deserialize)]
struct Attributes {
    hdop: Option<f64>,
}

impl Position {
    fn sigma(&self) -> Option<SigmaM> {
        let hdop = || self.attributes.as_ref().and_then(|attributes| attributes.hdop);
        let by_hdop = || hdop().and_then(|hdop| Solution::Autonomous.sigma(Some(hdop)));
        self.accuracy.and_then(sigma_of_radius_68).or_else(by_hdop)
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Device {
    unique_id: Option<String>,
}

const fn yes() -> bool {
    true
}

impl MessageDecoder for Traccar {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let Forwarded { position, device } = parse(payload)?;
        let mut reading = Reading::default();
        if !position.valid || position.outdated {
            reading.skip("the position is not valid, or an old one");
            return Ok(reading);
        }
        let sigma = position.sigma();
        let named = device.and_then(|device| device.unique_id);
        let named = named.or_else(|| position.device_id.map(|id| id.to_string()));
        let time = position.fix_time.ok_or("position.fixTime is missing")?;
        let fix = ReportedFix {
            time: parse_time(&time).map_err(|error| error.to_string())?,
            receiver: named.as_deref(),
            longitude_deg: position.longitude,
            latitude_deg: position.latitude,
            sigma,
        };
        reading.items.push(MessageItem::Fix(fix.checked(context)?));
        Ok(reading)
    }
}
