//! Files of boxes by the number of their frame: MOTChallenge and the tracking labels of KITTI.
//!
//! The times of frames are those of a camera with a constant rate. A line of MOTChallenge is
//! `frame,id,left,top,width,height,score,...` with frames and pixels from 1; one of KITTI is
//! `frame id class truncated occluded alpha left top right bottom ...` with frames and pixels from 0, and a score at its
//! end where a tracker wrote it. Boxes without a tracker's id (-1) are row errors.

use std::io::Read;

use jiff::{SignedDuration, Timestamp};
use strum::EnumString;

use super::file_row::RowError;
use super::lines::{Line, Lines};
use super::rows::RowRules;
use super::wire::{BoundingBox, box_within};
use crate::domain::{Detection, Error, Result, Score, TargetClass, TargetId};

/// A format of boxes by the number of their frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, EnumString)]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_format)]
pub enum FrameFileFormat {
    /// MOTChallenge: ground truth, detections of trackers, results.
    Mot,
    /// KITTI: tracking labels and results.
    Kitti,
}

fn unknown_format(_: &str) -> Error {
    Error::invalid("format", "must be mot or kitti")
}

/// When frames were taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameClock {
    start: Timestamp,
    frames_per_s: f64,
}

impl FrameClock {
    /// A clock whose first frame is of `start`, with a constant rate, 1/s.
    ///
    /// # Errors
    /// `InvalidArgument` naming `frame_rate` for one that is not above 0 and at most 1,000.
    pub fn new(start: Timestamp, frames_per_s: f64) -> Result<Self> {
        if frames_per_s > 0.0 && frames_per_s <= 1_000.0 {
            return Ok(Self { start, frames_per_s });
        }
        Err(Error::invalid("frame_rate", "must be above 0 and at most 1000 frames per second"))
    }

    /// The time of the frame that comes `frames` frames after the first.
    fn time_of(&self, frames: u32) -> Result<Timestamp> {
        let time =
            self.start.checked_add(SignedDuration::from_secs_f64(f64::from(frames) / self.frames_per_s));
        time.map_err(|_| Error::invalid("frame", "is too late for a time"))
    }
}

/// The boxes of a file, in its order.
///
/// # Errors
/// An item is an error if the file cannot be read further; nothing follows. The inner error: that line is invalid.
pub fn read_frame_file<R: Read>(
    reader: R,
    format: FrameFileFormat,
    clock: FrameClock,
    rules: RowRules,
) -> impl Iterator<Item = Result<Result<Detection, RowError>>> {
    let mut lines = Lines::new(reader);
    std::iter::from_fn(move || {
        loop {
            let (number, line) = match lines.next_line() {
                Ok(Some(line)) => line,
                Ok(None) => return None,
                Err(error) => return Some(Err(Error::fault(error))),
            };
            let text = match line {
                Line::Text(text) if text.trim().is_empty() => continue,
                Line::Text(text) => text,
                Line::NotUtf8 => return Some(Ok(Err(RowError::whole(number, "is not UTF-8")))),
                Line::TooLong => return Some(Ok(Err(RowError::whole(number, "is longer than 64 KiB")))),
            };
            return Some(match format.detection(text, &clock, &rules) {
                Ok(detection) => Ok(Ok(detection)),
                Err(error) => RowError::of(number, error).map(Err),
            });
        }
    })
}

impl FrameFileFormat {
    fn detection(self, line: &str, clock: &FrameClock, rules: &RowRules) -> Result<Detection> {
        let fields: Fields<'_> = match self {
            Self::Mot => Fields(line.split(',').map(str::trim).collect()),
            Self::Kitti => Fields(line.split_ascii_whitespace().collect()),
        };
        let first_frame = match self {
            Self::Mot => 1,
            Self::Kitti => 0,
        };
        let frames = fields.parse::<u32>(0, "frame")?.checked_sub(first_frame);
        let frames = frames.ok_or_else(|| Error::invalid("frame", "must be at least 1"))?;
        let (sides, class, score) = match self {
            Self::Mot => {
                let [left, top, width_px, height_px] = fields.sides(2)?;
                ([left - 1.0, top - 1.0, width_px, height_px], None, fields.score(6))
            }
            Self::Kitti => {
                let [left, top, right, bottom] = fields.sides(6)?;
                ([left, top, right - left, bottom - top], fields.0.get(2), fields.score(17))
            }
        };
        let [left_px, top_px, width_px, height_px] = sides;
        let bounding_box = BoundingBox { left_px, top_px, width_px, height_px };
        Ok(Detection {
            time: rules.time_bounds.check(clock.time_of(frames)?)?,
            target_id: fields.target()?,
            bounding_box: box_within(bounding_box, rules.image_size)?,
            class: class.and_then(|class| TargetClass::new(class).ok()),
            score,
        })
    }
}

struct Fields<'a>(Vec<&'a str>);

impl Fields<'_> {
    fn parse<T: std::str::FromStr>(&self, at: usize, name: &str) -> Result<T> {
        let text = self.0.get(at).copied().unwrap_or_default();
        text.parse().map_err(|_| Error::invalid(name, format!("`{text:.40}` is not such a number")))
    }

    fn sides(&self, from: usize) -> Result<[f64; 4]> {
        let mut sides = [0.0; 4];
        for (at, side) in sides.iter_mut().enumerate() {
            *side = self.parse(from + at, "bounding_box")?;
        }
        Ok(sides)
    }

    fn target(&self) -> Result<TargetId> {
        match self.0.get(1).copied().unwrap_or_default() {
            "-1" => Err(Error::invalid("target_id", "is -1: no tracker has followed the box")),
            id => TargetId::new(id),
        }
    }

    /// A score from 0 to 1; others are left out.
    fn score(&self, at: usize) -> Option<Score> {
        Score::new(self.0.get(at)?.parse().ok()?).ok()
    }
}
