//! A sink of Kafka.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use futures_util::future::BoxFuture;
use rskafka::chrono::DateTime;
use rskafka::client::error::{Error, ProtocolError};
use rskafka::client::partition::{Compression, PartitionClient};
use rskafka::record::Record;
use tokio_util::task::AbortOnDropHandle;

use super::{Brokers, MAX_PARTITIONS, Topics, answer_of};
use crate::connect::credentials::{Credentials, PeerError};
use crate::connect::peer::{OPEN_TIME, within};
use crate::connect::sink::{Outcomes, Sink};
use crate::domain::OutboxMessage;
use crate::exchange::Address;

/// Writes messages with the key of their target, so that those of a target stay in order.
pub(in crate::connect) struct KafkaSink {
    brokers: Arc<Brokers>,
    media_type: &'static str,
    /// Numbers of partitions by topic.
    topics: HashMap<String, Vec<i32>>,
    partitions: HashMap<(String, i32), PartitionClient>,
    /// Ends when the brokers cannot be reached.
    watching: AbortOnDropHandle<PeerError>,
}

/// Topic and key of a message.
fn destination(message: &OutboxMessage) -> (&str, &str) {
    message.subject.split_once('/').unwrap_or((&message.subject, ""))
}

/// The partition of a key, as the default of librdkafka's producers has it.
fn partition_of(key: &str, partitions: &[i32]) -> Option<i32> {
    let count = u32::try_from(partitions.len()).ok().filter(|count| *count > 0)?;
    partitions.get((crc32fast::hash(key.as_bytes()) % count) as usize).copied()
}

/// True if a broker will never take what it has refused.
const fn is_refusal(answer: ProtocolError) -> bool {
    matches!(
        answer,
        ProtocolError::MessageTooLarge
            | ProtocolError::RecordListTooLarge
            | ProtocolError::InvalidTopicException
            | ProtocolError::InvalidTimestamp
            | ProtocolError::InvalidRecord
    )
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
            partitions: HashMap::new(),
            watching: AbortOnDropHandle::new(watching),
        })
    }

    /// The partition that a message belongs to.
    async fn route(&mut self, topic: &str, key: &str) -> Result<i32, PeerError> {
        if self.topics.len() >= MAX_PARTITIONS || self.partitions.len() >= MAX_PARTITIONS {
            self.topics.clear();
            self.partitions.clear();
        }
        if !self.topics.contains_key(topic) {
            let numbers = self.brokers.partitions(topic).await?;
            self.topics.insert(topic.to_owned(), numbers);
        }
        let numbers = self.topics.get(topic).map_or(&[][..], Vec::as_slice);
        let partition = partition_of(key, numbers);
        partition.ok_or_else(|| PeerError(format!("the topic {topic} has no partitions")))
    }

    async fn write(&mut self, topic: &str, partition: i32, messages: &[&OutboxMessage]) -> Result<(), Error> {
        let place = (topic.to_owned(), partition);
        if !self.partitions.contains_key(&place) {
            let client = self.brokers.partition(topic, partition).await?;
            self.partitions.insert(place.clone(), client);
        }
        let records = messages.iter().map(|message| self.record(message)).collect();
        match self.partitions.get(&place) {
            Some(client) => client.produce(records, Compression::NoCompression).await.map(drop),
            None => Ok(()),
        }
    }

    fn record(&self, message: &OutboxMessage) -> Record {
        let headers = [("message-id", message.message_id.as_str()), ("content-type", self.media_type)];
        Record {
            key: Some(destination(message).1.as_bytes().to_vec()),
            value: Some(message.payload.clone()),
            headers: headers.map(|(name, value)| (name.to_owned(), value.as_bytes().to_vec())).into(),
            timestamp: DateTime::from_timestamp_micros(message.created_at.as_microsecond())
                .unwrap_or_default(),
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
            let written = async { Ok(self.write(topic, partition, batch).await) };
            match within(OPEN_TIME, written).await? {
                Ok(()) => outcomes.extend(batch.iter().map(|message| (message.number, Ok(())))),
                Err(error) if !answer_of(&error).is_some_and(is_refusal) => return Err(error.into()),
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
        let partitions = [0, 1, 2, 3];
        for (key, expected) in [("gate/person-1", 1), ("gate/7", 2), ("gate/van", 3), ("yard/a", 3)] {
            assert_eq!(partition_of(key, &partitions), Some(expected), "{key}");
        }
        assert_eq!(partition_of("any", &[]), None);
    }
}
