//! The JSON of a connection's settings: where a source or a sink is, what it speaks, and what goes where.
//!
//! Secrets are an object of their own, so that settings can be shown as they are.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::address::Address;
use super::kinds::{
    LoginFields, SaslMechanism, SinkContent, SinkFields, SinkKind, SourceFields, SourceKind, Topic,
    sink_address, source_address,
};
use super::messages::{JsonMapping, MessageFormat};
use super::track_files::TrackFileFormat;
use crate::domain::{CameraId, Error, ImageArea, ImageSize, ReceiverId, Result, Score, SiteId, TargetClass};

/// Cameras that a connection may name.
const MAX_CAMERAS: usize = 1_024;
/// Classes that a source may take.
const MAX_CLASSES: usize = 64;

/// A connection to be created: either a source or a sink.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ConnectionDraft {
    /// A slug: 1 to 63 of `a-z`, `0-9` and `-`.
    #[schema(pattern = "^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", example = "frigate")]
    pub id: String,
    /// The name for people; the id if left out.
    #[schema(max_length = 200)]
    pub display_name: Option<String>,
    /// True if the connection stays paused.
    #[serde(default)]
    pub paused: bool,
    /// Takes detections or fixes in.
    pub source: Option<SourceSettings>,
    /// Gives positions out.
    pub sink: Option<SinkSettings>,
    /// Secrets by name, which no answer shows: `password`, `signing_key` (webhooks), `authorization` (header of webhooks),
    /// `client_certificate` and `client_key` (PEM).
    #[serde(default)]
    pub secrets: BTreeMap<String, Option<String>>,
}

/// The settings of a source or of a sink: exactly one of both.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ConnectionSettings {
    /// Takes detections or fixes in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<SourceSettings>,
    /// Gives positions out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sink: Option<SinkSettings>,
}

/// A camera of this server, by the sender's name of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraMapping {
    /// The camera here.
    #[schema(example = "gate")]
    pub camera_id: String,
    /// Size of the stream that the sender's boxes are in, if it is not the camera's `image_size`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image_size: Option<StreamSize>,
    /// Corners of the part of the camera's image whose boxes are taken: those whose foot, the middle of the lower edge, is
    /// inside. All boxes are taken if it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(min_items = 3, max_items = 64)]
    pub area: Option<Vec<ImagePoint>>,
}

/// A point of an image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImagePoint {
    /// Px from the left border.
    pub x_px: f64,
    /// Px from the upper border.
    pub y_px: f64,
}

/// Size of a stream, px.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StreamSize {
    /// Width of the image, px.
    pub width_px: u32,
    /// Height of the image, px.
    pub height_px: u32,
}

/// The origin of the receiver's name if a message does not contain one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ReceiverFrom {
    /// The setting `receiver_id`.
    #[default]
    Connection,
    /// The sender: the address without its port, the topic, or the name of the key.
    Sender,
    /// The two letters at the beginning of an NMEA sentence, such as `GP`.
    Talker,
}

impl ReceiverFrom {
    #[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
    const fn is_connection(&self) -> bool {
        matches!(self, Self::Connection)
    }
}

