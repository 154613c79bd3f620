//! Boxes without a fix, which tell the geometry of a camera but not its place.

use std::collections::{BTreeMap, BTreeSet};

use crate::domain::{BoundingBox, Detection, Sample, TargetClass, TargetId};

/// A box of a target.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TargetBox {
    /// Index of the target: that of the training rows, or a later one for a target that has no fix at all.
    pub(crate) target: u32,
    pub(crate) bounding_box: BoundingBox,
}

/// The detections of the class that most samples have, in the order of target and time. Targets of other
/// classes have other heights.
pub(crate) fn unpaired_boxes(samples: &[Sample], unpaired: &[Detection]) -> Vec<TargetBox> {
    let class = most_frequent_class(samples);
    let mut sorted: Vec<&Detection> = unpaired.iter().filter(|own| own.class.as_ref() == class).collect();
    sorted.sort_by(|one, other| (&one.target_id, one.time).cmp(&(&other.target_id, other.time)));
    // The targets of training rows are numbered in the order of their ids.
    let paired: BTreeSet<&TargetId> = samples.iter().map(|sample| &sample.target_id).collect();
    let mut targets: BTreeMap<&TargetId, u32> = paired.into_iter().zip(0..).collect();
    let mut boxes = Vec::with_capacity(sorted.len());
    for own in sorted {
        let next = targets.len() as u32;
        let target = *targets.entry(&own.target_id).or_insert(next);
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
