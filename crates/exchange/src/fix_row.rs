//! A fix as it was read from a file of any format.

use jiff::Timestamp;

use super::file_row::RowError;
use super::format::FixFormat;
use crate::domain::{Fix, ReceivedFix, ReceiverId, Result, TimeBounds};

/// A fix of a file, not yet checked for completeness.
pub(super) struct FixRow {
    pub(super) line: u64,
    pub(super) time: Option<Timestamp>,
    pub(super) receiver_id: Option<ReceiverId>,
    pub(super) fix: Fix,
}

impl FixRow {
    /// A fix with a valid time, if it has one.
    pub(super) fn checked(
        line: u64,
        time: Option<Timestamp>,
        receiver_id: Option<ReceiverId>,
        fix: Fix,
        time_bounds: &TimeBounds,
    ) -> Result<Self, RowError> {
        match time.map(|time| time_bounds.check(time)).transpose() {
            Ok(time) => Ok(Self { line, time, receiver_id, fix }),
            Err(error) => Err(RowError { line, field: "time".to_owned(), reason: error.to_string() }),
        }
    }

    pub(super) fn received(self, format: FixFormat) -> Result<ReceivedFix, RowError> {
        let Self { line, time, receiver_id, fix } = self;
        if let Some(time) = time {
            return Ok(ReceivedFix { time, receiver_id, fix });
        }
        let reason = match format {
            FixFormat::Nmea => "has no date: the file has no RMC or ZDA sentence",
            _ => "is required",
        };
        Err(RowError { line, field: "time".to_owned(), reason: reason.to_owned() })
    }
}
