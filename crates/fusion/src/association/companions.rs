//! People walk in company: who carries a receiver may be out of view or missed beside a target that is seen.
//!
//! The companion's boxes explain the fixes as well as the carrier's own would, for a receiver's bias is larger than the
//! distance between them. So the posterior probability of a piece is divided between its target and a
//! companion that is not seen, by their prior probabilities. A companion is unseen more often at the border of the view;
//! but while the target is inside, a companion is inside as well, and has boxes of its own.

use crate::domain::{BoundingBox, Detection};

/// Share of targets in company.
const IN_COMPANY: f64 = 0.4;
/// Probability that a target in view is not among the boxes.
pub(super) const MISSED: f64 = 0.1;
/// Probability that the companion of a target at the border of the view is out of view.
const OUT_OF_VIEW: f64 = 0.5;
/// A companion is still out of view after the target has been inside for this time with probability 1/e, s.
pub(super) const ENTERING_S: f64 = 2.0;
/// Distance of companions in the image, in heights of their boxes.
const APART_HEIGHTS: f64 = 0.7;

/// Probability that the target of a track of several cameras, rather than a companion that no detector finds, is the one
/// whose place it shows.
pub(super) fn missed_companion_factor() -> f64 {
    1.0 / (1.0 + IN_COMPANY * MISSED)
}

/// The view as the boxes of a recording show it.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    left_px: f64,
    right_px: f64,
}

impl View {
    pub(super) fn of(detections: &[Detection]) -> Self {
        let boxes = || detections.iter().map(|own| &own.bounding_box);
        Self {
            left_px: boxes().map(|own| own.left_px()).fold(f64::INFINITY, f64::min),
            right_px: boxes().map(|own| own.left_px() + own.width_px()).fold(f64::NEG_INFINITY, f64::max),
        }
    }

    /// True if a companion of a box's target may be out of view.
    fn is_at_border(&self, own: &BoundingBox) -> bool {
        let centre_px = own.left_px() + 0.5 * own.width_px();
        let apart_px = APART_HEIGHTS * own.height_px();
        centre_px - self.left_px < apart_px || self.right_px - centre_px < apart_px
    }

    /// Probability that the target of a piece, rather than an unseen companion, is the one whose place its boxes show. The
    /// piece is in order of time.
    pub(super) fn own_probability(&self, detections: &[Detection], piece: &[usize]) -> f64 {
        let steps = piece.windows(2).map(|step| [0, 1].map(|at| &detections[step[at]]));
        let inside_s: f64 = steps
            .filter(|step| step.iter().all(|own| !self.is_at_border(&own.bounding_box)))
            .map(|[from, to]| to.time.duration_since(from.time).as_secs_f64())
            .sum();
        let unseen = MISSED + OUT_OF_VIEW * (-inside_s / ENTERING_S).exp();
        1.0 / (1.0 + IN_COMPANY * unseen)
    }
}