/// Where detections or fixes come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SourceSettings {
    /// `mqtt://HOST[:1883]`, `mqtts://HOST[:8883]`, `kafka://HOST[:9092]` and `kafkas://HOST[:9093]` subscribe, Kafka to a
    /// cluster of several hosts with commas between them; `tcp://`,
    /// `tls://` and `gpsd://HOST[:2947]` connect and read lines; `serial:///dev/DEVICE?baud=4800` reads lines of a serial
    /// device of the server's machine; `rtsp://HOST[:554]/PATH` and `rtsps://HOST[:322]/PATH` read the ONVIF metadata of a
    /// camera's stream; `udp://ADDRESS:PORT` and `tcp-listen://ADDRESS:PORT` take what is sent there; `push:` takes
    /// `POST /v1/connections/{connection}/messages`.
    #[schema(max_length = 512, example = "mqtt://broker.example.org:1883")]
    pub address: String,
    /// The format of the messages.
    pub format: MessageFormat,
    /// Topics of MQTT, with its wildcards, or of Kafka.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schema(max_items = 64, example = json!(["frigate/events"]))]
    pub topics: Vec<String>,
    /// Name of the user, where the peer asks for one; the secret `password` belongs to it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub username: Option<String>,
    /// How a user signs in to Kafka; `plain` if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sasl_mechanism: Option<SaslMechanism>,
    /// Authority of the peer's certificate (PEM); those of the operating system if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_certificate: Option<String>,
    /// Cameras by the sender's names of them; a name that is missing here is taken as the id of a camera. The name `*`
    /// stands for any.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub cameras: BTreeMap<String, CameraMapping>,
    /// Cameras that fixes are for; each pairs them with its boxes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schema(max_items = 1024, example = json!(["gate"]))]
    pub camera_ids: Vec<String>,
    /// The receiver of fixes whose messages name none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub receiver_id: Option<String>,
    /// The origin of the receiver's name if a message does not contain one.
    #[serde(default, skip_serializing_if = "ReceiverFrom::is_connection")]
    pub receiver_from: ReceiverFrom,
    /// Where the values of messages of the format `json` are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mapping: Option<JsonMapping>,
    /// Classes of detections that are taken, in either case; all if empty. One without a class is taken.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schema(max_items = 64, example = json!(["person"]))]
    pub classes: Vec<String>,
    /// Least score of detections that are taken. One without a score is taken.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.0, maximum = 1.0)]
    pub least_score: Option<f64>,
    /// True if the ids of detected objects are names of targets, which receivers also use. If left out, they are
    /// numbers of a tracker, and boxes are matched with receivers by their positions.
    #[serde(default)]
    pub ids_name_targets: bool,
    /// True if boxes and fixes are paired and stored as samples. Messages are acknowledged when that is done, but those
    /// that phones push (`push:` with the format `phone`) when they were taken.
    #[serde(default)]
    pub store_samples: bool,
}

/// Format of a sink's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OutgoingFormat {
    /// A JSON object per position.
    #[default]
    Json,
    /// A Cursor on Target event (XML, version 2.0) per position.
    Cot,
    /// An ONVIF metadata frame (XML, `tt:MetadataStream`) with the object's geolocation per position.
    Onvif,
    /// Attributes of device trackers of Home Assistant, which are announced to it by MQTT discovery; of targets whose receiver is
    /// known alone. For addresses of MQTT.
    HomeAssistant,
    /// Tracks in files of GPX 1.1, for the address `file:`.
    Gpx,
    /// Tracks in files of KML 2.2, for the address `file:`.
    Kml,
}

impl OutgoingFormat {
    /// The format of files of tracks, if it is one.
    #[must_use]
    pub const fn track_file(self) -> Option<TrackFileFormat> {
        match self {
            Self::Json | Self::Cot | Self::Onvif | Self::HomeAssistant => None,
            Self::Gpx => Some(TrackFileFormat::Gpx),
            Self::Kml => Some(TrackFileFormat::Kml),
        }
    }
}

/// Where positions go to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SinkSettings {
    /// `mqtt://HOST[:1883]`, `mqtts://HOST[:8883]`, `kafka://HOST[:9092]`, `kafkas://HOST[:9093]`, `nats://HOST[:4222]` and
    /// `natss://HOST[:4222]` publish; `http://` and `https://` post (a webhook); `tcp://`, `tls://` and `udp://HOST:PORT`, also of a multicast group, send; `file:` writes files to the folder of the setting
    /// `export_folder`.
    #[schema(max_length = 512, example = "https://hooks.example.org/positions")]
    pub address: String,
    /// The format of the messages that are sent.
    #[serde(default)]
    pub format: OutgoingFormat,
    /// Topic of MQTT or Kafka, or subject of NATS; `{camera}` and `{target}` are replaced by their ids.
    /// `sightfix/{camera}/{target}` if left out, with points for NATS, and `sightfix` for Kafka, whose messages have the key
    /// `{camera}/{target}`. For events of places `{place}` and `{kind}` are replaced; `sightfix/events/{place}` if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// Name of the user, where the peer asks for one; the secret `password` belongs to it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub username: Option<String>,
    /// How a user signs in to Kafka; `plain` if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sasl_mechanism: Option<SaslMechanism>,
    /// Authority of the peer's certificate (PEM); those of the operating system if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_certificate: Option<String>,
    /// The contents of the messages.
    #[serde(default)]
    pub content: SinkContent,
    /// Cameras whose tracks, or the events of whose places, are sent.
    #[serde(default)]
    #[schema(max_items = 1024, example = json!(["gate"]))]
    pub camera_ids: Vec<String>,
    /// Sites the events of whose places are sent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schema(max_items = 1024, example = json!(["harbour"]))]
    pub site_ids: Vec<String>,
    /// Least time between two positions of a target, s; 1 if left out, 0 for every one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.0, maximum = 86400.0)]
    pub min_interval_s: Option<f64>,
    /// Time after which a Cursor on Target event is stale, s; 30 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1.0, maximum = 86400.0)]
    pub stale_s: Option<f64>,
    /// Type of Cursor on Target events; `a-u-G` (unknown, on the ground) if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cot_type: Option<String>,
    /// Routers that a multicast datagram may pass; 1 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub multicast_ttl: Option<u8>,
    /// Time after which a new file begins, s; 3600 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1.0, maximum = 86400.0)]
    pub rotate_s: Option<f64>,
    /// True if a message to NATS counts as delivered only when a JetStream stream has stored it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub jetstream: bool,
}

