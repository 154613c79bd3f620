//! The scene in view as training shows it: the positions of its targets, and how long one stands without a change
//! of its box.

use crate::artifact::ModelParts;
use crate::domain::Sample;
use crate::regressor::Regressor;
use crate::samples::sequences::sequences;
use crate::uncertainty::scene::Scene;

/// A box is frozen when it has been the same to the pixel for that many times as long as any of training, and
/// [`LEAST_FROZEN_S`] more: some detectors repeat a box until they have the next one.
const FROZEN_FACTOR: f64 = 2.0;
const LEAST_FROZEN_S: f64 = 2.0;

/// Adds what the samples show to the parts of a model that was fitted to them.
pub(super) fn put_scene(samples: &[Sample], regressor: &Regressor, parts: &mut ModelParts) {
    let positions: Vec<_> =
        samples.iter().map(|sample| regressor.regress(&sample.bounding_box, None).regressed).collect();
    if let Some(scene) = Scene::of(&positions) {
        scene.put(parts);
    }
    parts.set("frozen_after_s", FROZEN_FACTOR * longest_same_box_s(samples) + LEAST_FROZEN_S);
}

/// Longest time for which a target's box was the same to the pixel, s.
fn longest_same_box_s(samples: &[Sample]) -> f64 {
    let mut longest_s: f64 = 0.0;
    for sequence in sequences(samples) {
        for same in sequence.chunk_by(|one, next| one.bounding_box == next.bounding_box) {
            if let [first, .., last] = same {
                longest_s = longest_s.max(last.time.duration_since(first.time).as_secs_f64());
            }
        }
    }
    longest_s
}
