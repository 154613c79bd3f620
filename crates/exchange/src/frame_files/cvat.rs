//! CVAT for video 1.1 (XML): tracks with a box per frame, numbered from 0, with its corners in pixels.

use std::io::Read;

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::{FrameBox, NumberedBox};
use crate::domain::{Error, ErrorKind, Result};
use crate::xml::{BoundedReader, Element, numbers};

/// The boxes of a file, numbered by their lines.
pub(super) struct CvatBoxes<R> {
    reader: Reader<BoundedReader<R>>,
    buffer: Vec<u8>,
    track: Track,
    has_ended: bool,
}

/// The track that is open.
#[derive(Default, Clone)]
struct Track {
    id: Option<String>,
    label: Option<String>,
}

impl<R: Read> CvatBoxes<R> {
    pub(super) fn new(reader: R) -> Self {
        let reader = Reader::from_reader(BoundedReader::new(reader));
        Self { reader, buffer: Vec::new(), track: Track::default(), has_ended: false }
    }

    /// The box of the next event; `None` for an event without one.
    fn read_event(&mut self) -> Result<Option<(u64, Result<FrameBox>)>> {
        self.buffer.clear();
        self.reader.get_mut().begin_event();
        let event = self.reader.read_event_into(&mut self.buffer);
        let line = self.reader.get_ref().line();
        let malformed =
            |reason: &str| Error::refused(ErrorKind::MalformedBody, format!("line {line}: {reason}"));
        match event.map_err(|error| malformed(&format!("is not XML: {error}")))? {
            Event::Eof => self.has_ended = true,
            Event::Start(element) | Event::Empty(element) => match element.local_name().as_ref() {
                "image" => {
                    return Err(malformed("is CVAT for images, without tracks; export CVAT for video"));
                }
                "track" => self.track = track(&element).map_err(|error| malformed(&error))?,
                "box" if !is_outside(&element) => {
                    return Ok(Some((line, self.track.clone().into_box(&element))));
                }
                _ => {}
            },
            _ => {}
        }
        Ok(None)
    }
}

impl<R: Read> Iterator for CvatBoxes<R> {
    type Item = NumberedBox;

    fn next(&mut self) -> Option<NumberedBox> {
        while !self.has_ended {
            let read = self.read_event();
            self.has_ended |= read.is_err();
            if let Some(item) = read.transpose() {
                return Some(item);
            }
        }
        None
    }
}

fn track(element: &BytesStart<'_>) -> std::result::Result<Track, String> {
    Ok(Track { id: element.attribute("id")?, label: element.attribute("label")? })
}

/// True if the target has left the image: the box is where it was last.
fn is_outside(element: &BytesStart<'_>) -> bool {
    element.attribute("outside").is_ok_and(|outside| outside.as_deref() == Some("1"))
}

impl Track {
    fn into_box(self, element: &BytesStart<'_>) -> Result<FrameBox> {
        let invalid = |field: &str| {
            let field = field.to_owned();
            move |reason: String| Error::invalid(field, reason)
        };
        let [frame] = numbers(element, ["frame"]).map_err(invalid("frame"))?;
        let [left, top, right, bottom] =
            numbers(element, ["xtl", "ytl", "xbr", "ybr"]).map_err(invalid("bounding_box"))?;
        if frame.fract() != 0.0 || !(0.0..=f64::from(u32::MAX)).contains(&frame) {
            return Err(Error::invalid("frame", "must be a whole number from 0"));
        }
        Ok(FrameBox {
            frames: frame as u32,
            sides: [left, top, right - left, bottom - top],
            id: self.id,
            class: self.label,
            score: None,
        })
    }
}
