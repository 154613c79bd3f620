//! Positions as applications of phones send them, by HTTP or MQTT.
//!
//! | application | body | receiver |
//! |---|---|---|
//! | OwnTracks | `{"_type": "location", ...}` (booklet, JSON) | the topic without `owntracks/`, else `tid` |
//! | Overland | `{"locations": [features]}` (README, API) | `device_id` |
//! | Traccar Client from release 9 on | `{"location": {"coords": ...}, "device_id": ...}` (OsmAnd protocol) | `device_id` |
//! | Sensor Logger | `{"payload": [{"name": "location", ...}]}` (PUSHING.md) | `deviceId` |
//! | Home Assistant's companion | `{"type": "update_location", ...}` (native app integration) | none |
//! | Traccar Client before and from release 10 on, OsmAnd, GPSLogger | `lat=...&lon=...` as a form or a query, or the same names in a JSON object | `id`, `deviceid` or `device` |
//!
//! Accuracies are radii that contain the phone in 68 of 100 cases, as Android defines them; those of iOS are taken for the
//! same. A negative one says that there is no position. A body without a time is of the moment at which it came.

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::TimeZone;
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::{Map, Value};

use super::{MessageContext, MessageDecoder, MessageItem, Reading, ReportedFix, parse};
use crate::domain::{SigmaM, parse_time};
use crate::fix_quality::{Solution, sigma_of_radius_68};
use crate::unix_time::unix_time;

pub(super) struct Phone;

/// Which application a body is of.
enum Application {
    /// OwnTracks posts nothing at all when a friend is deleted.
    Empty,
    OwnTracks,
    Overland,
    TraccarClient,
    SensorLogger,
    HomeAssistant,
    FlatJson,
    Form,
}

/// The fields that distinguish applications.
#[derive(Deserialize)]
struct Shape {
    #[serde(rename = "_type")]
    own_tracks_type: Option<IgnoredAny>,
    locations: Option<IgnoredAny>,
    location: Option<IgnoredAny>,
    payload: Option<IgnoredAny>,
    #[serde(rename = "type")]
    kind: Option<IgnoredAny>,
}

impl Application {
    fn of(payload: &[u8]) -> Result<Self, String> {
        match payload.trim_ascii_start().first() {
            None => return Ok(Self::Empty),
            Some(b'{') => {}
            Some(b'[') => return Err("is a JSON array, which no application for phones sends".to_owned()),
            Some(_) => return Ok(Self::Form),
        }
        Ok(match parse(payload)? {
            Shape { own_tracks_type: Some(_), .. } => Self::OwnTracks,
            Shape { locations: Some(_), .. } => Self::Overland,
            Shape { location: Some(_), .. } => Self::TraccarClient,
            Shape { payload: Some(_), .. } => Self::SensorLogger,
            Shape { kind: Some(_), .. } => Self::HomeAssistant,
            _ => Self::FlatJson,
        })
    }
}

/// The response that the application of a body must receive before it deletes what it has sent.
pub(super) fn answer(payload: &[u8]) -> Option<&'static str> {
    match Application::of(payload).ok()? {
        Application::Empty | Application::OwnTracks => Some("[]"),
        Application::Overland => Some(r#"{"result":"ok"}"#),
        Application::HomeAssistant => Some("{}"),
        _ => None,
    }
}

impl MessageDecoder for Phone {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let mut reading = Reading::default();
        match Application::of(payload)? {
            Application::Empty => reading.skip("an empty message has no position"),
            Application::OwnTracks => own_tracks(parse(payload)?, context, &mut reading)?,
            Application::Overland => overland(parse(payload)?, context, &mut reading),
            Application::TraccarClient => traccar_client(parse(payload)?, context, &mut reading)?,
            Application::SensorLogger => sensor_logger(parse(payload)?, context, &mut reading),
            Application::HomeAssistant => home_assistant(parse(payload)?, context, &mut reading)?,
            Application::FlatJson => flat(Flat::of_json(parse(payload)?), context, &mut reading)?,
            Application::Form => flat(Flat::of_form(payload), context, &mut reading)?,
        }
        Ok(reading)
    }
}

/// A position of a phone, before its checks.
#[derive(Default)]
struct PhoneFix<'a> {
    /// When it was measured; when it came, if the application does not say.
    time: Option<Timestamp>,
    receiver: Option<&'a str>,
    longitude_deg: f64,
    latitude_deg: f64,
    /// Radius of 68 %, m; negative where there is no position.
    accuracy_m: Option<f64>,
    /// Where there is no accuracy.
    hdop: Option<f64>,
}

