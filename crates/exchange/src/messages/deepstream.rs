//! Messages of DeepStream's `nvmsgconv`, by the minimal schema (all objects of a frame as texts) or the full one (an
//! object each).
//!
//! An object of the minimal schema is `id|left|top|right|bottom|class|...`, in pixels of the stream multiplexer.
//! DeepStream sends a payload every 30 frames unless `frame-interval` says otherwise.

use serde::Deserialize;
use serde_json::{Map, Value};

use super::{
    DetectedBox, MessageContext, MessageDecoder, MessageItem, NamedDetection, Reading, class, parse, score,
};
use crate::domain::{TargetId, parse_time};

/// The id of objects that no tracker follows.
const UNTRACKED: &str = "18446744073709551615";

pub(super) struct DeepStream;

#[derive(Deserialize)]
#[serde(untagged)]
enum Payload {
    Minimal(Minimal),
    Full(Box<Full>),
}

#[derive(Deserialize)]
struct Minimal {
    #[serde(rename = "@timestamp")]
    timestamp: String,
    #[serde(rename = "sensorId")]
    sensor_id: String,
    objects: Vec<String>,
}

#[derive(Deserialize)]
struct Full {
    #[serde(rename = "@timestamp")]
    timestamp: String,
    sensor: Sensor,
    object: Object,
}

#[derive(Deserialize)]
struct Sensor {
    id: String,
}

#[derive(Deserialize)]
struct Object {
    id: String,
    bbox: Corners,
    /// The class is the name of an object with the attributes of that class.
    #[serde(flatten)]
    others: Map<String, Value>,
}

/// Corners in pixels.
#[derive(Deserialize)]
struct Corners {
    topleftx: f64,
    toplefty: f64,
    bottomrightx: f64,
    bottomrighty: f64,
}

impl MessageDecoder for DeepStream {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let mut reading = Reading::default();
        let (camera, timestamp, objects) = match parse(payload)? {
            Payload::Minimal(minimal) => {
                let objects = minimal.objects.iter().map(|text| minimal_object(text)).collect();
                (minimal.sensor_id, minimal.timestamp, objects)
            }
            Payload::Full(full) => (full.sensor.id, full.timestamp, vec![Ok(full_object(&full.object))]),
        };
        let objects: Vec<Result<Seen, String>> = objects;
        let time = parse_time(&timestamp).and_then(|time| context.time_bounds.check(time));
        let time = time.map_err(|error| error.to_string())?;
        for object in objects {
            match object.and_then(|seen| seen.named(&camera, time)) {
                Ok(detection) => reading.items.push(MessageItem::Detection(detection)),
                Err(reason) => reading.skip(reason),
            }
        }
        Ok(reading)
    }
}

struct Seen {
    id: String,
    corners_px: [f64; 4],
    class: Option<String>,
    score: Option<f64>,
}

impl Seen {
    fn named(self, camera: &str, time: jiff::Timestamp) -> Result<NamedDetection, String> {
        if self.id == UNTRACKED || self.id == "-1" {
            return Err("an object has no tracker's id; add nvtracker to the pipeline".to_owned());
        }
        Ok(NamedDetection {
            camera: camera.to_owned(),
            time,
            target_id: TargetId::new(&self.id).map_err(|error| error.to_string())?,
            detected_box: DetectedBox::Pixels(self.corners_px),
            class: self.class.as_deref().and_then(class),
            score: score(self.score),
        })
    }
}

fn minimal_object(text: &str) -> Result<Seen, String> {
    let mut fields = text.split('|');
    let id = fields.next().unwrap_or_default().trim().to_owned();
    let mut corners_px = [0.0; 4];
    for side in &mut corners_px {
        let field = fields.next().unwrap_or_default();
        *side = field.trim().parse().map_err(|_| format!("`{field}` is not a number of pixels"))?;
    }
    let class = fields.next().map(|name| name.trim().to_owned());
    // Objects with attributes end with the score of their classifier; others have nothing after the class.
    let score = fields.next_back().and_then(|field| field.trim().parse().ok());
    Ok(Seen { id, corners_px, class, score })
}

fn full_object(object: &Object) -> Seen {
    let Corners { topleftx, toplefty, bottomrightx, bottomrighty } = object.bbox;
    let attributes = object.others.iter().find(|(name, value)| {
        value.is_object()
            && !matches!(name.as_str(), "location" | "coordinate" | "embedding" | "pose" | "mask")
    });
    Seen {
        id: object.id.clone(),
        corners_px: [topleftx, toplefty, bottomrightx, bottomrighty],
        class: attributes.map(|(name, _)| name.clone()),
        score: attributes.and_then(|(_, value)| value.get("confidence")?.as_f64()),
    }
}
