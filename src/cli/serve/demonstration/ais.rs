//! The AIS sentences that a ship's transponder sends (ITU-R M.1371-5, message type 1; IEC 61162-1 `VDM`).

use jiff::Timestamp;

use crate::geo::Position;

/// The state that a ship reports.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShipState {
    /// Station identity (MMSI), nine digits.
    pub(super) station: u32,
    pub(super) position: Position,
    pub(super) speed_m_s: f64,
    /// Course and heading, degrees clockwise from north.
    pub(super) course_deg: f64,
}

/// Knots per metre per second.
const KNOTS: f64 = 3600.0 / 1852.0;
/// Units of a degree of longitude and latitude.
const PER_DEGREE: f64 = 600_000.0;

/// The sentence of a position report at an instant.
pub(super) fn position_report(ship: &ShipState, time: Timestamp) -> String {
    let fixed = |value: f64| value.round() as i64;
    let fields = [
        (1, 6),
        (0, 2),
        (i64::from(ship.station), 30),
        // Under way using its engine; the rate of turn is not known.
        (0, 4),
        (-128, 8),
        (fixed(10.0 * KNOTS * ship.speed_m_s), 10),
        (1, 1),
        (fixed(PER_DEGREE * ship.position.longitude_deg()), 28),
        (fixed(PER_DEGREE * ship.position.latitude_deg()), 27),
        (fixed(10.0 * ship.course_deg).rem_euclid(3_600), 12),
        (fixed(ship.course_deg).rem_euclid(360), 9),
        (time.as_second().rem_euclid(60), 6),
        (0, 2 + 3 + 1 + 19),
    ];
    let bits: Vec<bool> = fields.iter().flat_map(|&(value, count)| bits_of(value, count)).collect();
    let payload: String = bits.chunks(6).map(character).collect();
    let body = format!("AIVDM,1,1,,A,{payload},0");
    let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    format!("!{body}*{checksum:02X}")
}

/// The lowest bits of a value in two's complement, the highest of them first.
fn bits_of(value: i64, count: u32) -> impl Iterator<Item = bool> {
    (0..count).rev().map(move |at| value >> at & 1 == 1)
}

/// Six bits as a character of a payload.
fn character(bits: &[bool]) -> char {
    let six = bits.iter().fold(0, |value, bit| value << 1 | u8::from(*bit));
    char::from(if six < 40 { 48 + six } else { 56 + six })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::TimeBounds;
    use crate::exchange::{MessageContext, MessageFormat, MessageItem, decoder};
    use crate::geo::distance_m;

    #[test]
    fn a_report_is_read_as_it_was_written() {
        let time: Timestamp = "2026-05-01T12:00:07Z".parse().expect("a time");
        let position = Position::new(24.745, -59.437).expect("in range");
        let ship = ShipState { station: 276_555_000, position, speed_m_s: 2.0, course_deg: 270.0 };
        let sentence = position_report(&ship, time);
        let time_bounds = TimeBounds::at(time);
        let context = MessageContext { subject: "", received_at: time, time_bounds };
        let reading = decoder(MessageFormat::Nmea).decode(sentence.as_bytes(), &context).expect("a sentence");
        let [MessageItem::Fix(fix)] = &reading.items[..] else { panic!("{sentence}: {reading:?}") };
        assert_eq!((fix.receiver_id.as_ref().expect("a ship").as_str(), fix.time), ("276555000", time));
        assert!(distance_m(fix.fix.position, position) < 0.2, "{fix:?}");
    }
}
