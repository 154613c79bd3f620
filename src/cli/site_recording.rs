//! A recorded site from its folder: detections_<CAMERA>.csv per camera, fixes.csv, identity.csv, truth.csv.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::Context as _;
use jiff::Timestamp;

use super::recordings::{read_boxes, read_columns, read_fixes, read_truth};
use crate::domain::{CameraId, Detection, ImageSize, ReceivedFix, ReceiverId, TargetId};
use crate::evaluation::site::{LabelledBox, RecordedCamera, RecordedFix, SiteRecording};
use crate::geo::LocalPlane;

/// An interval in which a tracker's id was of one target: camera, id, target, from, until.
struct Segment {
    target: TargetId,
    from: Timestamp,
    until: Timestamp,
}

type Segments = BTreeMap<(String, String), Vec<Segment>>;

/// Reads the folder. `phone-K` is carried by the target whose name ends with `-K`.
pub(super) fn read(folder: &Path, image_size: Option<ImageSize>) -> anyhow::Result<SiteRecording> {
    let fixes = read_fixes(&folder.join("fixes.csv"))?;
    let segments = read_segments(&folder.join("identity.csv"))?;
    let truth = read_truth(&folder.join("truth.csv"))?;
    let names: BTreeSet<&TargetId> = truth.keys().map(|(_, target)| target).collect();
    let targets: Vec<TargetId> = names.into_iter().cloned().collect();
    let first = truth.values().next().context("truth.csv has no row")?;
    let plane = LocalPlane::new(*first);
    let index_of = |target: &TargetId| targets.binary_search(target).ok();
    let receivers = receivers(&fixes, &targets);
    let camera = |name: &String| {
        let id = CameraId::new(name).map_err(anyhow::Error::from)?;
        let boxes = read_boxes(&folder.join(format!("detections_{name}.csv")))?;
        let labelled = |detection: Detection| LabelledBox {
            target: target_of(&segments, name, &detection).and_then(index_of),
            time: detection.time,
            tracker_id: detection.target_id,
            bounding_box: detection.bounding_box,
        };
        Ok(RecordedCamera { id, boxes: boxes.into_iter().map(labelled).collect() })
    };
    let recorded_fix = |fix: &ReceivedFix| {
        let receiver = receivers.iter().position(|(id, _)| Some(id) == fix.receiver_id.as_ref())?;
        Some(RecordedFix { receiver, time: fix.time, position: plane.to_plane(fix.fix.position) })
    };
    let mut recorded: Vec<RecordedFix> = fixes.iter().filter_map(recorded_fix).collect();
    recorded.sort_by_key(|fix| (fix.time, fix.receiver));
    Ok(SiteRecording {
        plane,
        image_size,
        cameras: camera_names(folder)?.iter().map(camera).collect::<anyhow::Result<_>>()?,
        fixes: recorded,
        truth: truth
            .iter()
            .filter_map(|((time, target), at)| Some(((*time, index_of(target)?), plane.to_plane(*at))))
            .collect(),
        receivers,
        targets,
        known_points: Vec::new(),
    })
}

/// The CAMERA of every detections_<CAMERA>.csv, sorted.
fn camera_names(folder: &Path) -> anyhow::Result<Vec<String>> {
    let cannot = || format!("cannot read the folder {}", folder.display());
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(cannot)? {
        let file = entry.with_context(cannot)?.file_name();
        let name = file.to_str().and_then(|name| name.strip_prefix("detections_")?.strip_suffix(".csv"));
        names.extend(name.map(str::to_owned));
    }
    anyhow::ensure!(!names.is_empty(), "{} has no file detections_<CAMERA>.csv", folder.display());
    names.sort();
    Ok(names)
}

fn receivers(fixes: &[ReceivedFix], targets: &[TargetId]) -> Vec<(ReceiverId, usize)> {
    let ids: BTreeSet<&ReceiverId> = fixes.iter().filter_map(|fix| fix.receiver_id.as_ref()).collect();
    let number = |name: &str| name.rsplit_once('-').map(|(_, number)| number.to_owned());
    let carrier = |id: &&ReceiverId| {
        let own = number(id.as_str())?;
        let target = targets.iter().position(|target| number(target.as_str()).as_ref() == Some(&own))?;
        Some(((*id).clone(), target))
    };
    ids.iter().filter_map(carrier).collect()
}

fn target_of<'a>(segments: &'a Segments, camera: &str, detection: &Detection) -> Option<&'a TargetId> {
    let key = (camera.to_owned(), detection.target_id.as_str().to_owned());
    let is_then = |segment: &&Segment| (segment.from..=segment.until).contains(&detection.time);
    segments.get(&key)?.iter().find(is_then).map(|segment| &segment.target)
}

/// Columns camera, target_id, person, and optionally from and until where an id changes hands.
fn read_segments(path: &Path) -> anyhow::Result<Segments> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let has_times = text.lines().next().is_some_and(|header| header.ends_with(",from,until"));
    let rows: Vec<(String, String, Segment)> = if has_times {
        read_columns(path, |[camera, id, person, from, until]: [&str; 5]| {
            let segment =
                Segment { target: TargetId::new(person)?, from: from.parse()?, until: until.parse()? };
            Ok((camera.to_owned(), id.to_owned(), segment))
        })?
    } else {
        read_columns(path, |[camera, id, person]: [&str; 3]| {
            let target = TargetId::new(person)?;
            let segment = Segment { target, from: Timestamp::MIN, until: Timestamp::MAX };
            Ok((camera.to_owned(), id.to_owned(), segment))
        })?
    };
    let mut segments = Segments::new();
    for (camera, id, segment) in rows {
        segments.entry((camera, id)).or_default().push(segment);
    }
    Ok(segments)
}