impl PhoneFix<'_> {
    fn item(self, context: &MessageContext<'_>) -> Result<MessageItem, String> {
        if self.accuracy_m.is_some_and(|accuracy_m| accuracy_m < 0.0) {
            return Err("the phone has no position: its accuracy is negative".to_owned());
        }
        let by_hdop = || self.hdop.and_then(|hdop| Solution::Autonomous.sigma(Some(hdop)));
        let sigma: Option<SigmaM> = self.accuracy_m.and_then(sigma_of_radius_68).or_else(by_hdop);
        let fix = ReportedFix {
            time: self.time.unwrap_or(context.received_at),
            receiver: self.receiver.filter(|name| !name.is_empty()),
            longitude_deg: self.longitude_deg,
            latitude_deg: self.latitude_deg,
            sigma,
        };
        fix.checked(context).map(MessageItem::Fix)
    }
}

#[derive(Deserialize)]
struct OwnTracks {
    #[serde(rename = "_type")]
    kind: String,
    tst: Option<f64>,
    lat: Option<f64>,
    lon: Option<f64>,
    acc: Option<f64>,
    tid: Option<String>,
    topic: Option<String>,
}

/// The beginning of OwnTracks' topics, `owntracks/USER/DEVICE`.
const OWN_TRACKS_TOPICS: &str = "owntracks/";

fn own_tracks(body: OwnTracks, context: &MessageContext<'_>, reading: &mut Reading) -> Result<(), String> {
    if body.kind == "encrypted" {
        return Err("is encrypted; remove the encryption key in OwnTracks and connect with TLS".to_owned());
    }
    if body.kind != "location" {
        reading.skip(format!("an OwnTracks message of the type {} has no position", body.kind));
        return Ok(());
    }
    let in_topic = |topic: &str| topic.strip_prefix(OWN_TRACKS_TOPICS).map(str::to_owned);
    let receiver = body.topic.as_deref().map(|topic| in_topic(topic).unwrap_or_else(|| topic.to_owned()));
    let receiver = receiver.or_else(|| in_topic(context.subject)).or(body.tid);
    let fix = PhoneFix {
        time: Some(unix_time(body.tst.ok_or("tst is missing")?)?),
        receiver: receiver.as_deref(),
        longitude_deg: body.lon.ok_or("lon is missing")?,
        latitude_deg: body.lat.ok_or("lat is missing")?,
        accuracy_m: body.acc,
        hdop: None,
    };
    reading.items.push(fix.item(context)?);
    Ok(())
}

#[derive(Deserialize)]
struct Overland {
    locations: Vec<Feature>,
}

#[derive(Deserialize)]
struct Feature {
    /// A trip that has ended has none.
    geometry: Option<Geometry>,
    properties: Properties,
}

#[derive(Deserialize)]
struct Geometry {
    coordinates: Vec<f64>,
}

#[derive(Deserialize)]
struct Properties {
    timestamp: Option<String>,
    horizontal_accuracy: Option<f64>,
    device_id: Option<String>,
}

fn overland(body: Overland, context: &MessageContext<'_>, reading: &mut Reading) {
    for Feature { geometry, properties } in body.locations {
        let read = || {
            let coordinates = geometry.map(|it| it.coordinates).unwrap_or_default();
            let [longitude_deg, latitude_deg, ..] = coordinates[..] else {
                return Err("a record without coordinates has no position".to_owned());
            };
            let fix = PhoneFix {
                time: properties.timestamp.as_deref().map(instant).transpose()?,
                receiver: properties.device_id.as_deref(),
                longitude_deg,
                latitude_deg,
                accuracy_m: properties.horizontal_accuracy,
                hdop: None,
            };
            fix.item(context)
        };
        reading.take(read());
    }
}

#[derive(Deserialize)]
struct TraccarClient {
    location: TraccarLocation,
    device_id: Option<String>,
}

#[derive(Deserialize)]
struct TraccarLocation {
    timestamp: Option<String>,
    coords: Coordinates,
    /// True if another application makes up the positions.
    #[serde(default)]
    mock: bool,
}

#[derive(Deserialize)]
struct Coordinates {
    latitude: f64,
    longitude: f64,
    accuracy: Option<f64>,
}

