//! Boxes without a fix, which tell the geometry of a camera but not its place.

use std::collections::BTreeMap;

use crate::domain::{BoundingBox, Detection, Sample, TargetClass};

/// A box of a target.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TargetBox {
    /// Index of the target, from 0; the boxes of one are adjacent and in order of time.
    pub(crate) target: u32,
    pub(crate) bounding_box: BoundingBox,
}

/// The detections of the class that most samples have, in the order of target and time. Targets of other
/// classes have other heights.
pub(crate) fn unpaired_boxes(samples: &[Sample], unpaired: &[Detection]) -> Vec<TargetBox> {
    let class = most_frequent_class(samples);
    let mut sorted: Vec<&Detection> = unpaired.iter().filter(|own| own.class.as_ref() == class).collect();
    sorted.sort_by(|one, other| (&one.target_id, one.time).cmp(&(&other.target_id, other.time)));
    let mut target = 0;
    let mut boxes = Vec::with_capacity(sorted.len());
    for (at, own) in sorted.iter().enumerate() {
        target += u32::from(at > 0 && sorted[at - 1].target_id != own.target_id);
        boxes.push(TargetBox { target, bounding_box: own.bounding_box });
    }
    boxes
}

fn most_frequent_class(samples: &[Sample]) -> Option<&TargetClass> {
    let mut counts: BTreeMap<Option<&str>, (u32, Option<&TargetClass>)> = BTreeMap::new();
    for sample in samples {
        let class = sample.class.as_ref();
        let entry = counts.entry(class.map(TargetClass::as_str)).or_insert((0, class));
        entry.0 += 1;
    }
    counts.into_values().max_by_key(|(count, _)| *count).and_then(|(_, class)| class)
}
