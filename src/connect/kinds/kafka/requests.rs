//! The requests that are made of brokers, and their answers. Each has one version, which brokers from 2.1 on know:
//! <https://kafka.apache.org/protocol>.

use bytes::{BufMut as _, Bytes, BytesMut};

use super::fields::{FieldError, Fields, Write as _};

/// A request with the answer that belongs to it.
pub(super) trait Request {
    const KEY: i16;
    const VERSION: i16;
    type Answer;

    fn write(&self, out: &mut BytesMut);
    fn read(answer: &mut Fields) -> Result<Self::Answer, FieldError>;
}

/// A code of an error in an answer; 0 is none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ErrorCode(i16);

impl ErrorCode {
    pub(super) const OFFSET_OUT_OF_RANGE: Self = Self(1);
    const UNKNOWN_TOPIC_OR_PARTITION: Self = Self(3);
    pub(super) const LEADER_NOT_AVAILABLE: Self = Self(5);

    fn read(answer: &mut Fields) -> Result<Self, FieldError> {
        answer.i16().map(Self)
    }

    /// A topic that a broker creates has no leaders for a moment.
    pub(super) const fn is_of_new_topic(self) -> bool {
        matches!(self, Self::UNKNOWN_TOPIC_OR_PARTITION | Self::LEADER_NOT_AVAILABLE)
    }

    /// True if the written content is at fault, so that the broker will never accept it.
    pub(super) const fn is_refusal(self) -> bool {
        // Too large a message or batch, an invalid topic, timestamp or record.
        matches!(self.0, 10 | 17 | 18 | 32 | 87)
    }

    /// The name of the error in Kafka's protocol guide.
    const fn name(self) -> &'static str {
        match self.0 {
            1 => "OFFSET_OUT_OF_RANGE",
            3 => "UNKNOWN_TOPIC_OR_PARTITION",
            5 => "LEADER_NOT_AVAILABLE",
            6 => "NOT_LEADER_OR_FOLLOWER",
            7 => "REQUEST_TIMED_OUT",
            10 => "MESSAGE_TOO_LARGE",
            17 => "INVALID_TOPIC_EXCEPTION",
            18 => "RECORD_LIST_TOO_LARGE",
            19 => "NOT_ENOUGH_REPLICAS",
            29 => "TOPIC_AUTHORIZATION_FAILED",
            31 => "CLUSTER_AUTHORIZATION_FAILED",
            32 => "INVALID_TIMESTAMP",
            33 => "UNSUPPORTED_SASL_MECHANISM",
            35 => "UNSUPPORTED_VERSION",
            58 => "SASL_AUTHENTICATION_FAILED",
            76 => "UNSUPPORTED_COMPRESSION_TYPE",
            87 => "INVALID_RECORD",
            _ => "see Kafka's protocol guide",
        }
    }

    /// # Errors
    /// The code itself, unless it says that all is well.
    pub(super) const fn check(self) -> Result<(), Self> {
        match self.0 {
            0 => Ok(()),
            _ => Err(self),
        }
    }
}

impl std::fmt::Display for ErrorCode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "error {} of Kafka ({})", self.0, self.name())
    }
}

/// Chooses how to sign in; the answer names what the broker knows.
pub(super) struct SaslHandshake<'a> {
    pub(super) mechanism: &'a str,
}

impl Request for SaslHandshake<'_> {
    const KEY: i16 = 17;
    const VERSION: i16 = 1;
    type Answer = (ErrorCode, Vec<String>);

    fn write(&self, out: &mut BytesMut) {
        out.put_text(self.mechanism);
    }

    fn read(answer: &mut Fields) -> Result<Self::Answer, FieldError> {
        Ok((ErrorCode::read(answer)?, answer.array(Fields::text)?))
    }
}

/// A message of the mechanism that was chosen; the answer is the broker's text of an error, and its own message.
pub(super) struct SaslAuthenticate(pub(super) Vec<u8>);

impl Request for SaslAuthenticate {
    const KEY: i16 = 36;
    const VERSION: i16 = 0;
    type Answer = (ErrorCode, String, Bytes);

    fn write(&self, out: &mut BytesMut) {
        out.put_bytes_field(&self.0);
    }

    fn read(answer: &mut Fields) -> Result<Self::Answer, FieldError> {
        Ok((ErrorCode::read(answer)?, answer.text()?, answer.bytes()?))
    }
}

/// Asks for the leaders of topics, which are created where the cluster creates topics by itself.
pub(super) struct Metadata<'a> {
    pub(super) topics: &'a [&'a str],
}

/// A broker's identity, host and port.
pub(super) struct BrokerEntry {
    pub(super) id: i32,
    pub(super) host: String,
    pub(super) port: i32,
}

pub(super) struct TopicEntry {
    pub(super) error: ErrorCode,
    pub(super) name: String,
    /// Each partition with the identity of the broker that leads it, negative where none does.
    pub(super) leaders: Vec<(i32, i32)>,
}

impl Request for Metadata<'_> {
    const KEY: i16 = 3;
    const VERSION: i16 = 2;
    type Answer = (Vec<BrokerEntry>, Vec<TopicEntry>);

    fn write(&self, out: &mut BytesMut) {
        out.put_array(self.topics.iter(), |out, topic| out.put_text(topic));
    }

    fn read(answer: &mut Fields) -> Result<Self::Answer, FieldError> {
        let brokers = answer.array(|it| {
            let broker = BrokerEntry { id: it.i32()?, host: it.text()?, port: it.i32()? };
            let _rack = it.text()?;
            Ok(broker)
        })?;
        let (_cluster_id, _controller) = (answer.text()?, answer.i32()?);
        let topics = answer.array(|it| {
            let (error, name, _is_internal) = (ErrorCode::read(it)?, it.text()?, it.i8()?);
            let leaders = it.array(|it| {
                let (_error, partition, leader) = (it.i16()?, it.i32()?, it.i32()?);
                let (_replicas, _in_sync) = (it.array(Fields::i32)?, it.array(Fields::i32)?);
                Ok((partition, leader))
            })?;
            Ok(TopicEntry { error, name, leaders })
        })?;
        Ok((brokers, topics))
    }
}

