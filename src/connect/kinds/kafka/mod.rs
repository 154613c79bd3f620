//! Kafka: a source of topics, and a sink.
//!
//! A source reads every partition of its topics, and the store keeps the offset
//! after the last message whose content is stored: what came after it is read again after a crash. A new source begins
//! with the messages that come from then on; partitions that are added later are read from their beginning. A sink counts
//! a message as delivered when all replicas in sync have it.
//!
//! There is one connection to each broker that leads partitions. Any failure, a change of leaders too, ends all of them, and the
//! connection as a whole is opened again.

mod batch;
mod broker;
mod decompress;
mod fields;
mod requests;
mod sink;
mod source;

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::sync::Mutex;

use self::broker::{Broker, Dialer};
use self::requests::{BrokerEntry, ErrorCode, Metadata, TopicEntry};
use crate::connect::credentials::{Credentials, PeerError};
use crate::exchange::Address;

pub(super) use sink::KafkaSink;
pub(super) use source::SourceReader;

/// Partitions that a connection may read, and topics and brokers that it may keep for writing.
const MAX_PARTITIONS: usize = 256;
/// How often the brokers are asked for their topics.
const LOOK_EVERY: Duration = Duration::from_secs(10);
/// How long, and how often, a topic without leaders is waited for.
const NEW_TOPIC_PAUSE: Duration = Duration::from_millis(200);
const NEW_TOPIC_TRIES: u32 = 5;

/// Host and port of a broker.
type Node = (String, u16);
/// The leaders of a topic by partition.
type Leaders = BTreeMap<i32, Node>;
/// The leaders of topics.
type Topics = BTreeMap<String, Leaders>;

/// An open connection to a cluster.
pub(super) struct Brokers {
    dialer: Dialer,
    /// The connection by which topics are asked for, to any broker.
    any: Mutex<Broker>,
}

impl Brokers {
    /// Connects to the first broker of the address that can be reached.
    pub(super) async fn open(
        address: &Address,
        credentials: &Credentials<'_>,
        client_id: &str,
    ) -> Result<Self, PeerError> {
        let dialer = Dialer::new(address, credentials, client_id)?;
        let first = (address.host.clone(), address.port);
        let mut opened = dialer.open(&first).await;
        for other in &address.others {
            if opened.is_err() {
                opened = dialer.open(other).await;
            }
        }
        let any = Mutex::new(opened?);
        Ok(Self { dialer, any })
    }

    /// The leaders of topics, which are created if the cluster creates topics by itself.
    async fn leaders(&self, topics: &[&str]) -> Result<Topics, PeerError> {
        let mut tries = 0;
        loop {
            let (brokers, entries) = self.any.lock().await.ask(&Metadata { topics }).await?;
            tries += 1;
            match leaders_of(&brokers, entries) {
                Ok(leaders) => return Ok(leaders),
                Err((_, error)) if error.is_of_new_topic() && tries < NEW_TOPIC_TRIES => {
                    tokio::time::sleep(NEW_TOPIC_PAUSE).await;
                }
                Err((topic, error)) => return Err(PeerError(format!("the topic {topic}: {error}"))),
            }
        }
    }

    /// Completes when the brokers cannot be reached, or when a topic has no longer the leaders that are known.
    async fn watch(&self, known: &Topics) -> PeerError {
        let names: Vec<&str> = known.keys().map(String::as_str).collect();
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            match self.leaders(&names).await {
                Ok(leaders) if leaders == *known => {}
                Ok(_) => return "the partitions of topics, or their leaders, have changed".into(),
                Err(error) => return error,
            }
        }
    }
}

/// The leaders of topics by a broker's answer, or the topic that has none with the reason.
fn leaders_of(brokers: &[BrokerEntry], topics: Vec<TopicEntry>) -> Result<Topics, (String, ErrorCode)> {
    let node = |leader: i32| {
        let broker = brokers.iter().find(|broker| broker.id == leader);
        let node = broker.and_then(|broker| Some((broker.host.clone(), broker.port.try_into().ok()?)));
        node.ok_or(ErrorCode::LEADER_NOT_AVAILABLE)
    };
    let leaders = |topic: &TopicEntry| {
        topic.error.check()?;
        topic.leaders.iter().map(|(partition, leader)| Ok((*partition, node(*leader)?))).collect()
    };
    let known = |topic: TopicEntry| match leaders(&topic) {
        Ok(leaders) => Ok((topic.name, leaders)),
        Err(error) => Err((topic.name, error)),
    };
    topics.into_iter().map(known).collect()
}
