//! The fields of settings that only some kinds know. Each kind takes its own; what is left is refused.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::domain::{Error, Result, check_text};
use crate::messages::MessageFormat;
use crate::track_files::TrackFileFormat;

/// Topics that a source may subscribe to.
const MAX_TOPICS: usize = 64;

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

/// The contents of a sink's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SinkContent {
    /// Positions of targets.
    #[default]
    Positions,
    /// Events of places, in the format `json`.
    PlaceEvents,
}

/// Fields of sources.
pub(crate) struct SourceFields {
    pub(crate) format: MessageFormat,
    pub(crate) topics: Vec<String>,
    pub(crate) login: LoginFields,
}

/// Fields of sinks.
pub(crate) struct SinkFields {
    /// The format of its files, if its messages are rows of files.
    pub(crate) track_file: Option<TrackFileFormat>,
    pub(crate) content: SinkContent,
    pub(crate) topic: Option<String>,
    pub(crate) multicast_ttl: Option<u8>,
    pub(crate) rotate_s: Option<f64>,
    pub(crate) jetstream: bool,
    pub(crate) login: LoginFields,
}

/// Fields of both.
pub(crate) struct LoginFields {
    pub(crate) username: Option<String>,
    pub(crate) sasl_mechanism: Option<SaslMechanism>,
    pub(crate) ca_certificate: Option<String>,
}

/// The user at a peer, and the authority of the peer's certificate.
#[derive(Debug, Clone)]
pub struct Login {
    /// Name of the user; the secret `password` belongs to it.
    pub username: Option<String>,
    /// Authority of the peer's certificate (PEM); those of the operating system if there is none.
    pub ca_certificate: Option<String>,
}

impl SourceFields {
    /// Topics, each of which keeps a rule.
    pub(super) fn take_topics(&mut self, rule: impl Fn(&str) -> Result<()>) -> Result<Vec<String>> {
        let topics = std::mem::take(&mut self.topics);
        if !(1..=MAX_TOPICS).contains(&topics.len()) {
            return Err(Error::invalid("topics", "must be 1 to 64 for MQTT and Kafka"));
        }
        for topic in &topics {
            check_text("topics", topic, 1_024)?;
            rule(topic)?;
        }
        Ok(topics)
    }

    /// Refuses a format of messages that a kind does not have.
    pub(super) fn require_format(&self, format: MessageFormat, rule: &str) -> Result<()> {
        if self.format == format { Ok(()) } else { Err(Error::invalid("format", rule)) }
    }

    /// Refuses what no kind has taken.
    pub(super) fn refuse_rest(&self, scheme: &str) -> Result<()> {
        let topics = (!self.topics.is_empty()).then_some("topics");
        refuse(topics.or_else(|| self.login.rest()), scheme)
    }
}

impl SinkFields {
    /// The topic, or that of the content if the settings name none.
    pub(super) fn take_topic(&mut self, of_positions: &str, of_events: &str) -> String {
        let usual = match self.content {
            SinkContent::Positions => of_positions,
            SinkContent::PlaceEvents => of_events,
        };
        self.topic.take().unwrap_or_else(|| usual.to_owned())
    }

    /// Refuses what no kind has taken.
    pub(super) fn refuse_rest(&self, scheme: &str) -> Result<()> {
        if self.track_file.is_some() {
            let rule = "must be gpx or kml for the address file:, and for no other";
            return Err(Error::invalid("format", rule));
        }
        let topic = self.topic.is_some().then_some("topic");
        let ttl = self.multicast_ttl.is_some().then_some("multicast_ttl");
        let rotation = self.rotate_s.is_some().then_some("rotate_s");
        let stream = self.jetstream.then_some("jetstream");
        refuse(topic.or(ttl).or(rotation).or(stream).or_else(|| self.login.rest()), scheme)
    }
}

impl LoginFields {
    pub(super) fn take(&mut self) -> Result<Login> {
        self.username.as_deref().map_or(Ok(()), |name| check_text("username", name, 256))?;
        Ok(Login { username: self.username.take(), ca_certificate: self.ca_certificate.take() })
    }

    fn rest(&self) -> Option<&'static str> {
        let username = self.username.is_some().then_some("username");
        let mechanism = self.sasl_mechanism.is_some().then_some("sasl_mechanism");
        username.or(mechanism).or_else(|| self.ca_certificate.is_some().then_some("ca_certificate"))
    }
}

fn refuse(field: Option<&'static str>, scheme: &str) -> Result<()> {
    let message = |field| Error::invalid(field, format!("is not known for addresses of {scheme}:"));
    field.map_or(Ok(()), |field| Err(message(field)))
}
