//! COCO's object detection format (JSON), whose annotations have a track: `track_id` or `instance_id`, or `track_id` among the
//! `attributes`, as CVAT exports it.
//!
//! The number of a frame is the `frame_id`, `frame_index` or `frame_number` of its image, or else that in the name of its file;
//! the first is the lowest of them.

use std::collections::HashMap;
use std::io::{BufReader, Read};

use serde::Deserialize;

use super::{FrameBox, NumberedBox, frame_number};
use crate::domain::{Error, ErrorKind, Result};

#[derive(Deserialize)]
struct Document {
    images: Vec<Image>,
    annotations: Vec<Annotation>,
    #[serde(default)]
    categories: Vec<Category>,
}

#[derive(Deserialize)]
struct Image {
    id: u64,
    #[serde(default)]
    file_name: String,
    #[serde(alias = "frame_index", alias = "frame_number")]
    frame_id: Option<u32>,
    video_id: Option<u64>,
}

#[derive(Deserialize)]
struct Category {
    id: u64,
    name: String,
}

#[derive(Deserialize)]
struct Annotation {
    image_id: u64,
    category_id: Option<u64>,
    /// Left, top, width and height, px.
    bbox: Vec<f64>,
    score: Option<f64>,
    #[serde(alias = "instance_id")]
    track_id: Option<TrackId>,
    #[serde(default)]
    attributes: Attributes,
}

#[derive(Deserialize, Default)]
struct Attributes {
    track_id: Option<TrackId>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum TrackId {
    Number(i64),
    Text(String),
}

impl Image {
    fn frame(&self) -> Option<u32> {
        let stem = self.file_name.rsplit_once('.').map_or(self.file_name.as_str(), |(stem, _)| stem);
        self.frame_id.or_else(|| frame_number(stem))
    }
}

impl Document {
    fn read<R: Read>(reader: R) -> Result<Self> {
        let malformed = |message: String| Error::refused(ErrorKind::MalformedBody, message);
        let document: Self = serde_json::from_reader(BufReader::new(reader))
            .map_err(|error| malformed(format!("is not COCO's JSON: {error}")))?;
        let mut videos = document.images.iter().filter_map(|image| image.video_id);
        let first = videos.next();
        if videos.any(|video| Some(video) != first) {
            return Err(malformed("has images of several videos; give one at a time".to_owned()));
        }
        Ok(document)
    }

    fn into_boxes(self) -> impl Iterator<Item = NumberedBox> {
        let first = self.images.iter().filter_map(Image::frame).min().unwrap_or(0);
        let frames: HashMap<u64, u32> =
            self.images.iter().filter_map(|image| Some((image.id, image.frame()? - first))).collect();
        let classes: HashMap<u64, String> =
            self.categories.into_iter().map(|category| (category.id, category.name)).collect();
        let boxes =
            self.annotations.into_iter().map(move |annotation| annotation.into_box(&frames, &classes));
        (1..).zip(boxes).map(Ok)
    }
}

impl Annotation {
    fn into_box(self, frames: &HashMap<u64, u32>, classes: &HashMap<u64, String>) -> Result<FrameBox> {
        let frame = frames.get(&self.image_id).copied();
        let sides = <[f64; 4]>::try_from(self.bbox);
        let id = self.track_id.or(self.attributes.track_id).map(|id| match id {
            TrackId::Number(number) => number.to_string(),
            TrackId::Text(text) => text,
        });
        Ok(FrameBox {
            frames: frame.ok_or_else(|| {
                Error::invalid(
                    "image_id",
                    format!("{}: no image of this id has the number of a frame", self.image_id),
                )
            })?,
            sides: sides.map_err(|_| Error::invalid("bbox", "must be left, top, width and height"))?,
            id,
            class: self.category_id.and_then(|id| classes.get(&id).cloned()),
            score: self.score,
        })
    }
}

/// The boxes of the annotations, numbered from 1.
pub(super) fn boxes<R: Read>(reader: R) -> impl Iterator<Item = NumberedBox> {
    let (boxes, error) = match Document::read(reader) {
        Ok(document) => (Some(document.into_boxes()), None),
        Err(error) => (None, Some(Err(error))),
    };
    boxes.into_iter().flatten().chain(error)
}
