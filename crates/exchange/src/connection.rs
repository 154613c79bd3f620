//! The JSON of a connection's settings: where a source or a sink is, what it speaks, and what goes where.
//!
//! Secrets are an object of their own, so that settings can be shown as they are.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::address::{Address, Scheme};
use super::messages::{JsonMapping, MessageFormat};
use super::track_files::TrackFileFormat;
use crate::domain::{
    CameraId, Error, ImageArea, ImageSize, ReceiverId, Result, Score, TargetClass, TargetId, check_text,
};

/// Cameras that a connection may name.
const MAX_CAMERAS: usize = 1_024;
/// Classes that a source may take.
const MAX_CLASSES: usize = 64;
/// Topics that a source may subscribe to.
const MAX_TOPICS: usize = 64;

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

/// How a user signs in to Kafka (SASL).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SaslMechanism {
    /// The password is sent as it is (RFC 4616).
    Plain,
    /// A challenge is answered, with SHA-256 (RFC 7677).
    #[serde(rename = "scram_sha_256")]
    ScramSha256,
    /// A challenge is answered, with SHA-512.
    #[serde(rename = "scram_sha_512")]
    ScramSha512,
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
    /// `mqtt://HOST[:1883]`, `mqtts://HOST[:8883]`, `kafka://HOST[:9092]`, `kafkas://HOST[:9093]` and `nats://HOST[:4222]`
    /// publish; `http://` and `https://` post (a webhook); `tcp://`, `tls://` and `udp://HOST:PORT`, also of a multicast group, send; `file:` writes files to the folder of the setting
    /// `export_folder`.
    #[schema(max_length = 512, example = "https://hooks.example.org/positions")]
    pub address: String,
    /// The format of the messages that are sent.
    #[serde(default)]
    pub format: OutgoingFormat,
    /// Topic of MQTT or Kafka, or subject of NATS; `{camera}` and `{target}` are replaced by their ids.
    /// `sightfix/{camera}/{target}` if left out, with points for NATS, and `sightfix` for Kafka, whose messages have the key
    /// `{camera}/{target}`.
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
    /// Cameras whose tracks are sent.
    #[schema(min_items = 1, max_items = 1024, example = json!(["gate"]))]
    pub camera_ids: Vec<String>,
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
        Address::parse(&self.address, Scheme::SOURCES)
    }

    fn check(&self) -> Result<()> {
        let address = self.address()?;
        if address.scheme.subscribes() == self.topics.is_empty() || self.topics.len() > MAX_TOPICS {
            let rule = "must be 1 to 64 for MQTT and Kafka, and none for other addresses";
            return Err(Error::invalid("topics", rule));
        }
        for topic in &self.topics {
            check_text("topics", topic, 1_024)?;
            if address.scheme.is_kafka() && !is_kafka_topic(topic) {
                return Err(Error::invalid("topics", KAFKA_TOPIC_RULE));
            }
        }
        check_username(self.username.as_deref())?;
        check_sasl(self.sasl_mechanism, address.scheme, self.username.as_deref())?;
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
        if address.scheme == Scheme::Gpsd && self.format != MessageFormat::Gpsd {
            return Err(Error::invalid("format", "must be gpsd for an address of gpsd:"));
        }
        if address.scheme.is_rtsp() && self.format != MessageFormat::Onvif {
            return Err(Error::invalid("format", "must be onvif for an address of rtsp: or rtsps:"));
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
        let is_pushed = self.address().is_ok_and(|address| address.scheme == Scheme::Push);
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
        Address::parse(&self.address, Scheme::SINKS)
    }

    fn check(&self) -> Result<()> {
        let scheme = self.address()?.scheme;
        let writes_files = scheme == Scheme::File;
        if writes_files != self.format.track_file().is_some() {
            return Err(Error::invalid(
                "format",
                "must be gpx or kml for the address file:, and for no other",
            ));
        }
        if self.format == OutgoingFormat::HomeAssistant && !scheme.is_mqtt() {
            return Err(Error::invalid("format", "can be home_assistant for addresses of MQTT alone"));
        }
        check_username(self.username.as_deref())?;
        check_sasl(self.sasl_mechanism, scheme, self.username.as_deref())?;
        if self.camera_ids.is_empty() {
            return Err(Error::invalid("camera_ids", "must name the cameras whose tracks are sent"));
        }
        self.cameras()?;
        if let Some(topic) = &self.topic {
            check_text("topic", topic, 1_024)?;
            let wildcards: &[char] = if scheme == Scheme::Nats { &[' ', '*', '>'] } else { &['+', '#'] };
            if topic.contains(wildcards) {
                return Err(Error::invalid("topic", "must not contain wildcards"));
            }
            // With the longest ids.
            let longest = topic.replace("{camera}", &"c".repeat(63)).replace("{target}", &"t".repeat(128));
            if scheme.is_kafka() && !is_kafka_topic(&longest) {
                return Err(Error::invalid("topic", KAFKA_TOPIC_RULE));
            }
        }
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

    /// Where a target's position goes: its topic, its subject in NATS, or `TOPIC/KEY` in Kafka, whose keys are
    /// `CAMERA/TARGET`. Characters of the target's id that topics cannot have, or that separate their levels, become `_`.
    #[must_use]
    pub fn topic_of(&self, camera: &CameraId, target: &TargetId) -> String {
        let scheme = self.address.split_once(':').map_or("", |(scheme, _)| scheme);
        let (default, special): (&str, fn(char) -> bool) = match scheme {
            "nats" => ("sightfix.{camera}.{target}", |it| " .*>".contains(it)),
            "kafka" | "kafkas" => ("sightfix", |it| !is_kafka_character(it)),
            _ => ("sightfix/{camera}/{target}", |it| "/+#".contains(it)),
        };
        let template = self.topic.as_deref().unwrap_or(default);
        let level = target.as_str().replace(special, "_");
        let topic = template.replace("{camera}", camera.as_str()).replace("{target}", &level);
        if scheme.starts_with("kafka") { format!("{topic}/{camera}/{target}") } else { topic }
    }
}

/// The rule for names of topics in Kafka.
const KAFKA_TOPIC_RULE: &str = "must be 1 to 249 letters, digits, dots, hyphens and underscores for Kafka";

const fn is_kafka_character(it: char) -> bool {
    it.is_ascii_alphanumeric() || matches!(it, '.' | '-' | '_')
}

fn is_kafka_topic(name: &str) -> bool {
    (1..=249).contains(&name.len()) && name.chars().all(is_kafka_character) && !matches!(name, "." | "..")
}

fn check_sasl(mechanism: Option<SaslMechanism>, scheme: Scheme, username: Option<&str>) -> Result<()> {
    if mechanism.is_some() && (!scheme.is_kafka() || username.is_none()) {
        return Err(Error::invalid("sasl_mechanism", "is for Kafka with a username"));
    }
    Ok(())
}

fn cameras(ids: &[String]) -> Result<Vec<CameraId>> {
    if ids.len() > MAX_CAMERAS {
        return Err(Error::invalid("camera_ids", "must be at most 1,024"));
    }
    let camera = |id: &String| CameraId::new(id).map_err(|error| error.at("camera_ids"));
    ids.iter().map(camera).collect()
}

fn check_username(username: Option<&str>) -> Result<()> {
    username.map_or(Ok(()), |name| check_text("username", name, 256))
}
