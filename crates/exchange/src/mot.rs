//! Tracks as lines of the MOTChallenge with world coordinates (3D MOT 2015, Leal-Taixé et al. 2015):
//! `frame,id,-1,-1,-1,-1,confidence,x,y,z`.

use std::collections::HashMap;
use std::io::{self, Write};

use jiff::Timestamp;

use crate::domain::{ArchivedPosition, Error, Result, TRACK_GAP};
use crate::geo::{EastNorth, LocalPlane, Position};

/// Tracks that are remembered before those that have ended are forgotten.
const TRACKS: usize = 10_000;

/// The origins of frame numbers and coordinates.
#[derive(Debug, Clone, PartialEq)]
pub struct MotFrames {
    plane: LocalPlane,
    start: Timestamp,
    frame_hz: f64,
}

impl MotFrames {
    /// Frames of a rate, of which the first is at `start`; x to the east and y to the north of `origin`, m.
    ///
    /// # Errors
    /// Names `frame_hz` unless it is 0.001 to 1,000.
    pub fn new(origin: Position, start: Timestamp, frame_hz: f64) -> Result<Self> {
        if !(0.001..=1_000.0).contains(&frame_hz) {
            return Err(Error::invalid("frame_hz", "must be 0.001 to 1000"));
        }
        Ok(Self { plane: LocalPlane::new(origin), start, frame_hz })
    }

    /// The nearest frame; the first is 1.
    fn frame(&self, time: Timestamp) -> i64 {
        (time.duration_since(self.start).as_secs_f64() * self.frame_hz).round() as i64 + 1
    }
}

/// Writes positions of finished tracks, which come in order of time. A track has at most one line per frame. Positions
/// beyond the range of the plane are left out.
pub(super) struct MotWriter<W> {
    pub(super) out: W,
    frames: MotFrames,
    tracks: HashMap<String, MotTrack>,
    latest_id: u64,
}

/// The number of a track and the last line that was written of it.
struct MotTrack {
    id: u64,
    frame: i64,
    time: Timestamp,
}

impl<W: Write> MotWriter<W> {
    pub(super) fn new(out: W, frames: MotFrames) -> Self {
        Self { out, frames, tracks: HashMap::new(), latest_id: 0 }
    }

    pub(super) fn write(&mut self, row: &ArchivedPosition) -> io::Result<()> {
        let Some(EastNorth { east_m, north_m }) = self.frames.plane.to_plane_within_range(row.position)
        else {
            return Ok(());
        };
        let frame = self.frames.frame(row.time);
        let Some(id) = self.id_in_frame(row, frame) else { return Ok(()) };
        writeln!(self.out, "{frame},{id},-1,-1,-1,-1,1,{east_m:.3},{north_m:.3},0")
    }

    /// The number of a row's track; `None` if the track has a line in the frame already.
    fn id_in_frame(&mut self, row: &ArchivedPosition, frame: i64) -> Option<u64> {
        if let Some(track) = self.tracks.get_mut(&row.track) {
            let is_new = frame > track.frame;
            track.frame = frame;
            track.time = row.time;
            return is_new.then_some(track.id);
        }
        if self.tracks.len() >= TRACKS {
            self.tracks.retain(|_, track| row.time.duration_since(track.time) < TRACK_GAP);
        }
        self.latest_id += 1;
        self.tracks.insert(row.track.clone(), MotTrack { id: self.latest_id, frame, time: row.time });
        Some(self.latest_id)
    }
}
