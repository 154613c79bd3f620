//! Kafka: a source of topics, and a sink.
//!
//! The library has no consumer groups. A source reads every partition of its topics, and the store keeps the offset
//! after the last message whose content is stored: what came after it is read again after a crash. A new source begins
//! with the messages that come from then on; partitions that are added later are read from their beginning. A sink counts
//! a message as delivered when all replicas in sync have it.

mod sink;
mod source;

use std::collections::BTreeMap;
use std::time::Duration;

use rskafka::BackoffConfig;
use rskafka::client::error::{Error, ProtocolError};
use rskafka::client::partition::{PartitionClient, UnknownTopicHandling};
use rskafka::client::{Client, ClientBuilder, Credentials as UserAndPassword, SaslConfig};

use super::credentials::{Credentials, PeerError};
use super::peer::{OPEN_TIME, within};
use super::tls;
use crate::exchange::{Address, SaslMechanism, Scheme, bracketed};

pub(super) use sink::KafkaSink;
pub(super) use source::SourceReader;

/// Largest answer of a broker that is read, bytes. A broker sends at least one batch of records, however large it is.
const MAX_ANSWER_BYTES: usize = 64 << 20;
/// Partitions that a connection may read, or keep open for writing; each has a TCP connection of its own.
const MAX_PARTITIONS: usize = 256;
/// How often the brokers are asked for their topics.
const LOOK_EVERY: Duration = Duration::from_secs(10);

impl From<Error> for PeerError {
    fn from(error: Error) -> Self {
        Self(error.to_string())
    }
}

/// Partitions by topic.
type Topics = BTreeMap<String, Vec<i32>>;

/// An open connection to a cluster.
pub(super) struct Brokers {
    client: Client,
}

impl Brokers {
    pub(super) async fn open(
        address: &Address,
        credentials: &Credentials<'_>,
        client_id: &str,
    ) -> Result<Self, PeerError> {
        let first = (&address.host, &address.port);
        let hosts = std::iter::once(first).chain(address.others.iter().map(|(host, port)| (host, port)));
        let hosts = hosts.map(|(host, port)| format!("{}:{port}", bracketed(host)));
        // The connection as a whole is opened again with growing pauses; here only changes of leaders are waited for.
        let backoff = BackoffConfig {
            init_backoff: Duration::from_millis(100),
            max_backoff: Duration::from_millis(500),
            base: 2.0,
            deadline: Some(Duration::from_secs(1)),
        };
        let mut builder = ClientBuilder::new(hosts.collect())
            .client_id(client_id)
            .max_message_size(MAX_ANSWER_BYTES)
            .backoff_config(backoff);
        if address.scheme == Scheme::Kafkas {
            builder = builder.tls_config(tls::peer_config(credentials)?);
        }
        if let Some(username) = credentials.username {
            let password = credentials.secrets.get("password").unwrap_or_default();
            let user = UserAndPassword::new(username.to_owned(), password.to_owned());
            builder = builder.sasl_config(match credentials.sasl_mechanism {
                None | Some(SaslMechanism::Plain) => SaslConfig::Plain(user),
                Some(SaslMechanism::ScramSha256) => SaslConfig::ScramSha256(user),
                Some(SaslMechanism::ScramSha512) => SaslConfig::ScramSha512(user),
            });
        }
        let client = within(OPEN_TIME, async { Ok(builder.build().await?) }).await?;
        Ok(Self { client })
    }

    async fn topics(&self) -> Result<Topics, PeerError> {
        let topics = within(OPEN_TIME, async { Ok(self.client.list_topics().await?) }).await?;
        Ok(topics.into_iter().map(|topic| (topic.name, topic.partitions.into_iter().collect())).collect())
    }

    /// The partitions of a topic, which is created if the cluster creates topics by itself.
    async fn partitions(&self, topic: &str) -> Result<Vec<i32>, PeerError> {
        if let Some(partitions) = self.topics().await?.remove(topic) {
            return Ok(partitions);
        }
        // Asking for the leader of a partition has the cluster create the topic.
        let created = within(OPEN_TIME, async { Ok(self.partition(topic, 0).await?) }).await;
        let partitions = self.topics().await?.remove(topic);
        partitions.ok_or_else(|| match created {
            Err(error) => PeerError(format!("the topic {topic} does not exist: {error}")),
            Ok(_) => PeerError(format!("the topic {topic} does not exist yet")),
        })
    }

    async fn partition(&self, topic: &str, partition: i32) -> Result<PartitionClient, Error> {
        self.client.partition_client(topic, partition, UnknownTopicHandling::Error).await
    }

    /// Completes when the brokers cannot be reached, or when a topic has no longer the partitions that are known.
    async fn watch(&self, known: &Topics) -> PeerError {
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            let topics = match self.topics().await {
                Ok(topics) => topics,
                Err(error) => return error,
            };
            let changed = known.iter().find(|(name, partitions)| topics.get(*name) != Some(*partitions));
            if let Some((name, _)) = changed {
                return PeerError(format!("the partitions of the topic {name} have changed"));
            }
        }
    }
}

/// The broker's error code, if a broker answered.
const fn answer_of(error: &Error) -> Option<ProtocolError> {
    match error {
        Error::ServerError { protocol_error, .. } => Some(*protocol_error),
        _ => None,
    }
}
