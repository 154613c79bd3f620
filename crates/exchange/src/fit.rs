//! Fixes of a FIT file: the messages `record` of an activity (FIT SDK: protocol, global profile).
//!
//! A file is a header, messages and a checksum, and several may follow one another. The first byte of a message names
//! one of 16 local types; a definition message says which fields the data messages of a type have. Only the fields of a
//! position are decoded, and nothing but the definitions is kept in memory.

use std::io::{self, BufReader, Read};

use jiff::Timestamp;

use super::file_row::RowError;
use super::fix_quality::sigma_of_radius_68;
use super::fix_row::FixRow;
use super::wire;
use crate::domain::{Error, ErrorKind, Result, SigmaM, TimeBounds};

/// Unix time of 31 December 1989, UTC, from which FIT counts seconds.
const EPOCH_S: i64 = 631_065_600;
/// Degrees of a semicircle, the unit of positions.
const DEGREES_PER_SEMICIRCLE: f64 = 180.0 / 2_147_483_648.0;
/// Number of the message `record` in the global profile.
const RECORD: u16 = 20;
/// The remainders of CRC-16/ARC for four bits.
const CHECKSUMS: [u16; 16] = [
    0x0000, 0xCC01, 0xD801, 0x1400, 0xF001, 0x3C00, 0x2800, 0xE401, 0xA001, 0x6C00, 0x7800, 0xB401, 0x5000,
    0x9C01, 0x8801, 0x4400,
];

/// Fields that are read, by their numbers in the global profile: the time is number 253 of every message, the others are
/// of `record`.
#[derive(Clone, Copy)]
enum Field {
    Time,
    Latitude,
    Longitude,
    Accuracy,
}

impl Field {
    const COUNT: usize = 4;

    const fn of(number: u8, message: u16) -> Option<Self> {
        Some(match (message, number) {
            (_, 253) => Self::Time,
            (RECORD, 0) => Self::Latitude,
            (RECORD, 1) => Self::Longitude,
            (RECORD, 31) => Self::Accuracy,
            _ => return None,
        })
    }
}

/// The values of the fields that a message has.
type Values = [Option<u32>; Field::COUNT];

/// The data messages of a local type.
#[derive(Default)]
struct Definition {
    message: u16,
    is_big_endian: bool,
    /// Numbers and sizes of the fields, in bytes.
    fields: Vec<(u8, u8)>,
    /// Sizes of the fields that programs have added.
    developer_fields: Vec<u8>,
}

/// Reads the fixes of a file.
pub(super) struct FitFixes<R> {
    reader: BufReader<R>,
    time_bounds: TimeBounds,
    /// Bytes of messages that are left before the checksum.
    left: u64,
    checksum: u16,
    definitions: [Option<Definition>; 16],
    /// The latest time of a message, s of FIT.
    time_s: u32,
    /// Messages `record` that were read.
    records: u64,
    has_header: bool,
    has_ended: bool,
}

impl<R: Read> FitFixes<R> {
    pub(super) fn new(reader: R, time_bounds: TimeBounds) -> Self {
        Self {
            reader: BufReader::new(reader),
            time_bounds,
            left: 0,
            checksum: 0,
            definitions: Default::default(),
            time_s: 0,
            records: 0,
            has_header: false,
            has_ended: false,
        }
    }

    pub(super) fn next_row(&mut self) -> Option<Result<Result<FixRow, RowError>>> {
        while !self.has_ended {
            match self.next_message() {
                Ok(None) => {}
                Ok(Some(values)) => {
                    let row = fix_of(self.records, &values, &self.time_bounds);
                    return Some(row.or_else(|error| RowError::of(self.records, error).map(Err)));
                }
                Err(error) => {
                    self.has_ended = true;
                    return Some(Err(error));
                }
            }
        }
        None
    }

    /// Reads a header or a message; the values of a `record`.
    fn next_message(&mut self) -> Result<Option<Values>> {
        if self.left == 0 {
            self.begin_file()?;
            return Ok(None);
        }
        let [head] = self.take()?;
        let values = match head {
            0x80.. => self.data(head >> 5 & 0x3, Some(head & 0x1F))?,
            0x40.. => {
                self.define(head & 0xF, head & 0x20 != 0)?;
                None
            }
            _ => self.data(head & 0xF, None)?,
        };
        if self.left == 0 {
            self.check_end()?;
        }
        Ok(values)
    }

    /// Reads the header of the first file or of one that follows it.
    fn begin_file(&mut self) -> Result<()> {
        let mut size = [0];
        if self.has_header && self.reader.read(&mut size).map_err(Error::fault)? == 0 {
            self.has_ended = true;
            return Ok(());
        }
        if !self.has_header {
            self.fill(&mut size)?;
        }
        let size = size[0];
        let mut header = [0; 14];
        header[0] = size;
        let rest = header.get_mut(1..size.into()).filter(|_| matches!(size, 12 | 14));
        self.fill(rest.ok_or_else(|| self.malformed("is not FIT: its header must have 12 or 14 bytes"))?)?;
        if &header[8..12] != b".FIT" {
            return Err(self.malformed("is not FIT: its header has no `.FIT`"));
        }
        let [_, _, _, _, one, two, three, four, ..] = header;
        self.left = u32::from_le_bytes([one, two, three, four]).into();
        if self.left == 0 {
            return Err(self.malformed("was not finished: its header says that nothing follows"));
        }
        self.has_header = true;
        self.checksum = 0;
        self.checksum = checksum_after(self.checksum, &header[..size.into()]);
        self.definitions = Default::default();
        Ok(())
    }

