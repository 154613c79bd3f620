//! Batches of records, format 2: <https://kafka.apache.org/documentation/#recordbatch>.

use bytes::{BufMut as _, Bytes, BytesMut};

use super::decompress::{Codec, decompress};
use super::fields::{FieldError, Fields, Write as _};
use crate::connect::credentials::PeerError;

/// The format of batches since Kafka 0.11.
const FORMAT: i8 = 2;
/// Bytes before the part that is as long as the batch says: base offset and length.
const PREFIX_BYTES: usize = 12;
/// Attributes of a batch.
const CODEC_BITS: i16 = 0b111;
const CONTROL_BIT: i16 = 1 << 5;

/// A batch as a broker sent it.
pub(super) struct Batch {
    base_offset: i64,
    /// The offset of its last record, also where that was removed since.
    pub(super) last_offset: i64,
    attributes: i16,
    record_count: i32,
    records: Bytes,
    format: i8,
}

impl Batch {
    /// Takes the next batch; none where only a part of it, or nothing, is left.
    ///
    /// # Errors
    /// It came damaged.
    pub(super) fn next(sent: &mut Bytes) -> Result<Option<Self>, PeerError> {
        let mut prefix = Fields(sent.clone());
        let (Ok(base_offset), Ok(length)) = (prefix.i64(), prefix.i32()) else { return Ok(None) };
        let end = usize::try_from(length).map_or(usize::MAX, |length| length.saturating_add(PREFIX_BYTES));
        if end > sent.len() {
            return Ok(None);
        }
        let batch = Fields(sent.split_to(end).slice(PREFIX_BYTES..));
        let read = Self::read(base_offset, batch);
        read.map(Some).map_err(|error| PeerError(format!("the batch at offset {base_offset} {error}")))
    }

    fn read(base_offset: i64, mut batch: Fields) -> Result<Self, FieldError> {
        let (_leader_epoch, format) = (batch.i32()?, batch.i8()?);
        if format != FORMAT {
            let (attributes, record_count, records) = (0, 0, Bytes::new());
            let last_offset = base_offset;
            return Ok(Self { base_offset, last_offset, attributes, record_count, records, format });
        }
        let checksum = batch.i32()?;
        if crc32c::crc32c(&batch.0) != checksum as u32 {
            return Err(FieldError::Checksum);
        }
        let (attributes, last_offset_delta) = (batch.i16()?, batch.i32()?);
        let (_first_time_ms, _last_time_ms) = (batch.i64()?, batch.i64()?);
        let (_producer, _producer_epoch, _sequence) = (batch.i64()?, batch.i16()?, batch.i32()?);
        let record_count = batch.i32()?;
        let last_offset = base_offset.saturating_add(last_offset_delta.max(0).into());
        Ok(Self { base_offset, last_offset, attributes, record_count, records: batch.0, format })
    }

    /// True if its records are those of transactions, not of producers.
    pub(super) const fn is_control(&self) -> bool {
        self.attributes & CONTROL_BIT != 0
    }

    /// The records, decompressed to at most `most_bytes`.
    ///
    /// # Errors
    /// Why they cannot be read.
    pub(super) fn records(self, most_bytes: usize) -> Result<Records, String> {
        if self.format != FORMAT {
            return Err("the batch has a format from before Kafka 0.11".to_owned());
        }
        let codec = Codec::from_bits(self.attributes & CODEC_BITS)?;
        let content = match codec {
            None => self.records,
            Some(codec) => decompress(codec, &self.records, most_bytes)?.into(),
        };
        Ok(Records { content: Fields(content), base_offset: self.base_offset, left: self.record_count })
    }
}

/// The records of a batch: offset and content of each.
pub(super) struct Records {
    content: Fields,
    base_offset: i64,
    left: i32,
}

impl Records {
    fn read(&mut self) -> Result<(i64, Bytes), FieldError> {
        let mut record = Fields(self.content.varint_bytes()?);
        let (_attributes, _time_delta_ms, offset_delta) = (record.i8()?, record.varint()?, record.varint()?);
        let (_key, value) = (record.varint_bytes()?, record.varint_bytes()?);
        Ok((self.base_offset.saturating_add(offset_delta), value))
    }
}

impl Iterator for Records {
    type Item = Result<(i64, Bytes), String>;

    fn next(&mut self) -> Option<Self::Item> {
        self.left = self.left.checked_sub(1).filter(|left| *left >= 0)?;
        let record = self.read();
        if record.is_err() {
            self.left = 0;
        }
        Some(record.map_err(|error| format!("a record of the batch {error}")))
    }
}

/// A record to be written.
pub(super) struct NewRecord<'a> {
    pub(super) time_ms: i64,
    pub(super) key: &'a str,
    pub(super) value: &'a [u8],
    pub(super) headers: [(&'a str, &'a str); 2],
}

impl NewRecord<'_> {
    fn write(&self, out: &mut BytesMut, index: usize, first_time_ms: i64) {
        let mut record = BytesMut::with_capacity(self.value.len() + 128);
        record.put_i8(0);
        record.put_varint(self.time_ms.saturating_sub(first_time_ms));
        record.put_varint(index as i64);
        record.put_varint_bytes(self.key.as_bytes());
        record.put_varint_bytes(self.value);
        record.put_varint(self.headers.len() as i64);
        for (name, value) in self.headers {
            record.put_varint_bytes(name.as_bytes());
            record.put_varint_bytes(value.as_bytes());
        }
        out.put_varint_bytes(&record);
    }
}

/// A batch of records, not compressed and of no transaction.
pub(super) fn encode(records: &[NewRecord<'_>]) -> BytesMut {
    let times = || records.iter().map(|record| record.time_ms);
    let first_time_ms = times().next().unwrap_or_default();
    let mut checked = BytesMut::new();
    checked.put_i16(0);
    checked.put_i32(records.len() as i32 - 1);
    checked.put_i64(first_time_ms);
    checked.put_i64(times().max().unwrap_or_default());
    checked.put_i64(-1); // The producer, its epoch and its sequence, which only transactions have.
    checked.put_i16(-1);
    checked.put_i32(-1);
    checked.put_i32(records.len() as i32);
    for (index, record) in records.iter().enumerate() {
        record.write(&mut checked, index, first_time_ms);
    }
    let mut rest = BytesMut::with_capacity(checked.len() + 9);
    rest.put_i32(-1); // The leader's epoch, which the broker writes.
    rest.put_i8(FORMAT);
    rest.put_u32(crc32c::crc32c(&checked));
    rest.put_slice(&checked);
    let mut batch = BytesMut::with_capacity(rest.len() + PREFIX_BYTES);
    batch.put_i64(0);
    batch.put_bytes_field(&rest);
    batch
}
