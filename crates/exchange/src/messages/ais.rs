//! Positions of ships: AIS messages in NMEA sentences (ITU-R M.1371-5, IEC 61162-1 `VDM` and `VDO`).
//!
//! A message may come in several sentences. Those of the ship's own transponder (`VDO`) are read as those of others.

use std::collections::VecDeque;

use jiff::Timestamp;

use super::MessageContext;
use super::ais_report::Ships;
use super::tagged::Tagged;
use crate::domain::ReceivedFix;
use crate::unix_time::unix_time;

/// Messages of which not all sentences have come; beyond, the oldest is dropped.
const MAX_PARTIAL: usize = 64;
/// Sentences of one message, by the standard.
const MAX_PARTS: usize = 9;

/// Puts the sentences of messages together.
#[derive(Default)]
pub(super) struct Ais {
    partial: VecDeque<PartialMessage>,
    ships: Ships,
}

struct PartialMessage {
    /// Sequential id and channel.
    key: (String, String),
    parts: Vec<Option<String>>,
    fill_bits: usize,
    received_at: Timestamp,
}

/// The fields of a sentence that are used.
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
            return self.ships.fix(sentence.payload, sentence.fill_bits, received_at, context);
        }
        match self.completed(&sentence, received_at) {
            Some((payload, fill_bits, received_at)) => {
                self.ships.fix(&payload, fill_bits, received_at, context)
            }
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
