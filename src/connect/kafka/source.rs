//! A source of topics of Kafka.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use rskafka::client::error::ProtocolError;
use rskafka::client::partition::{OffsetAt, PartitionClient};
use tokio::task::JoinSet;

use super::{Brokers, MAX_PARTITIONS, Topics, answer_of};
use crate::config::Limits;
use crate::connect::credentials::PeerError;
use crate::connect::inbox::{Inlet, Outlet, inbox};
use crate::connect::peer::{OPEN_TIME, within};
use crate::connect::source::{Message, Settled, Source};
use crate::domain::{ConnectionKey, Durability, SourceOffset};
use crate::store::Store;

/// Records that a broker sends at a time, bytes, over all partitions at most what a source may hold; a larger batch comes
/// whole.
const FETCH_BYTES: std::ops::RangeInclusive<usize> = 16 << 10..=256 << 10;
/// Bytes of a message that is too large which are kept for the status.
const KEPT_BYTES: usize = 4 << 10;
/// How long a broker waits for records.
const FETCH_WAIT: Duration = Duration::from_millis(500);

/// A record of a topic, read from a partition.
struct PartitionRecord {
    /// Index into [`KafkaSource::partitions`].
    partition: usize,
    offset: i64,
    /// Its beginning alone where it is larger than is taken.
    value: Vec<u8>,
    size_bytes: usize,
}

impl PartitionRecord {
    fn new(partition: usize, offset: i64, mut value: Vec<u8>, most_bytes: usize) -> Self {
        let size_bytes = value.len();
        if size_bytes > most_bytes {
            value.truncate(KEPT_BYTES);
            value.shrink_to_fit();
        }
        Self { partition, offset, value, size_bytes }
    }
}

/// Opens sources of topics.
pub(in crate::connect) struct SourceReader {
    /// Where the offsets of a lasting source are; one that is only tried has none.
    pub(in crate::connect) offsets: Option<(Store, ConnectionKey)>,
    /// How much may be read ahead.
    pub(in crate::connect) limits: Limits,
}

impl SourceReader {
    pub(in crate::connect) async fn open(
        self,
        brokers: Brokers,
        topics: BTreeSet<String>,
    ) -> Result<KafkaSource, PeerError> {
        let stored = match &self.offsets {
            Some((store, key)) => store.source_offsets(*key).await?,
            None => Vec::new(),
        };
        let Limits { connection_queue, connection_queue_bytes, .. } = self.limits;
        let (records_in, records) = inbox(connection_queue, connection_queue_bytes);
        let (mut known, mut partitions, mut readers) = (Topics::new(), Vec::new(), Vec::new());
        for topic in topics {
            let numbers = brokers.partitions(&topic).await?;
            if partitions.len() + numbers.len() > MAX_PARTITIONS {
                return Err(PeerError(format!("the topics have more than {MAX_PARTITIONS} partitions")));
            }
            for partition in numbers.clone() {
                let opening = async { Ok(brokers.partition(&topic, partition).await?) };
                let client = within(OPEN_TIME, opening).await?;
                let next_offset = match first_offset(&stored, &topic, partition) {
                    Ok(stored) => stored,
                    Err(at) => within(OPEN_TIME, async { Ok(client.get_offset(at).await?) }).await?,
                };
                partitions.push(SourceOffset { topic: topic.clone(), partition, next_offset });
                readers.push(client);
            }
            known.insert(topic, numbers);
        }
        // Before anything is read: what comes between a crash and the next start must be found.
        if let Some((store, key)) = &self.offsets {
            store.store_source_offsets(*key, &partitions, Durability::Synced).await?;
        }
        let share = connection_queue_bytes / partitions.len().max(1);
        let size = FetchSize {
            fetch_bytes: share.clamp(*FETCH_BYTES.start(), *FETCH_BYTES.end()) as i32,
            message_bytes: self.limits.connection_message_bytes,
        };
        let mut reading = JoinSet::new();
        for (index, (client, from)) in readers.into_iter().zip(&partitions).enumerate() {
            reading.spawn(read(client, index, from.next_offset, size, records_in.clone()));
        }
        reading.spawn(async move { brokers.watch(&known).await });
        Ok(KafkaSource {
            records,
            reading,
            partitions,
            unsettled: HashMap::new(),
            last_receipt: 0,
            offsets: self.offsets,
        })
    }
}

/// Where the reading of a partition begins: at the stored offset, or at an end of the partition, whose offset the broker
/// knows.
fn first_offset(stored: &[SourceOffset], topic: &str, partition: i32) -> Result<i64, OffsetAt> {
    let of_topic = || stored.iter().filter(|it| it.topic == topic);
    match of_topic().find(|it| it.partition == partition) {
        Some(known) => Ok(known.next_offset),
        None if of_topic().next().is_some() => Err(OffsetAt::Earliest),
        None => Err(OffsetAt::Latest),
    }
}

