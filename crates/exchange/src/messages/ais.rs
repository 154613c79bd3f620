//! Positions of ships: AIS messages in NMEA sentences (ITU-R M.1371-5, IEC 61162-1 `VDM`).
//!
//! Read are the position reports of types 1, 2, 3 (class A), 18 and 19 (class B). A message may come in several
//! sentences. Longitude 181 degrees and latitude 91 degrees mean that there is none. A report has the second of the
//! minute only; it is the latest such instant before the message came, or before the time of its tag block (`c:`).

use std::collections::VecDeque;

use jiff::{SignedDuration, Timestamp};

use super::nmea::Tagged;
use super::{MessageContext, ReportedFix};
use crate::domain::ReceivedFix;
use crate::fix_quality::sigma_of_radius_95;
use crate::unix_time::unix_time;

/// Messages of which not all sentences have come; beyond, the oldest is dropped.
const MAX_PARTIAL: usize = 64;
/// Radius in which a ship's position is in 95 of 100 cases, m, by its position accuracy flag: 10 m or less with
/// corrections, more without. Where it is more, that of a receiver without corrections near walls of steel is taken.
const RADIUS_95_M: [f64; 2] = [25.0, 10.0];
/// Sentences of one message, by the standard.
const MAX_PARTS: usize = 9;

/// Puts the sentences of messages together.
#[derive(Default)]
pub(super) struct Ais {
    partial: VecDeque<PartialMessage>,
}

struct PartialMessage {
    /// Sequential id and channel.
    key: (String, String),
    parts: Vec<Option<String>>,
    fill_bits: usize,
    received_at: Timestamp,
}

/// What of a sentence is used.
struct Sentence<'a> {
    count: usize,
    number: usize,
    sequence: &'a str,
    channel: &'a str,
    payload: &'a str,
    fill_bits: usize,
    /// Time of the receiving station, of the tag block.
    tagged_at: Option<Timestamp>,
}

impl Ais {
    /// The position of a sentence, if it is an AIS sentence that completes a message with one.
    pub(super) fn sentence(
        &mut self,
        line: &Tagged<'_>,
        context: &MessageContext<'_>,
    ) -> Result<Option<ReceivedFix>, String> {
        let Some(sentence) = parse_sentence(line)? else { return Ok(None) };
        let received_at = sentence.tagged_at.unwrap_or(context.received_at);
        if sentence.count == 1 {
            return position(sentence.payload, sentence.fill_bits, received_at, context);
        }
        match self.completed(&sentence, received_at) {
            Some((payload, fill_bits, received_at)) => position(&payload, fill_bits, received_at, context),
            None => Ok(None),
        }
    }

    /// The whole message, once its last sentence has come.
    fn completed(
        &mut self,
        part: &Sentence<'_>,
        received_at: Timestamp,
    ) -> Option<(String, usize, Timestamp)> {
        let key = (part.sequence.to_owned(), part.channel.to_owned());
        let is_same = |it: &PartialMessage| {
            it.key == key && it.parts.len() == part.count && it.parts[part.number - 1].is_none()
        };
        let at = self.partial.iter().position(is_same).unwrap_or_else(|| {
            // The same id for another message: what came of the one before is incomplete for good.
            self.partial.retain(|it| it.key != key);
            if self.partial.len() == MAX_PARTIAL {
                self.partial.pop_front();
            }
            let parts = vec![None; part.count];
            self.partial.push_back(PartialMessage { key: key.clone(), parts, fill_bits: 0, received_at });
            self.partial.len() - 1
        });
        let message = self.partial.get_mut(at)?;
        message.parts[part.number - 1] = Some(part.payload.to_owned());
        if part.number == part.count {
            message.fill_bits = part.fill_bits;
        }
        let payload: Option<String> = message.parts.iter().map(Option::as_deref).collect();
        let payload = payload?;
        let message = self.partial.remove(at)?;
        Some((payload, message.fill_bits, message.received_at))
    }
}

