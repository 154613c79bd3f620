//! A source of topics of Kafka.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use tokio::sync::Mutex;
use tokio::task::JoinSet;

use super::batch::Batch;
use super::broker::Broker;
use super::requests::{ErrorCode, Fetch, ListOffsets, OffsetAt};
use super::{Brokers, MAX_PARTITIONS, Node, Topics};
use crate::config::Limits;
use crate::connect::credentials::PeerError;
use crate::connect::inbox::{Inlet, Outlet, inbox};
use crate::connect::peer::{OPEN_TIME, within};
use crate::connect::source::{Message, Settled, Source};
use crate::domain::{ConnectionKey, Durability, SourceOffset};
use crate::store::Store;

/// Records that a broker sends at a time, bytes; a larger batch comes whole.
const FETCH_BYTES: i32 = 1 << 20;
/// Bytes of a message that is too large which are kept for the status.
const KEPT_BYTES: usize = 4 << 10;
/// How long a broker waits for records.
const FETCH_WAIT: Duration = Duration::from_millis(500);

/// A record of a topic, read from a partition, or a batch that could not be read.
struct PartitionRecord {
    /// Index into [`KafkaSource::partitions`].
    partition: usize,
    offset: i64,
    /// Its beginning alone where it is larger than is taken.
    value: Bytes,
    size_bytes: usize,
    /// Why it could not be read.
    unread: Option<String>,
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
        let names: Vec<&str> = topics.iter().map(String::as_str).collect();
        let known = brokers.leaders(&names).await?;
        let (partitions, readers) = self.partitions(&brokers, &known, &stored).await?;
        // Before anything is read: what comes between a crash and the next start must be found.
        if let Some((store, key)) = &self.offsets {
            store.store_source_offsets(*key, &partitions, Durability::Synced).await?;
        }
        let Limits { connection_queue, connection_queue_bytes, .. } = self.limits;
        let (records_in, records) = inbox(connection_queue, connection_queue_bytes);
        let (mut reading, turn) = (JoinSet::new(), Arc::new(Mutex::new(())));
        for (broker, places) in readers {
            let (records, turn, limits) = (records_in.clone(), turn.clone(), self.limits.clone());
            reading.spawn(Reader { broker, places, records, turn, limits }.run());
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

    /// Where the reading of each partition begins, and who reads it: a connection to each leader with its partitions.
    async fn partitions(
        &self,
        brokers: &Brokers,
        known: &Topics,
        stored: &[SourceOffset],
    ) -> Result<(Vec<SourceOffset>, Vec<(Broker, Vec<Place>)>), PeerError> {
        if known.values().map(|leaders| leaders.len()).sum::<usize>() > MAX_PARTITIONS {
            return Err(PeerError(format!("the topics have more than {MAX_PARTITIONS} partitions")));
        }
        let mut partitions = Vec::new();
        let mut readers: BTreeMap<&Node, (Broker, Vec<Place>)> = BTreeMap::new();
        for (topic, leaders) in known {
            for (partition, leader) in leaders {
                if !readers.contains_key(leader) {
                    readers.insert(leader, (brokers.dialer.open(leader).await?, Vec::new()));
                }
                let Some((broker, places)) = readers.get_mut(leader) else { continue };
                let offset = match first_offset(stored, topic, *partition) {
                    Ok(stored) => stored,
                    Err(at) => offset_at(broker, topic, *partition, at).await?,
                };
                let (topic, partition) = (topic.clone(), *partition);
                places.push(Place { index: partitions.len(), topic: topic.clone(), partition, offset });
                partitions.push(SourceOffset { topic, partition, next_offset: offset });
            }
        }
        Ok((partitions, readers.into_values().collect()))
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

async fn offset_at(broker: &mut Broker, topic: &str, partition: i32, at: OffsetAt) -> Result<i64, PeerError> {
    let answer = broker.ask(&ListOffsets { topic, partition, at }).await?;
    let (error, offset) = answer.first().ok_or("the broker answered nothing")?;
    error.check()?;
    Ok(*offset)
}

/// How far a partition is read.
struct Place {
    /// Index into [`KafkaSource::partitions`].
    index: usize,
    topic: String,
    partition: i32,
    offset: i64,
}

/// Reads the partitions of one leader.
struct Reader {
    broker: Broker,
    places: Vec<Place>,
    records: Inlet<PartitionRecord>,
    /// Held while an answer is in memory: a source has one at a time, from however many brokers.
    turn: Arc<Mutex<()>>,
    limits: Limits,
}

impl Reader {
    /// Hands on records; ends with the reason.
    async fn run(mut self) -> PeerError {
        loop {
            if let Err(error) = self.read().await {
                return error;
            }
            // The broker begins with the first, and another may have nothing for long.
            self.places.rotate_left(1);
        }
    }

    /// Hands on the records of one answer.
    async fn read(&mut self) -> Result<(), PeerError> {
        let place = |it: &Place| (it.topic.clone(), it.partition, it.offset);
        let request = Fetch {
            places: self.places.iter().map(place).collect(),
            max_wait_ms: FETCH_WAIT.as_millis() as i32,
            max_bytes: FETCH_BYTES,
        };
        let broker = &mut self.broker;
        let answering = async {
            broker.send(&request).await?;
            broker.answer_size().await
        };
        let size = within(FETCH_WAIT + OPEN_TIME, answering).await?;
        let turn = self.turn.clone();
        let _turn = turn.lock().await;
        let (error, fetched) = within(OPEN_TIME, self.broker.answer::<Fetch>(size)).await?;
        error.check()?;
        for answer in fetched {
            let place = |it: &Place| it.partition == answer.partition && it.topic == answer.topic;
            let Some(place) = self.places.iter().position(place) else { continue };
            if answer.error == ErrorCode::OFFSET_OUT_OF_RANGE {
                self.begin_at_oldest(place).await?;
            } else {
                answer.error.check()?;
                self.hand_on(place, answer.batches).await?;
            }
        }
        Ok(())
    }

    /// Goes on where a partition begins that has no longer, or not yet, the message at an offset.
    async fn begin_at_oldest(&mut self, place: usize) -> Result<(), PeerError> {
        let Place { topic, partition, offset: missing, .. } = &mut self.places[place];
        let oldest = offset_at(&mut self.broker, topic, *partition, OffsetAt::Earliest).await?;
        if oldest == *missing {
            return Err(PeerError(format!("the broker has no message at its own oldest offset {oldest}")));
        }
        tracing::warn!(
            topic,
            partition,
            missing,
            oldest,
            "the broker has deleted messages; reading continues with the oldest that it has"
        );
        *missing = oldest;
        Ok(())
    }

    /// Hands on the records of a partition. A batch that cannot be read is handed on as such, and what comes after it is read.
    async fn hand_on(&mut self, place: usize, mut sent: Bytes) -> Result<(), PeerError> {
        let is_empty = sent.is_empty();
        let mut batches = 0;
        while let Some(batch) = Batch::next(&mut sent)? {
            let last_offset = batch.last_offset;
            if !batch.is_control() {
                self.hand_on_batch(place, batch).await?;
            }
            self.places[place].offset = last_offset.saturating_add(1);
            batches += 1;
        }
        if batches == 0 && !is_empty {
            return Err("the broker sent a part of a batch alone".into());
        }
        Ok(())
    }

    async fn hand_on_batch(&mut self, place: usize, batch: Batch) -> Result<(), PeerError> {
        let Place { index, topic, partition, offset: first } = &self.places[place];
        let (last_offset, most_bytes) = (batch.last_offset, self.limits.connection_batch_bytes);
        let unpacking = tokio::task::spawn_blocking(move || batch.records(most_bytes));
        let unpacked = unpacking.await.map_err(|panic| PeerError(panic.to_string()))?;
        let (records, unread) = match unpacked {
            Ok(records) => (Some(records), None),
            Err(reason) => (None, Some(Err(reason))),
        };
        for record in records.into_iter().flatten().chain(unread) {
            let record = match record {
                Ok((offset, _)) if offset < *first => continue,
                Ok((offset, value)) => self.record(*index, offset, &value),
                Err(reason) => PartitionRecord {
                    partition: *index,
                    offset: last_offset,
                    value: format!("offsets up to {last_offset} of partition {partition} of {topic}").into(),
                    size_bytes: 0,
                    unread: Some(reason),
                },
            };
            let bytes = record.value.len();
            if !self.records.put(record, bytes).await {
                return Err("the source is closed".into());
            }
        }
        Ok(())
    }

    /// A record with a copy of its content, so that it does not keep its batch in memory.
    fn record(&self, partition: usize, offset: i64, value: &[u8]) -> PartitionRecord {
        let kept = if value.len() > self.limits.connection_message_bytes { KEPT_BYTES } else { value.len() };
        let kept = &value[..kept.min(value.len())];
        let (value, size_bytes) = (Bytes::copy_from_slice(kept), value.len());
        PartitionRecord { partition, offset, value, size_bytes, unread: None }
    }
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
            let PartitionRecord { value: payload, size_bytes, unread, .. } = record;
            Ok(Message { receipt: self.last_receipt, subject, payload, size_bytes, unread })
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
