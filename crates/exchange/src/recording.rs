//! Recordings of a camera that learns, as they are stored: boxes and fixes in compact JSON.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::domain::{
    BoundingBox, Detection, Error, Fix, ReceivedFix, ReceiverId, Result, Score, SigmaM, TargetClass, TargetId,
};
use crate::geo::Position;

#[derive(Default, Serialize, Deserialize)]
struct StoredRecording {
    boxes: Vec<StoredBox>,
    fixes: Vec<StoredFix>,
}

/// Time (us since 1970), target, left, top, width and height (px), class, score.
#[derive(Serialize, Deserialize)]
struct StoredBox(i64, String, [f64; 4], Option<String>, Option<f64>);

/// Time (us since 1970), receiver, longitude and latitude (degrees), standard deviation per axis (m).
#[derive(Serialize, Deserialize)]
struct StoredFix(i64, String, [f64; 2], Option<f64>);

/// Encodes boxes and fixes; a fix that names no receiver is left out.
#[must_use]
pub fn write_recording(detections: &[Detection], fixes: &[ReceivedFix]) -> Vec<u8> {
    let boxes = detections.iter().map(|own| {
        let sides = own.bounding_box;
        StoredBox(
            own.time.as_microsecond(),
            own.target_id.as_str().to_owned(),
            [sides.left_px(), sides.top_px(), sides.width_px(), sides.height_px()],
            own.class.as_ref().map(|class| class.as_str().to_owned()),
            own.score.map(Score::value),
        )
    });
    let fixes = fixes.iter().filter_map(|own| {
        let Fix { position, sigma_m } = own.fix;
        Some(StoredFix(
            own.time.as_microsecond(),
            own.receiver_id.as_ref()?.as_str().to_owned(),
            [position.longitude_deg(), position.latitude_deg()],
            sigma_m.map(SigmaM::metres),
        ))
    });
    let stored = StoredRecording { boxes: boxes.collect(), fixes: fixes.collect() };
    // Finite numbers and texts are always JSON.
    serde_json::to_vec(&stored).unwrap_or_default()
}

/// Reads what [`write_recording`] has written.
///
/// # Errors
/// A fault: the stored bytes are not what was written.
pub fn read_recording(content: &[u8]) -> Result<(Vec<Detection>, Vec<ReceivedFix>)> {
    let stored: StoredRecording = serde_json::from_slice(content).map_err(Error::fault)?;
    let boxes = stored.boxes.into_iter().map(StoredBox::read).collect::<Result<_>>().map_err(Error::fault)?;
    let fixes = stored.fixes.into_iter().map(StoredFix::read).collect::<Result<_>>().map_err(Error::fault)?;
    Ok((boxes, fixes))
}

impl StoredBox {
    fn read(self) -> Result<Detection> {
        let Self(time_us, target_id, [left_px, top_px, width_px, height_px], class, score) = self;
        Ok(Detection {
            time: Timestamp::from_microsecond(time_us).map_err(Error::fault)?,
            target_id: TargetId::new(&target_id)?,
            bounding_box: BoundingBox::new(left_px, top_px, width_px, height_px)?,
            class: class.as_deref().map(TargetClass::new).transpose()?,
            score: score.map(Score::new).transpose()?,
        })
    }
}

impl StoredFix {
    fn read(self) -> Result<ReceivedFix> {
        let Self(time_us, receiver_id, [longitude_deg, latitude_deg], sigma_m) = self;
        let position = Position::new(longitude_deg, latitude_deg).map_err(Error::fault)?;
        Ok(ReceivedFix {
            time: Timestamp::from_microsecond(time_us).map_err(Error::fault)?,
            receiver_id: Some(ReceiverId::new(&receiver_id)?),
            fix: Fix { position, sigma_m: sigma_m.map(SigmaM::new).transpose()? },
        })
    }
}