/// A `VDM` or `VDO` sentence; `None` for any other line.
fn parse_sentence<'a>(line: &Tagged<'a>) -> Result<Option<Sentence<'a>>, String> {
    let is_ais = |body: &&str| matches!(body.get(2..6), Some("VDM," | "VDO,"));
    let Some(body) = line.sentence.strip_prefix('!').filter(is_ais) else {
        return Ok(None);
    };
    let (body, checksum) = body.split_once('*').ok_or("the sentence has no checksum")?;
    let computed = body.bytes().fold(0, |sum, byte| sum ^ byte);
    if u8::from_str_radix(checksum.trim(), 16) != Ok(computed) {
        return Err("the sentence's checksum is wrong".to_owned());
    }
    let fields: Vec<&str> = body.split(',').collect();
    let [_, count, number, sequence, channel, payload, fill_bits] = fields[..] else {
        return Err("is not a VDM or VDO sentence of seven fields".to_owned());
    };
    let small = |text: &str, range: std::ops::RangeInclusive<usize>| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| format!("`{text}` is out of range in a VDM or VDO sentence"))
    };
    let count = small(count, 1..=MAX_PARTS)?;
    Ok(Some(Sentence {
        count,
        number: small(number, 1..=count)?,
        sequence,
        channel,
        payload,
        fill_bits: small(fill_bits, 0..=5)?,
        tagged_at: line.tag("c:").and_then(|time| unix_time(time.parse().ok()?).ok()),
    }))
}

/// The position report in a payload; `None` for other messages, and for a report without a position.
fn position(
    payload: &str,
    fill_bits: usize,
    received_at: Timestamp,
    context: &MessageContext<'_>,
) -> Result<Option<ReceivedFix>, String> {
    let bits = Bits::of(payload, fill_bits)?;
    let kind = bits.unsigned(0, 6)?;
    let (accuracy_at, longitude_at, latitude_at, second_at) = match kind {
        1..=3 => (60, 61, 89, 137),
        18 | 19 => (56, 57, 85, 133),
        _ => return Ok(None),
    };
    let longitude = bits.signed(longitude_at, 28)?;
    let latitude = bits.signed(latitude_at, 27)?;
    // In 1/10,000 minutes.
    const DEGREE: i64 = 600_000;
    if longitude == 181 * DEGREE || latitude == 91 * DEGREE {
        return Err("the ship states no position".to_owned());
    }
    let second = bits.unsigned(second_at, 6)?;
    let time = match second {
        0..60 => at_second(received_at, second as i64),
        60 => received_at,
        _ => {
            return Err(
                "the position is entered manually, estimated, or out of order (second 61 to 63)".to_owned()
            );
        }
    };
    let receiver = format!("{:09}", bits.unsigned(8, 30)?);
    let fix = ReportedFix {
        time,
        receiver: Some(&receiver),
        longitude_deg: longitude as f64 / DEGREE as f64,
        latitude_deg: latitude as f64 / DEGREE as f64,
        sigma: sigma_of_radius_95(RADIUS_95_M[bits.unsigned(accuracy_at, 1)? as usize]),
    };
    fix.checked(context).map(Some)
}

/// How far a transmitter's clock may be ahead of the server's, s.
const LEAD_S: i64 = 5;

/// The latest instant with that second of the minute that is at most [`LEAD_S`] after the message was received: a
/// position is measured before it is sent.
fn at_second(received_at: Timestamp, second: i64) -> Timestamp {
    let ahead_s = (second - received_at.as_second()).rem_euclid(60);
    let difference_s = if ahead_s > LEAD_S { ahead_s - 60 } else { ahead_s };
    let whole = Timestamp::from_second(received_at.as_second()).unwrap_or(received_at);
    whole.saturating_add(SignedDuration::from_secs(difference_s)).unwrap_or(received_at)
}

/// The bits of a payload, six in each character.
struct Bits(Vec<u8>, usize);

impl Bits {
    fn of(payload: &str, fill_bits: usize) -> Result<Self, String> {
        let sixes: Result<Vec<u8>, String> = payload
            .bytes()
            .map(|byte| match byte {
                48..=87 => Ok(byte - 48),
                96..=119 => Ok(byte - 56),
                _ => Err("the payload has a character that AIS does not use".to_owned()),
            })
            .collect();
        let sixes = sixes?;
        let bits = (sixes.len() * 6).saturating_sub(fill_bits);
        Ok(Self(sixes, bits))
    }

    fn unsigned(&self, from: usize, count: usize) -> Result<u64, String> {
        if from + count > self.1 {
            return Err("the message is too short".to_owned());
        }
        let bit = |at: usize| u64::from(self.0[at / 6] >> (5 - at % 6) & 1);
        Ok((from..from + count).fold(0, |value, at| value << 1 | bit(at)))
    }

    fn signed(&self, from: usize, count: usize) -> Result<i64, String> {
        let shift = 64 - count;
        Ok((self.unsigned(from, count)? << shift) as i64 >> shift)
    }
}
