//! Servers of NATS.

use super::fields::{Login, SinkFields};
use super::topic::Topic;
use crate::address::{Address, Scheme};
use crate::domain::Result;

pub(super) const SCHEMES: &[Scheme] =
    &[Scheme::host("nats", Some(4222)), Scheme::host("natss", Some(4222)).encrypted()];

/// A publisher.
#[derive(Debug, Clone)]
pub struct NatsSink {
    /// The server.
    pub address: Address,
    /// The subject of each position.
    pub subject: Topic,
    /// The user there; without one the secret `password` is a token.
    pub login: Login,
    /// True if a message counts as delivered when a JetStream stream has stored it.
    pub jetstream: bool,
}

impl NatsSink {
    pub(super) fn new(address: Address, fields: &mut SinkFields) -> Result<Self> {
        let subject = fields.take_topic("sightfix.{camera}.{target}", "sightfix.events.{place}");
        let subject = Topic::of_levels(subject, &[' ', '*', '>'], |it| " .*>".contains(it))?;
        let jetstream = std::mem::take(&mut fields.jetstream);
        Ok(Self { address, subject, login: fields.login.take()?, jetstream })
    }
}