/// The secrets of a connection, by name; they are never shown.
#[derive(Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Secrets(BTreeMap<String, String>);

impl fmt::Debug for Secrets {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_set().entries(self.names()).finish()
    }
}

impl Secrets {
    /// Names of the secrets that connections may have.
    pub const NAMES: [&str; 5] =
        ["password", "signing_key", "authorization", "client_certificate", "client_key"];
    const MAX_BYTES: usize = 32 << 10;

    /// A secret that is set.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&str> {
        self.0.get(name).map(String::as_str)
    }

    /// Names of the secrets that are set.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// These secrets with changes: a text sets one, `None` removes it.
    ///
    /// # Errors
    /// `InvalidArgument` naming a secret that connections do not have, or that is too long.
    pub fn changed(mut self, changes: BTreeMap<String, Option<String>>) -> Result<Self> {
        for (name, secret) in changes {
            if !Self::NAMES.contains(&name.as_str()) {
                let known = Self::NAMES.join(", ");
                return Err(Error::invalid(
                    format!("secrets.{name}"),
                    format!("is unknown; there are {known}"),
                ));
            }
            match secret {
                Some(secret) if secret.is_empty() || secret.len() > Self::MAX_BYTES => {
                    return Err(Error::invalid(
                        format!("secrets.{name}"),
                        "must be text of 1 to 32,768 bytes",
                    ));
                }
                Some(secret) if name == "authorization" && !is_header(&secret) => {
                    return Err(Error::invalid(
                        "secrets.authorization",
                        "must be the value of a header in ASCII, such as `Bearer abc`, without line breaks, and \
                         without spaces at its ends",
                    ));
                }
                Some(secret) => drop(self.0.insert(name, secret)),
                None => drop(self.0.remove(&name)),
            }
        }
        Ok(self)
    }
}

/// True if a text is valid as the value of a header (RFC 9110, 5.5).
fn is_header(text: &str) -> bool {
    text.trim() == text && text.bytes().all(|byte| matches!(byte, b' '..=b'~'))
}

impl ConnectionSettings {
    /// Checks the settings as a whole.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field.
    pub fn check(&self, secrets: &Secrets) -> Result<()> {
        match (&self.source, &self.sink) {
            (Some(source), None) => source.check().map_err(|error| error.under("source")),
            (None, Some(sink)) => sink.check().map_err(|error| error.under("sink")),
            _ => Err(Error::invalid("source", "give either source or sink")),
        }?;
        if secrets.get("client_certificate").is_some() != secrets.get("client_key").is_some() {
            return Err(Error::invalid(
                "secrets.client_key",
                "client_certificate and client_key belong together",
            ));
        }
        Ok(())
    }

    /// The cameras that it names, each with the field that does.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field of one that is no id.
    pub fn named_cameras(&self) -> Result<Vec<(String, CameraId)>> {
        let mut named = Vec::new();
        if let Some(source) = &self.source {
            for (name, mapping) in &source.cameras {
                named.push((format!("source.cameras.{name}.camera_id"), mapping.camera()?));
            }
            let cameras = source.fix_cameras()?.into_iter();
            named.extend(cameras.map(|camera| ("source.camera_ids".to_owned(), camera)));
        }
        if let Some(sink) = &self.sink {
            let cameras = sink.cameras()?.into_iter();
            named.extend(cameras.map(|camera| ("sink.camera_ids".to_owned(), camera)));
        }
        Ok(named)
    }

    /// True if the peer is the same as by other settings: direction, scheme, hosts and ports.
    #[must_use]
    pub fn has_peer_of(&self, other: &Self) -> bool {
        self.peer().is_some_and(|peer| other.peer() == Some(peer))
    }

