//! The columns of the input: boxes.

use super::expression::{Expr, Graph};
use crate::artifact::Scale;
use crate::domain::ImageSize;

/// Name of the input.
pub(crate) const BOXES: &str = "boxes";

/// Left, top, width and height of each box, px.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Boxes<'g> {
    /// All four, side by side.
    pub(crate) sides: Expr<'g>,
    pub(crate) left: Expr<'g>,
    pub(crate) top: Expr<'g>,
    pub(crate) width: Expr<'g>,
    pub(crate) height: Expr<'g>,
}

impl<'g> Boxes<'g> {
    /// The input of a graph.
    pub(crate) fn of(graph: &'g Graph) -> Self {
        let sides = graph.input(BOXES);
        let [left, top, width, height] = sides.split();
        Self { sides, left, top, width, height }
    }

    /// `features_of`: foot x, foot y, width and height, px.
    pub(crate) fn features(self) -> [Expr<'g>; 4] {
        [self.left + self.width * 0.5, self.top + self.height, self.width, self.height]
    }

    /// Left, top, right and bottom, px.
    pub(crate) fn edges(self) -> [Expr<'g>; 4] {
        [self.left, self.top, self.left + self.width, self.top + self.height]
    }

    /// Distance by which the image's border truncates a box, px: above 0 where `BoundingBox::touches_border` is true.
    pub(crate) fn beyond_border_px(self, image_size: Option<ImageSize>) -> Expr<'g> {
        let near_px = 1.0;
        let [left, top, right, bottom] = self.edges();
        let beyond = (near_px - left).max(near_px - top);
        image_size.map_or(beyond, |size| {
            let right_px = right - (f64::from(size.width_px()) - near_px);
            let bottom_px = bottom - (f64::from(size.height_px()) - near_px);
            beyond.max(right_px).max(bottom_px)
        })
    }
}

/// Features with the scaling of a network's inputs, side by side.
pub(crate) fn scaled<'g>(features: [Expr<'g>; 4], scales: &[Scale; 4]) -> Expr<'g> {
    let graph = features[0].graph();
    let offsets = graph.row(&scales.map(|scale| scale.offset));
    (graph.columns(&features) - offsets) * graph.row(&scales.map(|scale| scale.factor))
}

/// eX of (2) in squared box heights, from the features and their reconstruction, px.
pub(crate) fn reconstruction_error<'g>(features: [Expr<'g>; 4], reconstruction_px: Expr<'g>) -> Expr<'g> {
    let misses = features[0].graph().columns(&features) - reconstruction_px;
    misses.square().sum() / (features[3].square() * 4.0)
}
