//! The analytics frames of an ONVIF metadata stream (`tt:MetadataStream`, ONVIF Analytics Service Specification).
//!
//! A shape is in coordinates of its own, which the frame's `Transformation` maps to the normalised image: x to the
//! right and y up, both from -1 to 1. Cameras differ in the sign of the scale of y, so the edges are ordered after the
//! transformation. Frames without objects commonly have a scale of 0.

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

impl Default for Transformation {
    fn default() -> Self {
        Self { translation: [0.0; 2], scale: [1.0; 2] }
    }
}

/// The object whose elements are being read.
#[derive(Default)]
struct Object {
    id: String,
    edges: Option<[f64; 4]>,
    class: Option<String>,
    score: Option<f64>,
}

#[derive(Default)]
struct Frames {
    time: Option<String>,
    transformation: Transformation,
    object: Option<Object>,
    /// Whether the text of the element that is open is the object's class.
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
                self.transformation = Transformation::default();
                if let Some(source) = attribute(element, "Source")? {
                    self.source = source;
                }
            }
            "Translate" => self.transformation.translation = numbers(element, ["x", "y"])?,
            "Scale" => self.transformation.scale = numbers(element, ["x", "y"])?,
            "Object" => {
                let id = attribute(element, "ObjectId")?.unwrap_or_default();
                self.object = Some(Object { id, ..Object::default() });
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
        let [left, top, right, bottom] =
            object.edges.ok_or_else(|| format!("object {} has no box", object.id))?;
        let Transformation { translation, scale } = self.transformation;
        if scale.contains(&0.0) {
            return Err(format!("the frame of object {} has a scale of 0", object.id));
        }
        let time = self.time.as_deref().ok_or("the frame has no UtcTime")?;
        // The attribute is in UTC by its name; some cameras leave the letter out.
        let zoned =
            if time.ends_with('Z') || time.contains('+') { time.to_owned() } else { format!("{time}Z") };
        let time = parse_time(&zoned).and_then(|time| context.time_bounds.check(time));
        // From -1..1 with y up to fractions of the image with y down.
        let across = |x: f64| (scale[0] * x + translation[0] + 1.0) / 2.0;
        let down = |y: f64| (1.0 - (scale[1] * y + translation[1])) / 2.0;
        let ((x1, x2), (y1, y2)) = ((across(left), across(right)), (down(top), down(bottom)));
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