    /// Direction, and the address without its path.
    fn peer(&self) -> Option<(bool, Address)> {
        let address = match (&self.source, &self.sink) {
            (Some(source), _) => source.address(),
            (None, sink) => sink.as_ref()?.address(),
        };
        address.ok().map(|it| (self.source.is_some(), Address { path: String::new(), ..it }))
    }
}

impl SourceSettings {
    /// Where it is.
    ///
    /// # Errors
    /// `InvalidArgument` naming `address`.
    pub fn address(&self) -> Result<Address> {
        source_address(&self.address)
    }

    /// The settings that its kind knows.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field, also for one that the kind does not know.
    pub fn kind(&self) -> Result<SourceKind> {
        let login = LoginFields {
            username: self.username.clone(),
            sasl_mechanism: self.sasl_mechanism,
            ca_certificate: self.ca_certificate.clone(),
        };
        SourceKind::new(
            &self.address,
            SourceFields { format: self.format, topics: self.topics.clone(), login },
        )
    }

    fn check(&self) -> Result<()> {
        self.kind()?;
        self.check_items()?;
        if self.brings_fixes() {
            if self.camera_ids.is_empty() {
                return Err(Error::invalid("camera_ids", "must name the cameras that the fixes are for"));
            }
            if self.ids_name_targets {
                let rule =
                    "is for detections; the profile of the camera (receivers) says whose a receiver is";
                return Err(Error::invalid("ids_name_targets", rule));
            }
        }
        self.fix_cameras()?;
        self.receiver()?;
        if self.cameras.len() > MAX_CAMERAS {
            return Err(Error::invalid("cameras", "must be at most 1,024"));
        }
        for (name, mapping) in &self.cameras {
            let checked = || {
                mapping.camera()?;
                mapping.stream_size()?;
                mapping.area().map(drop)
            };
            checked().map_err(|error: Error| error.under(&format!("cameras.{name}")))?;
        }
        Ok(())
    }

    /// True if a message is answered when it was taken, before what is to be stored of it is stored: applications of
    /// phones send a position only after the answer to the one before, and a fix may wait seconds for its box.
    #[must_use]
    pub fn answers_at_once(&self) -> bool {
        let is_pushed = matches!(self.kind(), Ok(SourceKind::Push));
        is_pushed && self.format == MessageFormat::Phone
    }

    /// True if its messages contain fixes, not detections.
    fn brings_fixes(&self) -> bool {
        self.mapping.as_ref().map_or_else(|| self.format.brings_fixes(), JsonMapping::brings_fixes)
    }

    /// Checks what is read of messages and what is taken of that.
    fn check_items(&self) -> Result<()> {
        if (self.format == MessageFormat::Json) != self.mapping.is_some() {
            return Err(Error::invalid("mapping", "is required for the format json, and for no other"));
        }
        let mapped = self.mapping.as_ref().map_or(Ok(()), JsonMapping::check);
        mapped.map_err(|error| error.under("mapping"))?;
        if self.receiver_from == ReceiverFrom::Talker && self.format != MessageFormat::Nmea {
            return Err(Error::invalid("receiver_from", "can be talker for the format nmea alone"));
        }
        if self.classes.len() > MAX_CLASSES {
            return Err(Error::invalid("classes", "must be at most 64"));
        }
        for class in &self.classes {
            TargetClass::new(class).map_err(|error| error.at("classes"))?;
        }
        self.least_score.map(Score::new).transpose().map_err(|error| error.at("least_score"))?;
        Ok(())
    }

    /// True if a message may name a camera that the settings do not: then the name is the id of a camera.
    #[must_use]
    pub fn names_any_camera(&self) -> bool {
        !self.brings_fixes() && !self.cameras.contains_key("*")
    }

    /// The cameras that fixes are for.
    ///
    /// # Errors
    /// `InvalidArgument` naming `camera_ids`.
    pub fn fix_cameras(&self) -> Result<Vec<CameraId>> {
        cameras(&self.camera_ids)
    }

    /// The receiver of fixes whose messages name none.
    ///
    /// # Errors
    /// `InvalidArgument` naming `receiver_id`.
    pub fn receiver(&self) -> Result<Option<ReceiverId>> {
        self.receiver_id.as_deref().map(ReceiverId::new).transpose()
    }
}

impl CameraMapping {
    /// The camera.
    ///
    /// # Errors
    /// `InvalidArgument` naming `camera_id`.
    pub fn camera(&self) -> Result<CameraId> {
        CameraId::new(&self.camera_id).map_err(|error| error.at("camera_id"))
    }

