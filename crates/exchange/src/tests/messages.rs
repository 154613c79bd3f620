//! Helpers that tests of messages share.

use jiff::Timestamp;

use crate::domain::{ReceivedFix, ReceiverId, TimeBounds};
use crate::{MessageContext, MessageFormat, MessageItem, Reading, decoder};

/// A message that came at 2026-06-01T12:00:20.5Z.
pub(super) fn context() -> MessageContext<'static> {
    let received_at: Timestamp = "2026-06-01T12:00:20.5Z".parse().expect("a time");
    MessageContext { subject: "", received_at, time_bounds: TimeBounds::live_at(received_at, 5) }
}

pub(super) fn read(format: MessageFormat, message: &str) -> Reading {
    decoder(format).decode(message.as_bytes(), &context()).unwrap_or_else(|reason| panic!("{reason}"))
}

fn received(reading: &Reading) -> impl Iterator<Item = &ReceivedFix> {
    reading.items.iter().map(|item| match item {
        MessageItem::Fix(fix) => fix,
        MessageItem::Detection(it) => panic!("{it:?}"),
    })
}

/// Receiver, longitude, latitude and time of each fix.
pub(super) fn fixes(reading: &Reading) -> Vec<(Option<&str>, f64, f64, String)> {
    let shown = |it| {
        let ReceivedFix { time, receiver_id, fix }: &ReceivedFix = it;
        let position = fix.position;
        let receiver = receiver_id.as_ref().map(ReceiverId::as_str);
        (receiver, position.longitude_deg(), position.latitude_deg(), time.to_string())
    };
    received(reading).map(shown).collect()
}

/// The standard deviation that each fix states, mm.
pub(super) fn sigmas_mm(reading: &Reading) -> Vec<Option<i64>> {
    let sigma_mm = |fix: &ReceivedFix| fix.fix.sigma_m.map(|sigma| (sigma.metres() * 1e3).round() as i64);
    received(reading).map(sigma_mm).collect()
}
