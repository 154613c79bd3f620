//! The items that a source uses of its messages, and the names of receivers that the messages do not name.

use crate::connection::{ReceiverFrom, SourceSettings};
use crate::domain::{ReceiverId, Score, TargetClass};
use crate::messages::{
    MessageContext, MessageDecoder, MessageFormat, MessageItem, NamedDetection, Reading, decoder,
    mapped_decoder, sender, talker_decoder,
};

/// A decoder of a source's messages, with the source's mapping, names of receivers and filter.
#[must_use]
pub fn source_decoder(settings: &SourceSettings) -> Box<dyn MessageDecoder> {
    let decoder = match (settings.format, settings.receiver_from) {
        (MessageFormat::Json, _) => mapped_decoder(settings.mapping.clone().unwrap_or_default()),
        (MessageFormat::Nmea, ReceiverFrom::Talker) => talker_decoder(),
        (format, _) => decoder(format),
    };
    Box::new(Filtered::new(decoder, settings))
}

/// A decoder with the choices of its source.
struct Filtered {
    decoder: Box<dyn MessageDecoder>,
    classes: Vec<String>,
    least_score: f64,
    names_senders: bool,
}

impl Filtered {
    fn new(decoder: Box<dyn MessageDecoder>, settings: &SourceSettings) -> Self {
        Self {
            decoder,
            classes: settings.classes.clone(),
            least_score: settings.least_score.unwrap_or(0.0),
            names_senders: settings.receiver_from == ReceiverFrom::Sender,
        }
    }

    /// Why a detection is not taken. One whose class or score is not known is taken.
    fn refusal(&self, detection: &NamedDetection) -> Option<String> {
        let class = detection.class.as_ref().map(TargetClass::as_str);
        let score = detection.score.map(Score::value);
        let has_other_class = |class: &str| {
            !self.classes.is_empty() && !self.classes.iter().any(|taken| taken.eq_ignore_ascii_case(class))
        };
        if let Some(class) = class.filter(|class| has_other_class(class)) {
            return Some(format!("the class {class} is not among the source's classes"));
        }
        let score = score.filter(|score| *score < self.least_score)?;
        Some(format!("the score {score} is below the source's least_score"))
    }
}

impl MessageDecoder for Filtered {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let Reading { items, skipped } = self.decoder.decode(payload, context)?;
        let mut reading = Reading { items: Vec::with_capacity(items.len()), skipped };
        for item in items {
            match item {
                MessageItem::Detection(detection) => match self.refusal(&detection) {
                    Some(reason) => reading.skip(reason),
                    None => reading.items.push(MessageItem::Detection(detection)),
                },
                MessageItem::Fix(mut fix) => {
                    if self.names_senders && fix.receiver_id.is_none() {
                        fix.receiver_id = ReceiverId::new(&sender(context.subject)).ok();
                    }
                    reading.items.push(MessageItem::Fix(fix));
                }
            }
        }
        Ok(reading)
    }
}
