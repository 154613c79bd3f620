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

#[cfg(test)]
mod tests {
    use super::unpaired_boxes;
    use crate::domain::{BoundingBox, Detection, Fix, Sample, TargetClass, TargetId};
    use crate::geo::Position;

    #[test]
    fn only_boxes_of_the_usual_class_are_taken_in_the_order_of_target_and_time() {
        let class = |name: &str| Some(TargetClass::new(name).expect("a class"));
        let bounding_box = BoundingBox::new(1.0, 2.0, 3.0, 4.0).expect("a box");
        let sample = |name: &str| Sample {
            time: jiff::Timestamp::UNIX_EPOCH,
            target_id: TargetId::new("walker").expect("an id"),
            bounding_box,
            fix: Fix { position: Position::new(11.0, 48.0).expect("a position"), sigma_m: None },
            class: class(name),
            score: None,
            truth: None,
        };
        let detection = |target: &str, name: &str, left_px: f64| Detection {
            time: jiff::Timestamp::UNIX_EPOCH,
            target_id: TargetId::new(target).expect("an id"),
            bounding_box: BoundingBox::new(left_px, 2.0, 3.0, 4.0).expect("a box"),
            class: class(name),
            score: None,
        };
        let samples = [sample("person"), sample("car"), sample("person")];
        let unpaired =
            [detection("b", "person", 5.0), detection("a", "car", 6.0), detection("a", "person", 7.0)];
        let boxes = unpaired_boxes(&samples, &unpaired);
        let found: Vec<(u32, f64)> =
            boxes.iter().map(|own| (own.target, own.bounding_box.sides_px()[0])).collect();
        // The walker of the samples is target 0.
        assert_eq!(found, [(1, 7.0), (2, 5.0)]);
    }
}
