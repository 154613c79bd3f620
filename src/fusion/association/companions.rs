//! People walk in company: who carries a receiver may be out of view or missed beside a target that is seen.
//!
//! The companion's boxes explain the fixes as well as the carrier's own would, for a receiver's bias is larger than the
//! distance between them. So the posterior probability of a chain is divided between its target and a companion that is
//! seen beside none of its pieces, by their prior probabilities. A companion is unseen more often at the border of the view.

use crate::domain::{BoundingBox, Detection};

/// Share of targets in company.
const IN_COMPANY: f64 = 0.4;
/// Probability that a target in view is not among the boxes.
const MISSED: f64 = 0.1;
/// Probability that the companion of a target at the border of the view is out of view.
const OUT_OF_VIEW: f64 = 0.5;
/// Distance of companions in the image, in heights of their boxes.
const APART_HEIGHTS: f64 = 0.7;

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

    /// Whether a companion of a box's target may be out of view.
    fn is_at_border(&self, own: &BoundingBox) -> bool {
        let centre_px = own.left_px() + 0.5 * own.width_px();
        let apart_px = APART_HEIGHTS * own.height_px();
        centre_px - self.left_px < apart_px || self.right_px - centre_px < apart_px
    }

    /// Probability that the target of a piece, rather than an unseen companion, is the one whose place its boxes show.
    pub(super) fn own_probability(&self, detections: &[Detection], piece: &[usize]) -> f64 {
        let at_border = piece.iter().filter(|at| self.is_at_border(&detections[**at].bounding_box)).count();
        let border_share = at_border as f64 / piece.len().max(1) as f64;
        1.0 / (1.0 + IN_COMPANY * (MISSED + OUT_OF_VIEW * border_share))
    }
}
