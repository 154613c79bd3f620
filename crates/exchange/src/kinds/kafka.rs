//! Clusters of Kafka.

use super::fields::{Login, LoginFields, SaslMechanism, SinkFields, SourceFields};
use super::topic::Topic;
use crate::address::{Address, Scheme};
use crate::domain::{Error, Result};

pub(super) const SCHEMES: &[Scheme] =
    &[Scheme::hosts("kafka", 9092), Scheme::hosts("kafkas", 9093).encrypted()];

/// A consumer.
#[derive(Debug, Clone)]
pub struct KafkaSource {
    /// The brokers.
    pub address: Address,
    /// Topics that are read.
    pub topics: Vec<String>,
    /// The user there.
    pub login: Login,
    /// How the user signs in; `plain` if there is none.
    pub sasl_mechanism: Option<SaslMechanism>,
}

impl KafkaSource {
    pub(super) fn new(address: Address, fields: &mut SourceFields) -> Result<Self> {
        let topics = fields.take_topics(|topic| check_topic("topics", topic))?;
        let (login, sasl_mechanism) = take_login(&mut fields.login)?;
        Ok(Self { address, topics, login, sasl_mechanism })
    }
}

/// A producer.
#[derive(Debug, Clone)]
pub struct KafkaSink {
    /// The brokers.
    pub address: Address,
    /// The topic of each position, whose key is `CAMERA/TARGET`, or of each event, whose key is the place.
    pub topic: Topic,
    /// The user there.
    pub login: Login,
    /// How the user signs in; `plain` if there is none.
    pub sasl_mechanism: Option<SaslMechanism>,
}

impl KafkaSink {
    pub(super) fn new(address: Address, fields: &mut SinkFields) -> Result<Self> {
        let topic = fields.take_topic("sightfix", "sightfix");
        let topic = Topic::with_keys(topic, |it| !is_name_character(it), |it| check_topic("topic", it))?;
        let (login, sasl_mechanism) = take_login(&mut fields.login)?;
        Ok(Self { address, topic, login, sasl_mechanism })
    }
}

fn take_login(fields: &mut LoginFields) -> Result<(Login, Option<SaslMechanism>)> {
    let login = fields.take()?;
    let sasl_mechanism = fields.sasl_mechanism.take();
    if sasl_mechanism.is_some() && login.username.is_none() {
        return Err(Error::invalid("sasl_mechanism", "is for Kafka with a username"));
    }
    Ok((login, sasl_mechanism))
}

const fn is_name_character(it: char) -> bool {
    it.is_ascii_alphanumeric() || matches!(it, '.' | '-' | '_')
}

fn check_topic(field: &str, name: &str) -> Result<()> {
    let is_name =
        (1..=249).contains(&name.len()) && name.chars().all(is_name_character) && !matches!(name, "." | "..");
    let rule = "must be 1 to 249 letters, digits, dots, hyphens and underscores for Kafka";
    if is_name { Ok(()) } else { Err(Error::invalid(field, rule)) }
}
