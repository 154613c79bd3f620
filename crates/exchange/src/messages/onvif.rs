//! The analytics frames of an ONVIF metadata stream (`tt:MetadataStream`, ONVIF Analytics Service Specification).
//!
//! A shape is in coordinates of its own, which the frame's `Transformation` maps to the normalised image: x to the
//! right and y up, both from -1 to 1. Cameras differ in the sign of the scale of y, so the edges are ordered after the
//! transformation. An appearance may have a transformation of its own, which is applied before that of its frame. Without
//! any, edges beyond 1 are those of cameras that count the image from its upper left corner to 8191 (Dahua). An object that
//! is part of another one (`Parent`), such as a face or a number plate (Hanwha), is no target. Frames without objects
//! commonly have a scale of 0.

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::xml::{attribute, numbers};
use super::{
    DetectedBox, MessageContext, MessageDecoder, MessageItem, NamedDetection, Reading, class, score,
};
use crate::domain::{TargetId, parse_time};

pub(super) struct Onvif;

/// Maps coordinates of shapes to the normalised image: `scale * value + translation` for x and y.
#[derive(Clone, Copy)]
struct Transformation {
    translation: [f64; 2],
    scale: [f64; 2],
}

impl Transformation {
    const IDENTITY: Self = Self { translation: [0.0; 2], scale: [1.0; 2] };
    /// From 0 to 8191 with y down.
    const OF_8192: Self = Self { translation: [-1.0, 1.0], scale: [2.0 / 8191.0, -2.0 / 8191.0] };

    /// The point that it maps a point to.
    fn apply(self, [x, y]: [f64; 2]) -> [f64; 2] {
        [self.scale[0] * x + self.translation[0], self.scale[1] * y + self.translation[1]]
    }
}

/// The object whose elements are being read.
#[derive(Default)]
struct Object {
    id: String,
    /// The object that it is a part of.
    parent: Option<String>,
    transformation: Option<Transformation>,
    edges: Option<[f64; 4]>,
    class: Option<String>,
    score: Option<f64>,
}

#[derive(Default)]
struct Frames {
    time: Option<String>,
    transformation: Option<Transformation>,
    object: Option<Object>,
    /// True if the text of the element that is open is the object's class.
    reads_class: bool,
    /// The video source, where the stream names it.
    source: String,
}

impl MessageDecoder for Onvif {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let mut xml = Reader::from_reader(payload);
        let mut buffer = Vec::new();
        let mut frames = Frames::default();
        let mut reading = Reading::default();
        loop {
            buffer.clear();
            match xml.read_event_into(&mut buffer).map_err(|error| format!("is not XML: {error}"))? {
                Event::Eof => return Ok(reading),
                Event::Start(element) => frames.open(&element)?,
                Event::Empty(element) => {
                    frames.open(&element)?;
                    frames.close(element.local_name().as_ref(), context, &mut reading);
                }
                Event::Text(text) if frames.reads_class => {
                    if let Some(object) = &mut frames.object {
                        object.class.get_or_insert_with(|| text.trim().to_owned());
                    }
                }
                Event::End(element) => frames.close(element.local_name().as_ref(), context, &mut reading),
                _ => {}
            }
        }
    }
}

impl Frames {
    fn open(&mut self, element: &BytesStart<'_>) -> Result<(), String> {
        match element.local_name().as_ref() {
            "Frame" => {
                self.time = attribute(element, "UtcTime")?;
                self.transformation = None;
                if let Some(source) = attribute(element, "Source")? {
                    self.source = source;
                }
            }
            "Translate" => self.open_transformation().translation = numbers(element, ["x", "y"])?,
            "Scale" => self.open_transformation().scale = numbers(element, ["x", "y"])?,
            "Object" => {
                let id = attribute(element, "ObjectId")?.unwrap_or_default();
                let parent = attribute(element, "Parent")?.filter(|parent| !parent.is_empty());
                self.object = Some(Object { id, parent, ..Object::default() });
            }
            "BoundingBox" => {
                let edges = numbers(element, ["left", "top", "right", "bottom"])?;
                if let Some(object) = &mut self.object {
                    object.edges.get_or_insert(edges);
                }
            }
            "Type" => {
                self.reads_class = true;
                let likelihood = attribute(element, "Likelihood")?.and_then(|text| text.parse().ok());
                if let Some(object) = &mut self.object
                    && object.class.is_none()
                {
                    object.score = likelihood;
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// The transformation that is being read: of the object, or of the frame before its objects.
    fn open_transformation(&mut self) -> &mut Transformation {
        let open = match &mut self.object {
            Some(object) => &mut object.transformation,
            None => &mut self.transformation,
        };
        open.get_or_insert(Transformation::IDENTITY)
    }

    fn close(&mut self, name: &str, context: &MessageContext<'_>, reading: &mut Reading) {
        match name {
            "Type" => self.reads_class = false,
            "Object" => {
                let Some(object) = self.object.take() else { return };
                match self.detection(object, context) {
                    Ok(detection) => reading.items.push(MessageItem::Detection(detection)),
                    Err(reason) => reading.skip(reason),
                }
            }
            _ => {}
        }
    }

    fn detection(&self, object: Object, context: &MessageContext<'_>) -> Result<NamedDetection, String> {
        if let Some(parent) = &object.parent {
            return Err(format!("object {} is a part of object {parent}", object.id));
        }
        let [left, top, right, bottom] =
            object.edges.ok_or_else(|| format!("object {} has no box", object.id))?;
        let transformations = match (object.transformation, self.transformation) {
            (None, None) if [left, top, right, bottom].iter().any(|edge| edge.abs() > 1.0) => {
                [Transformation::IDENTITY, Transformation::OF_8192]
            }
            (own, of_frame) => [own, of_frame].map(|it| it.unwrap_or(Transformation::IDENTITY)),
        };
        if transformations.iter().any(|it| it.scale.contains(&0.0)) {
            return Err(format!("the frame of object {} has a scale of 0", object.id));
        }
        let normalised = |point| transformations.iter().fold(point, |point, it| it.apply(point));
        let time = self.time.as_deref().ok_or("the frame has no UtcTime")?;
        let time = parse_time(&zoned(time)).and_then(|time| context.time_bounds.check(time));
        // From -1..1 with y up to fractions of the image with y down.
        let corners = [[left, top], [right, bottom]].map(normalised);
        let [[x1, y1], [x2, y2]] = corners.map(|[x, y]| [(x + 1.0) / 2.0, (1.0 - y) / 2.0]);
        Ok(NamedDetection {
            camera: self.source.clone(),
            time: time.map_err(|error| error.to_string())?,
            target_id: TargetId::new(&object.id).map_err(|error| error.to_string())?,
            detected_box: DetectedBox::Fractions([x1.min(x2), y1.min(y2), x1.max(x2), y1.max(y2)]),
            class: object.class.as_deref().and_then(class),
            score: score(object.score),
        })
    }
}

/// A time with its offset. The attribute is in UTC by its name; some cameras leave the letter out.
fn zoned(time: &str) -> String {
    let of_day = time.split_once('T').map_or("", |(_, of_day)| of_day);
    if of_day.contains(['Z', '+', '-']) { time.to_owned() } else { format!("{time}Z") }
}
