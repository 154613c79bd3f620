//! Frigate's tracked objects (`frigate/events`): a JSON object with the state before and after a change.
//!
//! Messages are not per frame: one comes when an object is first believed, when a better picture of it is found, when
//! it enters or leaves a zone, and at its end. `box` is left, top, right, bottom in pixels of the camera's detect
//! stream, at `frame_time`. `path_data` has foot points without a box, which cannot be placed by a model of boxes.
//! Messages of `frigate/tracked_object_update` (descriptions, faces, number plates) contain no box.

use serde::Deserialize;

use super::{
    DetectedBox, MessageContext, MessageDecoder, MessageItem, NamedDetection, Reading, class, parse, score,
};
use crate::domain::TargetId;
use crate::unix_time::unix_time;

pub(super) struct Frigate;

#[derive(Deserialize)]
struct Event {
    after: Option<TrackedObject>,
    /// Kind of the change, or of the update of an object without a box.
    #[serde(rename = "type")]
    kind: Option<String>,
}

#[derive(Deserialize)]
struct TrackedObject {
    id: String,
    camera: String,
    frame_time: f64,
    label: Option<String>,
    #[serde(default)]
    false_positive: bool,
    score: Option<f64>,
    #[serde(rename = "box")]
    corners_px: Option<[f64; 4]>,
}

impl MessageDecoder for Frigate {
    fn decode(&mut self, payload: &[u8], context: &MessageContext<'_>) -> Result<Reading, String> {
        let event: Event = parse(payload)?;
        let mut reading = Reading::default();
        let Some(object) = event.after else {
            reading.skip(format!("an update of the kind {} has no box", event.kind.unwrap_or_default()));
            return Ok(reading);
        };
        if object.false_positive {
            reading.skip(format!("{} is a false positive", object.id));
            return Ok(reading);
        }
        let Some(corners_px) = object.corners_px else {
            reading.skip(format!("{} has no box", object.id));
            return Ok(reading);
        };
        let time = unix_time(object.frame_time)?;
        reading.items.push(MessageItem::Detection(NamedDetection {
            time: context.time_bounds.check(time).map_err(|error| error.to_string())?,
            camera: object.camera,
            target_id: TargetId::new(&object.id).map_err(|error| error.to_string())?,
            detected_box: DetectedBox::Pixels(corners_px),
            class: object.label.as_deref().and_then(class),
            score: score(object.score),
        }));
        Ok(reading)
    }
}
