//! The real recordings for `sightfix evaluate --paper`, from their folder.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::Context as _;
use jiff::Timestamp;

use super::files::{format_of, open_input};
use crate::clock::Clock;
use crate::domain::{
    Detection, ImageSize, Observation, Receiver, ReceiverId, Receivers, TargetClass, TargetId, TimeBounds,
};
use crate::evaluation::TestRow;
use crate::exchange::{self, FixFormat, RowRules};
use crate::fusion::pairing::{Paired, PairingRule, PairingSettings, ReceivedFix, pair};
use crate::geo::Position;
use crate::paper_experiments::RealCamera;

/// Size of the plaza's images, px.
const PLAZA_SIZE_PX: (u32, u32) = (1920, 1080);
/// The cameras of the plaza.
const PLAZA_CAMERAS: [&str; 3] = ["c1", "c2", "c3"];

/// The cameras of a folder with detections, fixes, identities and truth, by people. Those who carry a phone
/// give the training rows, all others the test rows.
pub(super) fn plaza(folder: &Path) -> anyhow::Result<Vec<RealCamera>> {
    let fixes = read_fixes(&folder.join("fixes.csv"))?;
    let people = people_by_track(&folder.join("identity.csv"))?;
    let truth = read_truth(&folder.join("truth.csv"))?;
    let receivers = receivers_of(&fixes)?;
    let camera = |&name: &&str| {
        let boxes = read_boxes(&folder.join(format!("detections_{name}.csv")))?;
        let boxes: Vec<Detection> =
            boxes.into_iter().filter_map(|detection| renamed(detection, name, &people)).collect();
        let carriers: BTreeSet<&TargetId> = receivers.iter().map(|receiver| &receiver.target_id).collect();
        let (own, others): (Vec<Detection>, Vec<Detection>) =
            boxes.into_iter().partition(|detection| carriers.contains(&detection.target_id));
        let settings = PairingSettings::new(PairingRule::Interpolated, None, None)?;
        let test_row = |detection: Detection| {
            let Detection { time, target_id, bounding_box, .. } = detection;
            let truth = truth.get(&(time, target_id.clone())).copied();
            let observation = Observation::new(time, Some(target_id), Some(bounding_box), None)?;
            Ok(TestRow { observation, truth })
        };
        let Paired { samples, unpaired_detections, .. } = pair(own, fixes.clone(), &receivers, &settings);
        Ok(RealCamera {
            name: name.to_owned(),
            train: samples,
            unpaired: unpaired_detections,
            test: others.into_iter().map(test_row).collect::<anyhow::Result<_>>()?,
            image_size: Some(ImageSize::new(PLAZA_SIZE_PX.0, PLAZA_SIZE_PX.1)?),
        })
    };
    PLAZA_CAMERAS.iter().map(camera).collect()
}

/// The detection under the id of the person whom the tracker saw, if it is known.
fn renamed(
    mut detection: Detection,
    camera: &str,
    people: &BTreeMap<(String, String), TargetId>,
) -> Option<Detection> {
    let key = (camera.to_owned(), detection.target_id.as_str().to_owned());
    detection.target_id = people.get(&key)?.clone();
    detection.class = TargetClass::new("person").ok();
    Some(detection)
}

/// `phone-K` is carried by `person-K`.
fn receivers_of(fixes: &[ReceivedFix]) -> anyhow::Result<Receivers> {
    let ids: BTreeSet<&ReceiverId> = fixes.iter().filter_map(|fix| fix.receiver_id.as_ref()).collect();
    let receiver = |id: &&ReceiverId| {
        let target_id = TargetId::new(&id.as_str().replace("phone-", "person-"))?;
        Ok(Receiver { target_id, ..Receiver::named((*id).clone()) })
    };
    let receivers: Vec<Receiver> = ids.iter().map(receiver).collect::<anyhow::Result<_>>()?;
    Ok(Receivers::new(receivers)?)
}

fn rules() -> RowRules {
    RowRules { time_bounds: TimeBounds::at(Clock::system().now()), image_size: None }
}

pub(super) fn read_boxes(path: &Path) -> anyhow::Result<Vec<Detection>> {
    let rows = exchange::read_detections(open_input(path)?, format_of(path, None)?, &rules(), None)?;
    rows.map(|row| row?.map_err(|error| anyhow::anyhow!("line {}: {}", error.line, error.reason)))
        .collect::<anyhow::Result<_>>()
        .with_context(|| format!("cannot read {}", path.display()))
}

pub(super) fn read_fixes(path: &Path) -> anyhow::Result<Vec<ReceivedFix>> {
    let rows = exchange::read_received_fixes(open_input(path)?, FixFormat::Csv, rules().time_bounds)?;
    rows.map(|row| row?.map_err(|error| anyhow::anyhow!("line {}: {}", error.line, error.reason)))
        .collect::<anyhow::Result<_>>()
        .with_context(|| format!("cannot read {}", path.display()))
}

/// The person by camera and the tracker's id: columns camera, target_id, person.
fn people_by_track(path: &Path) -> anyhow::Result<BTreeMap<(String, String), TargetId>> {
    let person = |[camera, track, person]: [&str; 3]| {
        Ok(((camera.to_owned(), track.to_owned()), TargetId::new(person)?))
    };
    read_columns(path, person)
}

/// The position by instant and person: columns time, person, longitude, latitude.
pub(super) fn read_truth(path: &Path) -> anyhow::Result<BTreeMap<(Timestamp, TargetId), Position>> {
    let position = |[time, person, longitude_deg, latitude_deg]: [&str; 4]| {
        let position = Position::new(longitude_deg.parse()?, latitude_deg.parse()?)?;
        Ok(((time.parse()?, TargetId::new(person)?), position))
    };
    read_columns(path, position)
}

/// The rows of a CSV file without quotes, after its header.
pub(super) fn read_columns<const N: usize, T, C: FromIterator<T>>(
    path: &Path,
    row: impl Fn([&str; N]) -> anyhow::Result<T>,
) -> anyhow::Result<C> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let parsed = |(index, line): (usize, &str)| {
        let columns: Vec<&str> = line.split(',').collect();
        let columns = <[&str; N]>::try_from(columns).map_err(|_| anyhow::anyhow!("must have {N} columns"));
        columns.and_then(&row).with_context(|| format!("{}: line {}", path.display(), index + 1))
    };
    text.lines().enumerate().skip(1).map(parsed).collect()
}
