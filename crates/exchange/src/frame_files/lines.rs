//! A box per line of text.

use std::io::Read;

use super::{FrameBox, NumberedBox};
use crate::domain::{Error, ImageSize, Result};
use crate::lines::{Line, Lines};

/// The boxes of the lines that are not empty.
pub(super) fn boxes<R: Read>(
    reader: R,
    read: impl Fn(&str) -> Result<FrameBox>,
) -> impl Iterator<Item = NumberedBox> {
    let mut lines = Lines::new(reader);
    std::iter::from_fn(move || {
        loop {
            let (number, line) = match lines.next_line() {
                Ok(line) => line?,
                Err(error) => return Some(Err(Error::fault(error))),
            };
            let read = match line {
                Line::Text(text) if text.trim().is_empty() => continue,
                Line::Text(text) => read(text),
                Line::NotUtf8 => Err(Error::invalid("", "is not UTF-8")),
                Line::TooLong => Err(Error::invalid("", "is longer than 64 KiB")),
            };
            return Some(Ok((number, read)));
        }
    })
}

/// `frame,id,left,top,width,height,score,...` with frames and pixels from 1.
pub(super) fn mot(line: &str) -> Result<FrameBox> {
    let fields = Fields(line.split(',').map(str::trim).collect());
    let frames = fields.parse::<u32>(0, "frame")?.checked_sub(1);
    let [left, top, width, height] = fields.sides(2)?;
    Ok(FrameBox {
        frames: frames.ok_or_else(|| Error::invalid("frame", "must be at least 1"))?,
        sides: [left - 1.0, top - 1.0, width, height],
        id: fields.text(1),
        class: None,
        score: fields.number(6),
    })
}

/// `frame id class truncated occluded alpha left top right bottom ...` with frames and pixels from 0, and a score at the end
/// where a tracker wrote it.
pub(super) fn kitti(line: &str) -> Result<FrameBox> {
    let fields = Fields(line.split_ascii_whitespace().collect());
    let [left, top, right, bottom] = fields.sides(6)?;
    Ok(FrameBox {
        frames: fields.parse(0, "frame")?,
        sides: [left, top, right - left, bottom - top],
        id: fields.text(1),
        class: fields.text(2),
        score: fields.number(17),
    })
}

/// `class x y width height [score] id` with the middle and the size of the box as shares of the image. The class is a number.
pub(super) fn yolo(line: &str, image_size: Option<ImageSize>) -> Result<FrameBox> {
    let size = image_size
        .ok_or_else(|| Error::invalid("image_size", "is required: the boxes are shares of the image"))?;
    let fields = Fields(line.split_ascii_whitespace().collect());
    let [x, y, width, height] = fields.sides(1)?;
    let [image_width, image_height] = [size.width_px(), size.height_px()].map(f64::from);
    let (score, id) = match fields.0.len() {
        ..=5 => (None, None),
        6 => (None, fields.text(5)),
        _ => (fields.number(5), fields.text(6)),
    };
    Ok(FrameBox {
        frames: 0,
        sides: [
            (x - width / 2.0) * image_width,
            (y - height / 2.0) * image_height,
            width * image_width,
            height * image_height,
        ],
        // Without a tracker the last number is a score.
        id: id.filter(|id| id.bytes().all(|it| it.is_ascii_digit())),
        class: fields.text(0),
        score,
    })
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

    fn text(&self, at: usize) -> Option<String> {
        self.0.get(at).map(|text| (*text).to_owned())
    }

    fn number(&self, at: usize) -> Option<f64> {
        self.0.get(at)?.parse().ok()
    }
}