    /// Size of the sender's stream, if it is not that of the camera.
    ///
    /// # Errors
    /// `InvalidArgument` naming a side.
    pub fn stream_size(&self) -> Result<Option<ImageSize>> {
        self.image_size.map(|size| ImageSize::new(size.width_px, size.height_px)).transpose()
    }

    /// The part of the camera's image whose boxes are taken, if it is not all of it.
    ///
    /// # Errors
    /// `InvalidArgument` naming `area`.
    pub fn area(&self) -> Result<Option<ImageArea>> {
        let corners = |area: &Vec<ImagePoint>| area.iter().map(|point| [point.x_px, point.y_px]).collect();
        self.area.as_ref().map(|area| ImageArea::new(corners(area))).transpose()
    }
}

impl SinkSettings {
    /// Where it is.
    ///
    /// # Errors
    /// `InvalidArgument` naming `address`.
    pub fn address(&self) -> Result<Address> {
        sink_address(&self.address)
    }

    /// The settings that its kind knows.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field, also for one that the kind does not know.
    pub fn kind(&self) -> Result<SinkKind> {
        let login = LoginFields {
            username: self.username.clone(),
            sasl_mechanism: self.sasl_mechanism,
            ca_certificate: self.ca_certificate.clone(),
        };
        let fields = SinkFields {
            track_file: self.format.track_file(),
            content: self.content,
            topic: self.topic.clone(),
            multicast_ttl: self.multicast_ttl,
            rotate_s: self.rotate_s,
            jetstream: self.jetstream,
            login,
        };
        SinkKind::new(&self.address, fields)
    }

    fn check(&self) -> Result<()> {
        let kind = self.kind()?;
        if self.format == OutgoingFormat::HomeAssistant && !matches!(kind, SinkKind::Mqtt(_)) {
            return Err(Error::invalid("format", "can be home_assistant for addresses of MQTT alone"));
        }
        if self.content == SinkContent::PlaceEvents && self.format != OutgoingFormat::Json {
            return Err(Error::invalid("format", "must be json for events of places"));
        }
        if self.content == SinkContent::Positions && !self.site_ids.is_empty() {
            return Err(Error::invalid("site_ids", "is for events of places alone"));
        }
        if self.camera_ids.is_empty() && self.site_ids.is_empty() {
            return Err(Error::invalid(
                "camera_ids",
                "must name the cameras whose tracks or events are sent",
            ));
        }
        self.cameras()?;
        self.sites()?;
        for (field, value, least) in [
            ("min_interval_s", self.min_interval_s, 0.0),
            ("stale_s", self.stale_s, 1.0),
            ("rotate_s", self.rotate_s, 1.0),
        ] {
            if value.is_some_and(|value| !(least..=86_400.0).contains(&value)) {
                return Err(Error::invalid(field, format!("must be from {least} to 86400")));
            }
        }
        let is_type = |text: &str| {
            (1..=64).contains(&text.len())
                && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-.".contains(&byte))
        };
        if self.cot_type.as_deref().is_some_and(|text| !is_type(text)) {
            return Err(Error::invalid("cot_type", "must be letters, digits and -, such as a-f-G-U-C"));
        }
        Ok(())
    }

    /// The cameras whose tracks are sent.
    ///
    /// # Errors
    /// `InvalidArgument` naming `camera_ids`.
    pub fn cameras(&self) -> Result<Vec<CameraId>> {
        cameras(&self.camera_ids)
    }

    /// The topic of each message.
    ///
    /// # Errors
    /// `InvalidArgument` naming the field that is wrong.
    pub fn topic(&self) -> Result<Topic> {
        Ok(self.kind()?.topic(self.content))
    }

    /// The sites the events of whose places are sent.
    ///
    /// # Errors
    /// `InvalidArgument` naming `site_ids`.
    pub fn sites(&self) -> Result<Vec<SiteId>> {
        if self.site_ids.len() > MAX_CAMERAS {
            return Err(Error::invalid("site_ids", "must be at most 1,024"));
        }
        self.site_ids.iter().map(|id| SiteId::new(id).map_err(|error| error.at("site_ids"))).collect()
    }
}

fn cameras(ids: &[String]) -> Result<Vec<CameraId>> {
    if ids.len() > MAX_CAMERAS {
        return Err(Error::invalid("camera_ids", "must be at most 1,024"));
    }
    let camera = |id: &String| CameraId::new(id).map_err(|error| error.at("camera_ids"));
    ids.iter().map(camera).collect()
}
