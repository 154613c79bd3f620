//! The analytics frames of an ONVIF metadata stream (`tt:MetadataStream`, ONVIF Analytics Service Specification), in XML or
//! in the JSON of MQTT topics `.../onvif-mj/VideoAnalytics/...`, whose names of attributes begin with `@`.
//!
//! A shape is in coordinates of its own, which the frame's `Transformation` maps to the normalised image: x to the
//! right and y up, both from -1 to 1. Cameras differ in the sign of the scale of y, so the edges are ordered after the
//! transformation. An appearance may have a transformation of its own, which is applied before that of its frame. Without
//! any, edges beyond 1 are those of cameras that count the image from its upper left corner to 8191 (Dahua). An object that
//! is part of another one (`Parent`), such as a face or a number plate (Hanwha), is no target; a parent of `0` is none.
//! Frames without objects commonly have a scale of 0.

use quick_xml::Reader;
use quick_xml::events::Event;
use serde_json::{Map, Value};

use super::{
    DetectedBox, MessageContext, MessageDecoder, MessageItem, NamedDetection, Reading, class, parse, score,
};
use crate::domain::{TargetId, parse_time};
use crate::xml::{Element, not_xml, numbers};

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
        let mut reading = Reading::default();
        if payload.trim_ascii_start().starts_with(b"{") {
            let stream = parse::<Map<String, Value>>(payload)?;
            Frames::default().read_children(&stream, context, &mut reading)?;
        } else {
            Frames::default().read_xml(payload, context, &mut reading)?;
        }
        Ok(reading)
    }
}

impl Element for Map<String, Value> {
    fn attribute(&self, name: &str) -> Result<Option<String>, String> {
        Ok(self.get(&format!("@{name}")).map(text_of))
    }
}

/// A value as the text that it is in XML.
fn text_of(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

impl Frames {
    fn read_xml(
        &mut self,
        payload: &[u8],
        context: &MessageContext<'_>,
        reading: &mut Reading,
    ) -> Result<(), String> {
        let mut xml = Reader::from_reader(payload);
        let mut buffer = Vec::new();
        loop {
            buffer.clear();
            match xml.read_event_into(&mut buffer).map_err(not_xml)? {
                Event::Eof => return Ok(()),
                Event::Start(element) => self.open(element.local_name().as_ref(), &element)?,
                Event::Empty(element) => {
                    self.open(element.local_name().as_ref(), &element)?;
                    self.close(element.local_name().as_ref(), context, reading);
                }
                Event::Text(text) => self.read_text(&text),
                Event::End(element) => self.close(element.local_name().as_ref(), context, reading),
                _ => {}
            }
        }
    }

    /// Reads the elements inside of one. A transformation holds for what is beside it, and the class of an object is not
    /// that of what it carries, so both are read before the rest.
    fn read_children(
        &mut self,
        parent: &Map<String, Value>,
        context: &MessageContext<'_>,
        reading: &mut Reading,
    ) -> Result<(), String> {
        let is_first = |name: &str| matches!(name, "Transformation" | "Class");
        let (first, rest): (Vec<_>, Vec<_>) = parent.iter().partition(|(name, _)| is_first(name));
        let is_element = |(name, _): &(&String, &Value)| !name.starts_with(['@', '#']);
        for (name, value) in first.into_iter().chain(rest).filter(is_element) {
            let elements = value.as_array().map_or_else(|| std::slice::from_ref(value), Vec::as_slice);
            for element in elements {
                self.read_json(name, element, context, reading)?;
            }
        }
        Ok(())
    }

    /// Reads an element: an object, or the text of one without attributes.
    fn read_json(
        &mut self,
        name: &str,
        value: &Value,
        context: &MessageContext<'_>,
        reading: &mut Reading,
    ) -> Result<(), String> {
        let without_attributes = Map::new();
        let element = value.as_object().unwrap_or(&without_attributes);
        self.open(name, element)?;
        self.read_children(element, context, reading)?;
        let text = if value.is_object() { element.get("#text") } else { Some(value) };
        text.into_iter().for_each(|text| self.read_text(&text_of(text)));
        self.close(name, context, reading);
        Ok(())
    }

    /// Takes a text, which is the object's class where that is open.
    fn read_text(&mut self, text: &str) {
        if let Some(object) = self.object.as_mut().filter(|_| self.reads_class) {
            object.class.get_or_insert_with(|| text.trim().to_owned());
        }
    }

    fn open(&mut self, name: &str, element: &impl Element) -> Result<(), String> {
        match name {
            "Frame" => {
                self.time = element.attribute("UtcTime")?;
                self.transformation = None;
                if let Some(source) = element.attribute("Source")? {
                    self.source = source;
                }
            }
            "Translate" => self.open_transformation().translation = numbers(element, ["x", "y"])?,
            "Scale" => self.open_transformation().scale = numbers(element, ["x", "y"])?,
            "Object" => {
                let id = element.attribute("ObjectId")?.unwrap_or_default();
                let parent =
                    element.attribute("Parent")?.filter(|parent| !matches!(parent.as_str(), "" | "0"));
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
                let likelihood = element.attribute("Likelihood")?.and_then(|text| text.parse().ok());
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
