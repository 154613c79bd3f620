//! What a source takes of its messages, and how it names receivers that they do not name.

use std::net::SocketAddr;

use super::{MessageContext, MessageDecoder, MessageItem, NamedDetection, Reading};
use crate::connection::{ReceiverFrom, SourceSettings};
use crate::domain::{ReceiverId, Score, TargetClass};

/// A decoder with the choices of its source.
pub(super) struct Filtered {
    decoder: Box<dyn MessageDecoder>,
    classes: Vec<String>,
    least_score: f64,
    names_senders: bool,
}

impl Filtered {
    pub(super) fn new(decoder: Box<dyn MessageDecoder>, settings: &SourceSettings) -> Self {
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

/// Who sent a message: its topic or key, or its address without the port, which changes with every connection.
pub(super) fn sender(subject: &str) -> String {
    match subject.parse::<SocketAddr>() {
        Ok(address) => address.ip().to_canonical().to_string(),
        Err(_) => subject.to_owned(),
    }
}
