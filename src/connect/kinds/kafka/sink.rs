//! A sink of Kafka.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use futures_util::future::BoxFuture;
use tokio_util::task::AbortOnDropHandle;

use super::batch::{NewRecord, encode};
use super::broker::Broker;
use super::requests::{ErrorCode, Produce};
use super::{Brokers, Leaders, MAX_PARTITIONS, Node, Topics};
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::sink::{Outcomes, Sink};
use crate::domain::OutboxMessage;
use crate::exchange::Address;

/// How long a broker waits for its replicas.
const REPLICAS_WAIT_MS: i32 = 5_000;

/// Writes messages with the key of their target, so that those of a target stay in order.
pub(in crate::connect) struct KafkaSink {
    brokers: Arc<Brokers>,
    media_type: &'static str,
    topics: HashMap<String, Leaders>,
    leaders: HashMap<Node, Broker>,
    /// Ends when the brokers cannot be reached.
    watching: AbortOnDropHandle<PeerError>,
}

/// Topic and key of a message.
fn destination(message: &OutboxMessage) -> (&str, &str) {
    message.subject.split_once('/').unwrap_or((&message.subject, ""))
}

/// The partition of a key, as the default of librdkafka's producers has it.
fn partition_of(key: &str, partitions: &Leaders) -> Option<i32> {
    let count = u32::try_from(partitions.len()).ok().filter(|count| *count > 0)?;
    partitions.keys().nth((crc32fast::hash(key.as_bytes()) % count) as usize).copied()
}

impl KafkaSink {
    pub(in crate::connect) async fn open(
        address: &Address,
        credentials: &Credentials<'_>,
        client_id: &str,
        media_type: &'static str,
    ) -> Result<Self, PeerError> {
        let brokers = Arc::new(Brokers::open(address, credentials, client_id).await?);
        let watched = brokers.clone();
        let watching = tokio::spawn(async move { watched.watch(&Topics::new()).await });
        Ok(Self {
            brokers,
            media_type,
            topics: HashMap::new(),
            leaders: HashMap::new(),
            watching: AbortOnDropHandle::new(watching),
        })
    }

    /// The partition that a message belongs to.
    async fn route(&mut self, topic: &str, key: &str) -> Result<i32, PeerError> {
        if self.topics.len() >= MAX_PARTITIONS {
            self.topics.clear();
        }
        if !self.topics.contains_key(topic) {
            self.topics.extend(self.brokers.leaders(&[topic]).await?);
        }
        let partition = self.topics.get(topic).and_then(|leaders| partition_of(key, leaders));
        partition.ok_or_else(|| PeerError(format!("the topic {topic} has no partitions")))
    }

    /// The connection to the leader of a partition.
    async fn leader(&mut self, topic: &str, partition: i32) -> Result<&mut Broker, PeerError> {
        let node = self.topics.get(topic).and_then(|leaders| leaders.get(&partition)).cloned();
        let node = node.ok_or("the partition has no leader")?;
        if self.leaders.len() >= MAX_PARTITIONS {
            self.leaders.clear();
        }
        Ok(match self.leaders.entry(node) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => {
                let broker = self.brokers.dialer.open(new.key()).await?;
                new.insert(broker)
            }
        })
    }

    async fn write(
        &mut self,
        topic: &str,
        partition: i32,
        messages: &[&OutboxMessage],
    ) -> Result<Result<(), ErrorCode>, PeerError> {
        let records: Vec<NewRecord<'_>> = messages.iter().map(|message| self.record(message)).collect();
        let batch = encode(&records);
        let request = Produce { topic, partition, batch: &batch, timeout_ms: REPLICAS_WAIT_MS };
        let answer = self.leader(topic, partition).await?.ask(&request).await?;
        answer.first().map(|error| error.check()).ok_or_else(|| "the broker answered nothing".into())
    }

    fn record<'a>(&self, message: &'a OutboxMessage) -> NewRecord<'a> {
        NewRecord {
            time_ms: message.created_at.as_millisecond(),
            key: destination(message).1,
            value: &message.payload,
            headers: [("content-type", self.media_type), ("message-id", &message.message_id)],
        }
    }

    /// Writes messages of a partition. Those of a batch that is refused are written one by one, to find the cause.
    async fn deliver_to(
        &mut self,
        topic: &str,
        partition: i32,
        messages: &[&OutboxMessage],
        outcomes: &mut Outcomes,
    ) -> Result<(), PeerError> {
        let mut batches = vec![messages];
        while let Some(batch) = batches.pop() {
            match self.write(topic, partition, batch).await? {
                Ok(()) => outcomes.extend(batch.iter().map(|message| (message.number, Ok(())))),
                Err(error) if !error.is_refusal() => return Err(error.into()),
                Err(error) => match batch {
                    [message] => {
                        outcomes.push((message.number, Err(format!("the broker refuses it: {error}"))))
                    }
                    _ => batches.extend(batch.chunks(1).rev()),
                },
            }
        }
        Ok(())
    }
}

impl Sink for KafkaSink {
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            let mut batches: BTreeMap<(&str, i32), Vec<&OutboxMessage>> = BTreeMap::new();
            for message in messages {
                let (topic, key) = destination(message);
                let partition = self.route(topic, key).await?;
                batches.entry((topic, partition)).or_default().push(message);
            }
            for ((topic, partition), batch) in batches {
                self.deliver_to(topic, partition, &batch, outcomes).await?;
            }
            Ok(())
        })
    }

    fn failed(&mut self) -> BoxFuture<'_, PeerError> {
        Box::pin(async {
            if self.watching.is_finished() {
                return "the brokers cannot be reached".into();
            }
            (&mut self.watching).await.unwrap_or_else(|panic| PeerError(panic.to_string()))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Partitions that `kcat -P -k KEY -X partitioner=consistent` chose among four.
    #[test]
    fn keys_go_to_the_partitions_of_librdkafka() {
        let partitions = (0..4).map(|partition| (partition, Node::default())).collect();
        for (key, expected) in [("gate/person-1", 1), ("gate/7", 2), ("gate/van", 3), ("yard/a", 3)] {
            assert_eq!(partition_of(key, &partitions), Some(expected), "{key}");
        }
        assert_eq!(partition_of("any", &Leaders::new()), None);
    }
}
