//! Files of boxes by the number of their frame: MOTChallenge, the tracking labels of KITTI, YOLO, COCO and CVAT.
//!
//! The times of frames are those of a camera with a constant rate. Boxes without a tracker's id are row errors.

mod coco;
mod cvat;
mod lines;

use std::io::Read;

use jiff::{SignedDuration, Timestamp};
use strum::EnumString;

use super::file_row::RowError;
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
    /// YOLO: the labels of one frame with the ids of a tracker, as Ultralytics writes them.
    Yolo,
    /// COCO (JSON) with the track of each annotation, in whole in memory.
    Coco,
    /// CVAT for video (XML).
    Cvat,
}

fn unknown_format(_: &str) -> Error {
    Error::invalid("format", "must be mot, kitti, yolo, coco or cvat")
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

    /// The clock of a file that begins `frames` frames later.
    ///
    /// # Errors
    /// `InvalidArgument` naming `frame` for one beyond all times.
    pub fn after(self, frames: u32) -> Result<Self> {
        Ok(Self { start: self.time_of(frames)?, ..self })
    }

    /// The time of the frame that comes `frames` frames after the first.
    fn time_of(&self, frames: u32) -> Result<Timestamp> {
        let time =
            self.start.checked_add(SignedDuration::from_secs_f64(f64::from(frames) / self.frames_per_s));
        time.map_err(|_| Error::invalid("frame", "is too late for a time"))
    }
}

/// The number of a frame by the last digits of its file's name without the ending, such as 12 of `gate_000012`.
#[must_use]
pub fn frame_number(name: &str) -> Option<u32> {
    let digits = name.len() - name.trim_end_matches(|it: char| it.is_ascii_digit()).len();
    name[name.len() - digits..].parse().ok()
}

/// A box of a file, not checked yet.
struct FrameBox {
    /// Frames after the first.
    frames: u32,
    /// Left, top, width and height, px.
    sides: [f64; 4],
    /// The id of the target, if a tracker has followed it.
    id: Option<String>,
    class: Option<String>,
    score: Option<f64>,
}

/// The number of a line or an element with its box. The outer error: the file cannot be read further.
type NumberedBox = Result<(u64, Result<FrameBox>)>;

impl FrameBox {
    fn checked(self, clock: &FrameClock, rules: &RowRules) -> Result<Detection> {
        let id = self.id.filter(|id| id != "-1");
        let id =
            id.ok_or_else(|| Error::invalid("target_id", "is missing: no tracker has followed the box"))?;
        let [left_px, top_px, width_px, height_px] = self.sides;
        let bounding_box = BoundingBox { left_px, top_px, width_px, height_px };
        Ok(Detection {
            time: rules.time_bounds.check(clock.time_of(self.frames)?)?,
            target_id: TargetId::new(&id)?,
            bounding_box: box_within(bounding_box, rules.image_size)?,
            class: self.class.and_then(|class| TargetClass::new(&class).ok()),
            // Scores on another scale are left out.
            score: self.score.and_then(|score| Score::new(score).ok()),
        })
    }
}

/// The boxes of a file, in its order. A file of YOLO is one frame, of the time of the clock's start.
///
/// # Errors
/// An item is an error if the file cannot be read further; nothing follows. The inner error: that line, element or
/// annotation is invalid.
pub fn read_frame_file<'a, R: Read + 'a>(
    reader: R,
    format: FrameFileFormat,
    clock: FrameClock,
    rules: RowRules,
) -> Box<dyn Iterator<Item = Result<Result<Detection, RowError>>> + 'a> {
    let boxes: Box<dyn Iterator<Item = NumberedBox>> = match format {
        FrameFileFormat::Mot => Box::new(lines::boxes(reader, lines::mot)),
        FrameFileFormat::Kitti => Box::new(lines::boxes(reader, lines::kitti)),
        FrameFileFormat::Yolo => {
            Box::new(lines::boxes(reader, move |line| lines::yolo(line, rules.image_size)))
        }
        FrameFileFormat::Coco => Box::new(coco::boxes(reader)),
        FrameFileFormat::Cvat => Box::new(cvat::CvatBoxes::new(reader)),
    };
    Box::new(boxes.map(move |numbered| {
        let (number, read) = numbered?;
        match read.and_then(|it| it.checked(&clock, &rules)) {
            Ok(detection) => Ok(Ok(detection)),
            Err(error) => RowError::of(number, error).map(Err),
        }
    }))
}
