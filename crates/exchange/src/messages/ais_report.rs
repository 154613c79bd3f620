//! The contents of AIS messages: position reports of types 1, 2, 3 (class A), 9 (aircraft of search and rescue), 18 and
//! 19 (class B) and 27 (long range), and the place of the antenna in the ship of types 5, 19 and 24.
//!
//! Longitude 181 degrees and latitude 91 degrees mean that there is none. A report has the second of the minute only; it
//! is the latest such instant before the message came, or before the time of its tag block (`c:`). A position is the
//! antenna's. Once the ship's dimensions are known it is moved to the middle of the hull, which is what a camera sees;
//! without a heading it stays, and its error grows by the distance.

use std::collections::HashMap;

use jiff::{SignedDuration, Timestamp};

use super::{MessageContext, ReportedFix};
use crate::domain::{ReceivedFix, SigmaM};
use crate::fix_quality::{sigma_of_deviations, sigma_of_radius_95};
use crate::geo::{EastNorth, LocalPlane, Position};

/// Ships whose dimensions are remembered; beyond, all are forgotten. They are sent every six minutes.
const MAX_SHIPS: usize = 16_384;
/// Radius in which a ship's position is in 95 of 100 cases, m, by its position accuracy flag: 10 m or less with
/// corrections, more without. Where it is more, that of a receiver without corrections near walls of steel is taken.
const RADIUS_95_M: [f64; 2] = [25.0, 10.0];
/// Standard deviation per axis of a position that is rounded to 1/10 of a minute, m.
const ROUNDING_SIGMA_M: f64 = 53.5;
/// Stations of auxiliary craft begin with it; they name their mother ship where others have dimensions.
const AUXILIARY_CRAFT: u64 = 98;

/// The ships that were heard.
#[derive(Default)]
pub(super) struct Ships {
    /// The middle of the hull by station: metres ahead of the antenna and to its right.
    middles: HashMap<u64, [f64; 2]>,
}

/// Where a report has its values, in bits, and how fine they are.
struct Layout {
    accuracy: usize,
    longitude: (usize, usize),
    latitude: (usize, usize),
    /// Units of a degree.
    per_degree: i64,
    second: Option<usize>,
    heading: Option<usize>,
}

impl Layout {
    fn of(kind: u64) -> Option<Self> {
        let fine = |accuracy, second, heading| Self {
            accuracy,
            longitude: (accuracy + 1, 28),
            latitude: (accuracy + 29, 27),
            per_degree: 600_000,
            second: Some(second),
            heading,
        };
        Some(match kind {
            1..=3 => fine(60, 137, Some(128)),
            9 => fine(60, 128, None),
            18 | 19 => fine(56, 133, Some(124)),
            27 => Self {
                accuracy: 38,
                longitude: (44, 18),
                latitude: (62, 17),
                per_degree: 600,
                second: None,
                heading: None,
            },
            _ => return None,
        })
    }
}

impl Ships {
    /// The position of a message; `None` for other messages.
    pub(super) fn fix(
        &mut self,
        payload: &str,
        fill_bits: usize,
        received_at: Timestamp,
        context: &MessageContext<'_>,
    ) -> Result<Option<ReceivedFix>, String> {
        let bits = Bits::of(payload, fill_bits)?;
        let kind = bits.unsigned(0, 6)?;
        let station = bits.unsigned(8, 30)?;
        self.take_dimensions(kind, station, &bits)?;
        let Some(layout) = Layout::of(kind) else { return Ok(None) };
        let longitude = bits.signed(layout.longitude.0, layout.longitude.1)?;
        let latitude = bits.signed(layout.latitude.0, layout.latitude.1)?;
        if longitude == 181 * layout.per_degree || latitude == 91 * layout.per_degree {
            return Err("the ship states no position".to_owned());
        }
        let heading = layout.heading.map(|at| bits.unsigned(at, 9)).transpose()?;
        let per_degree = layout.per_degree as f64;
        let is_coarse = layout.second.is_none();
        let radius_95_m = RADIUS_95_M[bits.unsigned(layout.accuracy, 1)? as usize];
        let fix = ReportedFix {
            time: layout.second.map_or(Ok(received_at), |at| time_of(bits.unsigned(at, 6)?, received_at))?,
            receiver: Some(&format!("{station:09}")),
            longitude_deg: longitude as f64 / per_degree,
            latitude_deg: latitude as f64 / per_degree,
            sigma: sigma_of_radius_95(radius_95_m)
                .and_then(|sigma| if is_coarse { widened(sigma, ROUNDING_SIGMA_M) } else { Some(sigma) }),
        };
        let fix = fix.checked(context)?;
        Ok(Some(self.in_the_middle(station, heading.filter(|heading| *heading < 360), fix)))
    }

    /// Takes distances from the antenna to bow, stern, port and starboard, m. All of them are 0 where they are not known.
    fn take_dimensions(&mut self, kind: u64, station: u64, bits: &Bits) -> Result<(), String> {
        let at = match kind {
            5 => 240,
            19 => 271,
            24 if bits.unsigned(38, 2)? == 1 && station / 10_000_000 != AUXILIARY_CRAFT => 132,
            _ => return Ok(()),
        };
        let metres = |from, count| bits.unsigned(from, count).map(|metres| metres as f64);
        let [bow, stern] = [metres(at, 9)?, metres(at + 9, 9)?];
        let [port, starboard] = [metres(at + 18, 6)?, metres(at + 24, 6)?];
        if self.middles.len() >= MAX_SHIPS && !self.middles.contains_key(&station) {
            self.middles.clear();
        }
        // With a bow of 0 the antenna's place is not given, only the ship's size.
        if bow > 0.0 && stern > 0.0 {
            self.middles.insert(station, [(bow - stern) / 2.0, (starboard - port) / 2.0]);
        } else {
            self.middles.remove(&station);
        }
        Ok(())
    }

    fn in_the_middle(&self, station: u64, heading_deg: Option<u64>, mut fix: ReceivedFix) -> ReceivedFix {
        let Some(&[ahead_m, right_m]) = self.middles.get(&station) else { return fix };
        match heading_deg {
            Some(heading_deg) => {
                let (sin, cos) = (heading_deg as f64).to_radians().sin_cos();
                let middle = EastNorth {
                    east_m: ahead_m * sin + right_m * cos,
                    north_m: ahead_m * cos - right_m * sin,
                };
                fix.fix.position = moved(fix.fix.position, middle);
            }
            None => {
                let per_axis_m = ahead_m.hypot(right_m) / std::f64::consts::SQRT_2;
                fix.fix.sigma_m = fix.fix.sigma_m.and_then(|sigma| widened(sigma, per_axis_m));
            }
        }
        fix
    }
}

fn moved(position: Position, by: EastNorth) -> Position {
    LocalPlane::new(position).to_position(by)
}

/// A standard deviation with another error, independent of it, m.
fn widened(sigma: SigmaM, other_m: f64) -> Option<SigmaM> {
    let both_m = sigma.metres().hypot(other_m);
    sigma_of_deviations(both_m, both_m)
}

/// The instant of a second of the minute, or of a number that says why there is none.
fn time_of(second: u64, received_at: Timestamp) -> Result<Timestamp, String> {
    match second {
        0..60 => Ok(at_second(received_at, second as i64)),
        60 => Ok(received_at),
        _ => Err("the position is entered manually, estimated, or out of order (second 61 to 63)".to_owned()),
    }
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