    fn check_end(&mut self) -> Result<()> {
        let computed = self.checksum;
        let mut stated = [0; 2];
        self.fill(&mut stated)?;
        if u16::from_le_bytes(stated) == computed {
            return Ok(());
        }
        Err(self.malformed("is damaged: its checksum is wrong"))
    }

    fn define(&mut self, local: u8, has_developer_fields: bool) -> Result<()> {
        let [_, architecture, low, high, count] = self.take()?;
        let is_big_endian = architecture == 1;
        let message =
            if is_big_endian { u16::from_be_bytes([low, high]) } else { u16::from_le_bytes([low, high]) };
        let mut definition = Definition { message, is_big_endian, ..Definition::default() };
        for _ in 0..count {
            let [number, size, _] = self.take()?;
            definition.fields.push((number, size));
        }
        if has_developer_fields {
            let [count] = self.take()?;
            for _ in 0..count {
                let [_, size, _] = self.take()?;
                definition.developer_fields.push(size);
            }
        }
        self.definitions[usize::from(local)] = Some(definition);
        Ok(())
    }

    /// Reads a data message; the values of a `record`. A time of five bits is the next such instant.
    fn data(&mut self, local: u8, short_time_s: Option<u8>) -> Result<Option<Values>> {
        let definition = self.definitions[usize::from(local)].take();
        let definition =
            definition.ok_or_else(|| self.malformed("has a message that no definition describes"))?;
        let mut values = Values::default();
        let mut bytes = [0; u8::MAX as usize];
        for (number, size) in &definition.fields {
            let bytes = &mut bytes[..usize::from(*size)];
            self.take_into(bytes)?;
            if let Some(field) = Field::of(*number, definition.message) {
                values[field as usize] = value_of(bytes, definition.is_big_endian);
            }
        }
        for size in &definition.developer_fields {
            self.take_into(&mut bytes[..usize::from(*size)])?;
        }
        if let Some(short) = short_time_s {
            let later_s = u32::from(short).wrapping_sub(self.time_s) & 0x1F;
            values[Field::Time as usize] = Some(self.time_s.wrapping_add(later_s));
        }
        self.time_s = values[Field::Time as usize].unwrap_or(self.time_s);
        let is_record = definition.message == RECORD;
        self.definitions[usize::from(local)] = Some(definition);
        self.records += u64::from(is_record);
        Ok(is_record.then_some(values))
    }

    /// Bytes of a message.
    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut bytes = [0; N];
        self.take_into(&mut bytes)?;
        Ok(bytes)
    }

    fn take_into(&mut self, bytes: &mut [u8]) -> Result<()> {
        let left = self.left.checked_sub(bytes.len() as u64);
        self.left = left.ok_or_else(|| self.malformed("is damaged: a message is longer than its file"))?;
        self.fill(bytes)?;
        self.checksum = checksum_after(self.checksum, bytes);
        Ok(())
    }

    fn fill(&mut self, bytes: &mut [u8]) -> Result<()> {
        self.reader.read_exact(bytes).map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => self.malformed("breaks off"),
            _ => Error::fault(error),
        })
    }

    fn malformed(&self, reason: &str) -> Error {
        let message = format!("after {} positions the file {reason}", self.records);
        Error::refused(ErrorKind::MalformedBody, message)
    }
}

fn checksum_after(checksum: u16, bytes: &[u8]) -> u16 {
    let after_half =
        |checksum: u16, half: u8| checksum >> 4 ^ CHECKSUMS[usize::from((checksum as u8 ^ half) & 0xF)];
    bytes.iter().fold(checksum, |checksum, byte| after_half(after_half(checksum, *byte), byte >> 4))
}

/// An integer of one or four bytes; `None` where it says that there is none.
fn value_of(bytes: &[u8], is_big_endian: bool) -> Option<u32> {
    match *bytes {
        [byte] => Some(u32::from(byte)).filter(|_| byte != u8::MAX),
        [one, two, three, four] => {
            let bytes = [one, two, three, four];
            Some(if is_big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
        }
        _ => None,
    }
}

fn fix_of(record: u64, values: &Values, time_bounds: &TimeBounds) -> Result<Result<FixRow, RowError>> {
    let value = |field: Field| values[field as usize];
    let degrees = |field: Field, name: &str| {
        let semicircles = value(field).map(u32::cast_signed).filter(|it| *it != i32::MAX);
        let degrees = semicircles.map(|semicircles| f64::from(semicircles) * DEGREES_PER_SEMICIRCLE);
        degrees.ok_or_else(|| Error::invalid(name, "is missing: the receiver had no fix"))
    };
    let fix = wire::Fix {
        longitude_deg: degrees(Field::Longitude, "position_long")?,
        latitude_deg: degrees(Field::Latitude, "position_lat")?,
        sigma_m: value(Field::Accuracy).and_then(|m| sigma_of_radius_68(m.into())).map(SigmaM::metres),
    };
    let time_s = value(Field::Time).filter(|time_s| *time_s != u32::MAX);
    let time = time_s.and_then(|time_s| Timestamp::from_second(EPOCH_S + i64::from(time_s)).ok());
    Ok(FixRow::checked(record, time, None, fix.to_domain()?, time_bounds))
}