fn traccar_client(
    body: TraccarClient,
    context: &MessageContext<'_>,
    reading: &mut Reading,
) -> Result<(), String> {
    if body.location.mock {
        reading.skip("the position is simulated (mock)");
        return Ok(());
    }
    let coordinates = body.location.coords;
    let fix = PhoneFix {
        time: body.location.timestamp.as_deref().map(instant).transpose()?,
        receiver: body.device_id.as_deref(),
        longitude_deg: coordinates.longitude,
        latitude_deg: coordinates.latitude,
        accuracy_m: coordinates.accuracy,
        hdop: None,
    };
    reading.items.push(fix.item(context)?);
    Ok(())
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct SensorLogger {
    device_id: Option<String>,
    payload: Vec<Measurement>,
}

#[derive(Deserialize)]
struct Measurement {
    name: String,
    /// Nanoseconds since 1970.
    time: f64,
    #[serde(default)]
    values: Value,
}

fn sensor_logger(body: SensorLogger, context: &MessageContext<'_>, reading: &mut Reading) {
    let locations = body.payload.iter().filter(|measurement| measurement.name == "location");
    if locations.clone().next().is_none() {
        reading.skip("a message without measurements of the sensor location has no position");
    }
    for Measurement { time, values, .. } in locations {
        let number = |name: &str| values.get(name).and_then(Value::as_f64);
        let read = || {
            let fix = PhoneFix {
                time: Some(unix_time(*time)?),
                receiver: body.device_id.as_deref(),
                longitude_deg: number("longitude").ok_or("values.longitude is missing")?,
                latitude_deg: number("latitude").ok_or("values.latitude is missing")?,
                accuracy_m: number("horizontalAccuracy"),
                hdop: None,
            };
            fix.item(context)
        };
        reading.take(read());
    }
}

#[derive(Deserialize)]
struct HomeAssistant {
    #[serde(rename = "type")]
    kind: String,
    data: Option<Update>,
}

#[derive(Deserialize)]
struct Update {
    /// Latitude and longitude, degrees.
    gps: Option<[f64; 2]>,
    gps_accuracy: Option<f64>,
}

fn home_assistant(
    body: HomeAssistant,
    context: &MessageContext<'_>,
    reading: &mut Reading,
) -> Result<(), String> {
    let update = match (body.kind.as_str(), body.data) {
        ("encrypted", _) => {
            return Err("is encrypted; register the application without encryption".to_owned());
        }
        ("update_location", Some(Update { gps: Some(degrees), gps_accuracy })) => (degrees, gps_accuracy),
        (kind, _) => {
            reading.skip(format!("a message of Home Assistant of the type {kind} has no position"));
            return Ok(());
        }
    };
    let ([latitude_deg, longitude_deg], accuracy_m) = update;
    let fix = PhoneFix { longitude_deg, latitude_deg, accuracy_m, ..PhoneFix::default() };
    reading.items.push(fix.item(context)?);
    Ok(())
}

/// Values by name, as the parameters of a query or the members of an object.
struct Flat(Vec<(String, String)>);

impl Flat {
    fn of_form(payload: &[u8]) -> Self {
        Self(form_urlencoded::parse(payload.trim_ascii()).into_owned().collect())
    }

    fn of_json(members: Map<String, Value>) -> Self {
        let texts = members.into_iter().filter_map(|(name, value)| match value {
            Value::String(text) => Some((name, text)),
            Value::Number(_) | Value::Bool(_) => Some((name, value.to_string())),
            _ => None,
        });
        Self(texts.collect())
    }

    /// The value of the first of these names that has one.
    fn get(&self, names: &[&str]) -> Option<&str> {
        let value = |name: &&str| self.0.iter().find(|(given, text)| given == name && !text.is_empty());
        names.iter().find_map(value).map(|(_, text)| text.as_str())
    }

    fn number(&self, names: &[&str]) -> Result<Option<f64>, String> {
        let parse =
            |text: &str| text.parse().map_err(|_| format!("{} is `{text:.40}`, not a number", names[0]));
        self.get(names).map(parse).transpose()
    }
}

fn flat(values: Flat, context: &MessageContext<'_>, reading: &mut Reading) -> Result<(), String> {
    if matches!(values.get(&["valid"]), Some("false" | "0")) {
        reading.skip("the position is not valid");
        return Ok(());
    }
    let missing =
        |name: &str| format!("{name} is missing, and the body is of no other application for phones");
    let fix = PhoneFix {
        time: values.get(&["timestamp", "time"]).map(instant).transpose()?,
        receiver: values.get(&["id", "deviceid", "device_id", "device"]),
        longitude_deg: values.number(&["lon", "longitude", "lng"])?.ok_or_else(|| missing("lon"))?,
        latitude_deg: values.number(&["lat", "latitude"])?.ok_or_else(|| missing("lat"))?,
        accuracy_m: values.number(&["accuracy", "acc"])?,
        hdop: values.number(&["hdop"])?,
    };
    reading.items.push(fix.item(context)?);
    Ok(())
}

/// An instant as Unix time, as RFC 3339, or without an offset, which is UTC.
fn instant(text: &str) -> Result<Timestamp, String> {
    if let Ok(number) = text.parse() {
        return unix_time(number);
    }
    if let Ok(civil) = text.parse::<DateTime>()
        && !text.ends_with(['Z', 'z'])
        && text.parse::<Timestamp>().is_err()
    {
        return TimeZone::UTC.to_timestamp(civil).map_err(|_| format!("`{text}` is no time"));
    }
    // A plus sign that was not escaped in a query arrives as a space.
    parse_time(&text.replace(' ', "+")).map_err(|error| error.to_string())
}