/// An end of a partition.
#[derive(Debug, Clone, Copy)]
pub(super) enum OffsetAt {
    Earliest,
    Latest,
}

/// Asks for the offset at an end of a partition.
pub(super) struct ListOffsets<'a> {
    pub(super) topic: &'a str,
    pub(super) partition: i32,
    pub(super) at: OffsetAt,
}

impl Request for ListOffsets<'_> {
    const KEY: i16 = 2;
    const VERSION: i16 = 1;
    /// One item for each partition that was asked for.
    type Answer = Vec<(ErrorCode, i64)>;

    fn write(&self, out: &mut BytesMut) {
        out.put_i32(NO_REPLICA);
        out.put_i32(1);
        out.put_text(self.topic);
        out.put_i32(1);
        out.put_i32(self.partition);
        out.put_i64(match self.at {
            OffsetAt::Latest => -1,
            OffsetAt::Earliest => -2,
        });
    }

    fn read(answer: &mut Fields) -> Result<Self::Answer, FieldError> {
        let topics = answer.array(|it| {
            let _name = it.text()?;
            it.array(|it| {
                let (_partition, error) = (it.i32()?, ErrorCode::read(it)?);
                let (_time_ms, offset) = (it.i64()?, it.i64()?);
                Ok((error, offset))
            })
        })?;
        Ok(topics.into_iter().flatten().collect())
    }
}

/// The identity of a replica that stands for a client.
const NO_REPLICA: i32 = -1;

/// Asks for the records from offsets on.
pub(super) struct Fetch {
    /// Topic, partition and offset.
    pub(super) places: Vec<(String, i32, i64)>,
    pub(super) max_wait_ms: i32,
    /// Bytes of the answer; a larger batch comes whole where it is the first.
    pub(super) max_bytes: i32,
}

/// The records of a partition: batches, the last of which may be cut.
pub(super) struct Fetched {
    pub(super) topic: String,
    pub(super) partition: i32,
    pub(super) error: ErrorCode,
    pub(super) batches: Bytes,
}

impl Request for Fetch {
    const KEY: i16 = 1;
    /// The first version in which brokers send batches of zstd.
    const VERSION: i16 = 10;
    type Answer = (ErrorCode, Vec<Fetched>);

    fn write(&self, out: &mut BytesMut) {
        let (min_bytes, read_uncommitted) = (1, 0);
        let (no_session, no_epoch) = (0, -1);
        out.put_i32(NO_REPLICA);
        out.put_i32(self.max_wait_ms);
        out.put_i32(min_bytes);
        out.put_i32(self.max_bytes);
        out.put_i8(read_uncommitted);
        out.put_i32(no_session);
        out.put_i32(no_epoch);
        out.put_array(self.places.iter(), |out, (topic, partition, offset)| {
            out.put_text(topic);
            out.put_i32(1);
            out.put_i32(*partition);
            out.put_i32(no_epoch);
            out.put_i64(*offset);
            out.put_i64(-1); // The oldest offset, which only replicas know.
            out.put_i32(self.max_bytes);
        });
        out.put_i32(0); // Topics that leave the session.
    }

    fn read(answer: &mut Fields) -> Result<Self::Answer, FieldError> {
        let _throttle_time_ms = answer.i32()?;
        let (error, _session) = (ErrorCode::read(answer)?, answer.i32()?);
        let topics = answer.array(|it| {
            let topic = it.text()?;
            it.array(|it| {
                let (partition, error) = (it.i32()?, ErrorCode::read(it)?);
                let (_high_watermark, _last_stable, _oldest) = (it.i64()?, it.i64()?, it.i64()?);
                let _aborted = it.array(|it| Ok((it.i64()?, it.i64()?)))?;
                Ok(Fetched { topic: topic.clone(), partition, error, batches: it.bytes()? })
            })
        })?;
        Ok((error, topics.into_iter().flatten().collect()))
    }
}

/// Writes a batch of records, which all replicas in sync shall have.
pub(super) struct Produce<'a> {
    pub(super) topic: &'a str,
    pub(super) partition: i32,
    pub(super) batch: &'a [u8],
    pub(super) timeout_ms: i32,
}

impl Request for Produce<'_> {
    const KEY: i16 = 0;
    const VERSION: i16 = 3;
    /// One item for each partition that was written to.
    type Answer = Vec<ErrorCode>;

    fn write(&self, out: &mut BytesMut) {
        let (no_transaction, all_in_sync) = (-1, -1);
        out.put_i16(no_transaction);
        out.put_i16(all_in_sync);
        out.put_i32(self.timeout_ms);
        out.put_i32(1);
        out.put_text(self.topic);
        out.put_i32(1);
        out.put_i32(self.partition);
        out.put_bytes_field(self.batch);
    }

    fn read(answer: &mut Fields) -> Result<Self::Answer, FieldError> {
        let topics = answer.array(|it| {
            let _name = it.text()?;
            it.array(|it| {
                let (_partition, error) = (it.i32()?, ErrorCode::read(it)?);
                let (_offset, _time_ms) = (it.i64()?, it.i64()?);
                Ok(error)
            })
        })?;
        Ok(topics.into_iter().flatten().collect())
    }
}