/// How much is read at a time.
#[derive(Clone, Copy)]
struct FetchSize {
    /// Bytes of one answer of a broker.
    fetch_bytes: i32,
    /// Bytes of a message that is taken.
    message_bytes: usize,
}

/// Hands on the records of a partition; ends with the reason.
async fn read(
    client: PartitionClient,
    partition: usize,
    mut offset: i64,
    size: FetchSize,
    records: Inlet<PartitionRecord>,
) -> PeerError {
    let wait_ms = i32::try_from(FETCH_WAIT.as_millis()).unwrap_or(i32::MAX);
    loop {
        let fetching = client.fetch_records(offset, 1..size.fetch_bytes, wait_ms);
        let fetched = match tokio::time::timeout(FETCH_WAIT + OPEN_TIME, fetching).await {
            Ok(fetched) => fetched,
            Err(_) => return "the broker does not answer".into(),
        };
        let (read, end) = match fetched {
            Ok(fetched) => fetched,
            Err(error) if answer_of(&error) == Some(ProtocolError::OffsetOutOfRange) => {
                match oldest_offset(&client, offset).await {
                    Ok(oldest) => offset = oldest,
                    Err(error) => return error,
                }
                continue;
            }
            Err(error) => return error.into(),
        };
        if read.is_empty() && end > offset {
            // The end of a transaction is sent at once and has no records.
            tokio::time::sleep(FETCH_WAIT).await;
        }
        for it in read {
            offset = it.offset + 1;
            let value = it.record.value.unwrap_or_default();
            let record = PartitionRecord::new(partition, it.offset, value, size.message_bytes);
            let bytes = record.value.len();
            if !records.put(record, bytes).await {
                return "the source is closed".into();
            }
        }
    }
}

/// Where a partition begins that has no longer, or not yet, the message at an offset.
async fn oldest_offset(client: &PartitionClient, missing: i64) -> Result<i64, PeerError> {
    let oldest = within(OPEN_TIME, async { Ok(client.get_offset(OffsetAt::Earliest).await?) }).await?;
    if oldest == missing {
        return Err(PeerError(format!("the broker has no message at its own oldest offset {oldest}")));
    }
    let (topic, partition) = (client.topic(), client.partition());
    tracing::warn!(
        topic,
        partition,
        missing,
        oldest,
        "the broker has deleted messages; reading continues with the oldest that it has"
    );
    Ok(oldest)
}

/// Messages of topics.
pub(in crate::connect) struct KafkaSource {
    records: Outlet<PartitionRecord>,
    /// A task for each partition, and one that watches the topics; each ends only when it fails.
    reading: JoinSet<PeerError>,
    /// How far each partition was read when it was opened; its index identifies it.
    partitions: Vec<SourceOffset>,
    /// Partition and offset by receipt.
    unsettled: HashMap<u64, (usize, i64)>,
    last_receipt: u64,
    offsets: Option<(Store, ConnectionKey)>,
}

impl Source for KafkaSource {
    fn next(&mut self) -> BoxFuture<'_, Result<Message, PeerError>> {
        Box::pin(async {
            let record = tokio::select! {
                Some((record, _held)) = self.records.recv() => record,
                Some(ended) = self.reading.join_next() => {
                    return Err(ended.unwrap_or_else(|panic| PeerError(panic.to_string())));
                }
                else => return Err("nothing is read any more".into()),
            };
            self.last_receipt += 1;
            self.unsettled.insert(self.last_receipt, (record.partition, record.offset));
            let subject = self.partitions[record.partition].topic.clone();
            let (payload, size_bytes) = (Bytes::from(record.value), record.size_bytes);
            Ok(Message { receipt: self.last_receipt, subject, payload, size_bytes })
        })
    }

    fn settle(&mut self, settled: Vec<Settled>) -> BoxFuture<'_, Result<(), PeerError>> {
        Box::pin(async move {
            // Messages of a partition are settled in its order, so the last one counts.
            let mut next_offsets = BTreeMap::new();
            for Settled { receipt, .. } in settled {
                if let Some((partition, offset)) = self.unsettled.remove(&receipt) {
                    next_offsets.insert(partition, offset + 1);
                }
            }
            let Some((store, key)) = &self.offsets else { return Ok(()) };
            let changed: Vec<SourceOffset> = next_offsets
                .into_iter()
                .map(|(index, next_offset)| SourceOffset { next_offset, ..self.partitions[index].clone() })
                .collect();
            Ok(store.store_source_offsets(*key, &changed, Durability::Relaxed).await?)
        })
    }
}
