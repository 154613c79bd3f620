//! NMEA 0183 sentences as they come: positions of receivers, dated by their RMC and ZDA, with the standard deviations of
//! their GST, and AIS.
//!
//! Each sender has its own date and deviations, and so has each talker where talkers are told apart. The source of a tag
//! block (`s:`) names the receiver.

use std::collections::HashMap;

use jiff::{SignedDuration, Timestamp};

use super::ais::Ais;
use super::tagged::Tagged;
use super::{MessageContext, MessageDecoder, MessageItem, Reading, sender};
use crate::domain::{ReceivedFix, ReceiverId};
use crate::nmea_fixes::{SentenceContent, Sentences, nearest_instant};

/// Receivers that are told apart; beyond, all are forgotten, and known again by their next sentences.
const MAX_RECEIVERS: usize = 1_024;
/// Weeks after which the week number of GPS begins again.
const ROLLOVER_S: i64 = 1_024 * 7 * 86_400;

/// The way to tell receivers apart.
#[derive(PartialEq, Eq)]
pub(super) enum Telling {
    Senders,
    Talkers,
}

/// Reads sentences of one line each.
pub(super) struct Nmea {
    telling: Telling,
    receivers: HashMap<String, Receiver>,
    ais: Ais,
}

#[derive(Default)]
struct Receiver {
    /// The latest instant with a date.
    dated_instant: Option<Timestamp>,
    sentences: Sentences,
}

impl MessageDecoder for Nmea {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
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
    pub(super) fn new(telling: Telling) -> Self {
        Self { telling, receivers: HashMap::new(), ais: Ais::default() }
    }

    fn sentence(
        &mut self,
        line: &str,
        context: &MessageContext<'_>,
        reading: &mut Reading,
    ) -> Result<(), String> {
        let tagged = Tagged::of(line);
        if let Some(fix) = self.ais.sentence(&tagged, context)? {
            reading.items.push(MessageItem::Fix(fix));
            return Ok(());
        }
        let talker = tagged.sentence.get(1..3).filter(|_| self.telling == Telling::Talkers);
        let name = tagged.tag("s:").or(talker);
        let receiver = self.receiver(&format!("{} {}", sender(context.subject), name.unwrap_or_default()));
        let SentenceContent { date, fixes } = receiver.sentences.content_of(tagged.sentence)?;
        if let Some(date) = date {
            check_rollover(date, context.received_at)?;
            receiver.dated_instant = Some(date);
        }
        // A receiver that sends no date is at most seconds away from the server.
        let dated = receiver.dated_instant.unwrap_or(context.received_at);
        for (time_of_day, fix) in fixes {
            let time_of_day = time_of_day.ok_or("the sentence has no time")?;
            let time = nearest_instant(time_of_day, dated).ok_or("the time is no instant")?;
            let time = context.time_bounds.check(time).map_err(|error| error.to_string())?;
            let receiver_id = name.map(ReceiverId::new).transpose().map_err(|error| error.to_string())?;
            reading.items.push(MessageItem::Fix(ReceivedFix { time, receiver_id, fix }));
        }
        Ok(())
    }

    fn receiver(&mut self, key: &str) -> &mut Receiver {
        if self.receivers.len() >= MAX_RECEIVERS && !self.receivers.contains_key(key) {
            self.receivers.clear();
        }
        self.receivers.entry(key.to_owned()).or_default()
    }
}

/// Refuses a date that is a whole number of rollovers of GPS weeks ago: old firmware takes one for another.
fn check_rollover(date: Timestamp, received_at: Timestamp) -> Result<(), String> {
    let age_s = received_at.duration_since(date).as_secs();
    let distance_s = (age_s + ROLLOVER_S / 2).rem_euclid(ROLLOVER_S) - ROLLOVER_S / 2;
    if age_s < ROLLOVER_S / 2 || distance_s.abs() > SignedDuration::from_hours(24).as_secs() {
        return Ok(());
    }
    Err(format!(
        "the receiver's date, {date:.0}, is {} times 1024 weeks ago: its count of GPS weeks has begun again; update its firmware",
        (age_s + ROLLOVER_S / 2) / ROLLOVER_S
    ))
}
