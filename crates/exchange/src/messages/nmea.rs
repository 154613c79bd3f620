//! NMEA 0183 sentences as they come: GGA of a receiver, dated by its RMC and ZDA, with the standard deviations of its
//! GST, and AIS.

use jiff::Timestamp;

use super::ais::Ais;
use super::{MessageContext, MessageDecoder, MessageItem, Reading};
use crate::domain::ReceivedFix;
use crate::nmea_fixes::{SentenceContent, Sentences, nearest_instant};

/// Reads sentences of one line each.
#[derive(Default)]
pub(super) struct Nmea {
    /// The latest instant with a date.
    dated_instant: Option<Timestamp>,
    sentences: Sentences,
    ais: Ais,
}

impl MessageDecoder for Nmea {
    fn decode(&mut self, payload: &[u8], context: &MessageContext) -> Result<Reading, String> {
        let text = std::str::from_utf8(payload).map_err(|_| "is not UTF-8".to_owned())?;
        let mut reading = Reading::default();
        for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
            if let Err(reason) = self.sentence(line, context, &mut reading) {
                reading.skip(reason);
            }
        }
        Ok(reading)
    }
}

impl Nmea {
    fn sentence(
        &mut self,
        line: &str,
        context: &MessageContext,
        reading: &mut Reading,
    ) -> Result<(), String> {
        if let Some(fix) = self.ais.sentence(line, context)? {
            reading.items.push(MessageItem::Fix(fix));
            return Ok(());
        }
        match self.sentences.content_of(line)? {
            SentenceContent::None => {}
            SentenceContent::Date(instant) => self.dated_instant = Some(instant),
            SentenceContent::Fix(time_of_day, fix) => {
                let time_of_day = time_of_day.ok_or("the sentence has no time")?;
                // A receiver that sends no date is at most seconds away from the server.
                let dated = self.dated_instant.unwrap_or(context.received_at);
                let time = nearest_instant(time_of_day, dated).ok_or("the time is no instant")?;
                let time = context.time_bounds.check(time).map_err(|error| error.to_string())?;
                reading.items.push(MessageItem::Fix(ReceivedFix { time, receiver_id: None, fix }));
            }
        }
        Ok(())
    }
}
