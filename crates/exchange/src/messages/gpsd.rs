//! Reports of gpsd, one JSON object per line.

use super::{MessageContext, MessageDecoder, MessageItem, Reading};
use crate::format::FixFormat;
use crate::gpsd::Reports;

#[derive(Default)]
pub(super) struct Gpsd(Reports);

impl MessageDecoder for Gpsd {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let text = std::str::from_utf8(payload).map_err(|_| "is not UTF-8".to_owned())?;
        let mut reading = Reading::default();
        for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
            match self.0.fix(1, line, &context.time_bounds) {
                Ok(None) => reading.skip("a report without a position"),
                Ok(Some(row)) => match row.and_then(|row| row.received(FixFormat::Gpsd)) {
                    Ok(fix) => reading.items.push(MessageItem::Fix(fix)),
                    Err(error) => reading.skip(error.reason),
                },
                Err(error) => reading.skip(error.to_string()),
            }
        }
        Ok(reading)
    }
}
