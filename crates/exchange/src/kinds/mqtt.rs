//! Brokers of MQTT.

use super::fields::{Login, SinkFields, SourceFields};
use super::topic::Topic;
use crate::address::{Address, Scheme};
use crate::domain::Result;

pub(super) const SCHEMES: &[Scheme] =
    &[Scheme::host("mqtt", Some(1883)), Scheme::host("mqtts", Some(8883)).encrypted()];
/// The topic of positions if the settings name none.
pub(super) const DEFAULT_TOPIC: &str = "sightfix/{camera}/{target}";
/// That of events of places.
pub(super) const DEFAULT_EVENT_TOPIC: &str = "sightfix/events/{place}";

/// A subscription.
#[derive(Debug, Clone)]
pub struct MqttSource {
    /// The broker.
    pub address: Address,
    /// Topics with the wildcards of MQTT.
    pub topics: Vec<String>,
    /// The user there.
    pub login: Login,
}

impl MqttSource {
    pub(super) fn new(address: Address, fields: &mut SourceFields) -> Result<Self> {
        Ok(Self { address, topics: fields.take_topics(|_| Ok(()))?, login: fields.login.take()? })
    }
}

/// A publisher.
#[derive(Debug, Clone)]
pub struct MqttSink {
    /// The broker.
    pub address: Address,
    /// The topic of each position.
    pub topic: Topic,
    /// The user there.
    pub login: Login,
}

impl MqttSink {
    pub(super) fn new(address: Address, fields: &mut SinkFields) -> Result<Self> {
        let topic = fields.take_topic(DEFAULT_TOPIC, DEFAULT_EVENT_TOPIC);
        let topic = Topic::of_levels(topic, &['+', '#'], is_special)?;
        Ok(Self { address, topic, login: fields.login.take()? })
    }
}

/// True for wildcards, and for what separates levels.
pub(super) fn is_special(it: char) -> bool {
    matches!(it, '/' | '+' | '#')
}
