//! Loads a model and tests it on a fixed set of boxes before it is stored.
//!
//! Finite parameters do not guarantee finite answers: products overflow, and bounds or offsets may have any
//! value. Every answer must be finite. At the training boxes the position must be within
//! [`FARTHEST_AT_TRAINING_BOX_M`] of the plane's origin, also without the limits of the model's scene, anywhere in the
//! image within [`FARTHEST_IN_IMAGE_M`], which is well inside the range of the local plane.

use super::artifact::Artifact;
use super::regressor::{Regression, Regressor};
use crate::domain::{BoundingBox, Error, Result};
use crate::geo::EastNorth;

/// Largest distance at a training box, m; the origin is the median of the training fixes.
const FARTHEST_AT_TRAINING_BOX_M: f64 = 1e5;
/// Largest distance at any box in the image, m; positions near the horizon are extrapolated.
const FARTHEST_IN_IMAGE_M: f64 = 1e6;
/// Valid ratios of the 95 % radius to the standard deviation; that of a normal distribution is 2.45.
const R95_SCALES: std::ops::RangeInclusive<f64> = 0.1..=100.0;
/// Columns and rows of the grid of foot points over the image.
const GRID: usize = 5;
/// Widths and heights of the boxes on the grid, px.
const SIZES_PX: [[f64; 2]; 4] = [[1.0, 1.0], [20.0, 60.0], [400.0, 100.0], [1_000.0, 2_000.0]];
/// Edges (left, top) and sides at the limits of a valid [`BoundingBox`], px.
const LIMIT_EDGES_PX: [f64; 3] = [-131_072.0, 0.0, 131_072.0];
const LIMIT_SIDES_PX: [f64; 2] = [1e-3, 131_072.0];

impl Artifact {
    /// Loads the model and checks its answers.
    ///
    /// # Errors
    /// Names `metadata.x` or `weights` where something is unknown, missing, of another shape, not
    /// finite, or too large, and the check that the model's answers do not pass.
    pub fn load(&self) -> Result<Regressor> {
        let regressor = self.restore()?;
        check(&regressor)?;
        Ok(regressor)
    }

    /// Loads a model whose answers were checked before: it is what [`Self::load`] has accepted, bit for bit.
    ///
    /// # Errors
    /// Names `metadata.x` or `weights` where something is unknown, missing, of another shape or not finite.
    pub fn restore(&self) -> Result<Regressor> {
        Regressor::build(self.parts()?)
    }
}

/// Checks a model on its training boxes, on a grid over its image, and at the limits of all boxes.
///
/// # Errors
/// Names the check that an answer does not pass, and the box.
fn check(regressor: &Regressor) -> Result<()> {
    let training_boxes = &*regressor.training_boxes();
    if training_boxes.is_empty() {
        return Err(failed("coverage.centres hold no box".to_owned()));
    }
    // There the scene must not be what limits the answers.
    let unlimited = regressor.without_scene();
    for bounding_box in training_boxes {
        check_box(&unlimited, bounding_box, FARTHEST_AT_TRAINING_BOX_M)?;
    }
    for bounding_box in image_boxes(regressor, training_boxes) {
        check_box(regressor, &bounding_box, FARTHEST_IN_IMAGE_M)?;
    }
    for bounding_box in limit_boxes() {
        check_box(regressor, &bounding_box, f64::MAX)?;
    }
    Ok(())
}

/// Boxes whose feet lie on a grid over the image, or over the training boxes where its size is unknown.
fn image_boxes(regressor: &Regressor, training_boxes: &[BoundingBox]) -> Vec<BoundingBox> {
    let feet = |axis: usize| training_boxes.iter().map(move |bounding_box| bounding_box.foot_px()[axis]);
    let range = |axis: usize, size_px: Option<u32>| match size_px {
        Some(size_px) => [0.0, f64::from(size_px)],
        None => [feet(axis).fold(f64::INFINITY, f64::min), feet(axis).fold(f64::NEG_INFINITY, f64::max)],
    };
    let size = regressor.image_size();
    let columns = range(0, size.map(|size| size.width_px()));
    let rows = range(1, size.map(|size| size.height_px()));
    let at = |[low, high]: [f64; 2], step: usize| low + (high - low) * step as f64 / (GRID - 1) as f64;
    let steps = (0..GRID).flat_map(|column| (0..GRID).map(move |row| (column, row)));
    steps
        .flat_map(|(column, row)| {
            let (x, y) = (at(columns, column), at(rows, row));
            SIZES_PX.map(|[width, height]| BoundingBox::new(x - 0.5 * width, y - height, width, height))
        })
        .filter_map(Result::ok)
        .collect()
}

fn limit_boxes() -> impl Iterator<Item = BoundingBox> {
    let edges = LIMIT_EDGES_PX.into_iter().flat_map(|left| LIMIT_EDGES_PX.map(|top| (left, top)));
    let boxes = edges.flat_map(|(left, top)| {
        let sides = LIMIT_SIDES_PX.into_iter().flat_map(|width| LIMIT_SIDES_PX.map(|height| (width, height)));
        sides.map(move |(width, height)| BoundingBox::new(left, top, width, height))
    });
    boxes.filter_map(Result::ok)
}

/// Every box is also tested with fixes where the recipe uses them: `paper` has a network for either.
fn check_box(regressor: &Regressor, bounding_box: &BoundingBox, farthest_m: f64) -> Result<()> {
    let fixes = [EastNorth::default(), EastNorth { east_m: 1_000.0, north_m: -1_000.0 }];
    let fixes = fixes.into_iter().filter(|_| regressor.encoder.uses_fix());
    for fix in std::iter::once(None).chain(fixes.map(Some)) {
        let answer = regressor.regress(bounding_box, fix);
        if let Some(fault) = fault_of(regressor, &answer, farthest_m) {
            let [left, top, width, height] = bounding_box.sides_px();
            return Err(failed(format!(
                "{fault} for the box left {left} px, top {top} px, width {width} px, height {height} px"
            )));
        }
    }
    Ok(())
}

/// The first check that an answer does not pass.
fn fault_of(regressor: &Regressor, answer: &Regression, farthest_m: f64) -> Option<String> {
    let EastNorth { east_m, north_m } = answer.regressed;
    if !(east_m.is_finite() && north_m.is_finite()) {
        return Some("the position is not finite".to_owned());
    }
    let distance_m = answer.regressed.distance_m(EastNorth::default());
    if distance_m > farthest_m {
        return Some(format!(
            "the position lies {distance_m:.3e} m from the origin, beyond {farthest_m:e} m"
        ));
    }
    let position = regressor.plane().to_position(answer.regressed);
    if !(position.longitude_deg().is_finite() && position.latitude_deg().is_finite()) {
        return Some("the position is not on the earth".to_owned());
    }
    if !answer.reconstruction_error.is_finite() {
        return Some("the reconstruction error is not finite".to_owned());
    }
    if !(answer.e_regression_m2 > 0.0 && answer.variance_m2().is_finite()) {
        return Some("the error variance is not a finite number above 0".to_owned());
    }
    if !R95_SCALES.contains(&answer.r95_scale) {
        let (least, most) = (R95_SCALES.start(), R95_SCALES.end());
        return Some(format!("metadata.parameters.r95_scale is not from {least} to {most}"));
    }
    None
}

fn failed(reason: String) -> Error {
    Error::invalid("weights", format!("make no usable model: {reason}"))
}
