//! The map from a box to the ground plane: a ratio of linear functions of the box's features.
//!
//! With the standardised features `u` (foot x), `v` (foot y), `w` (width), `h` (height) and
//! `t = (1, u, v, w, h)`:
//!
//! ```text
//! east  = centre.east  + unit_m * (a . t / q + extra_east)
//! north = centre.north + unit_m * (b . t / q + extra_north)
//! q     = 1 + c . (u, v, w, h)
//! ```
//!
//! With the foot point alone (all coefficients of `w` and `h` zero) this is the homography of the ground
//! plane (Hartley and Zisserman, 2nd ed., 2.3), with eight parameters. Width and height allow a ground
//! point anywhere in the box and a distance that follows from the target's size.

use super::features::{FEATURE_COUNT, features_of};
use crate::domain::BoundingBox;
use crate::geo::EastNorth;
use crate::samples::rows::TrainingRow;
use crate::statistics::std_dev;

/// Terms of a numerator: 1, foot x, foot y, width, height.
pub(crate) const TERMS: usize = 1 + FEATURE_COUNT;
/// Coefficients of both numerators and of the denominator, whose constant term is 1.
pub(crate) const COEFFICIENTS: usize = 2 * TERMS + FEATURE_COUNT;
/// Lower bound of the denominator, so that the map is finite near the horizon.
pub(crate) const LEAST_DENOMINATOR: f64 = 0.02;
/// Bound of the standardised width and height, so that the position of an outlying box is bounded.
pub(crate) const LARGEST_SIZE: f64 = 3.5;

/// The map with its scaling.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// Offset and unit of each feature, px.
    pub(crate) scales: [[f64; 2]; FEATURE_COUNT],
    /// Mean of the training positions.
    pub(crate) centre: EastNorth,
    /// Unit of positions about the centre, m.
    pub(crate) unit_m: f64,
    /// `a` (5), `b` (5), `c` (4).
    pub(crate) coefficients: [f64; COEFFICIENTS],
}

/// Values of a projection at one box.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Projected {
    /// `t`.
    pub(crate) terms: [f64; TERMS],
    /// East and north in units about the centre, without the extra columns.
    pub(crate) position: [f64; 2],
    /// `q`.
    pub(crate) denominator: f64,
}

impl Projection {
    /// The scaling of some rows, with a map of every box to the centre of their positions.
    pub(crate) fn scaled_to(rows: &[TrainingRow]) -> Self {
        let count = rows.len() as f64;
        let features: Vec<[f64; FEATURE_COUNT]> =
            rows.iter().map(|row| features_of(&row.bounding_box)).collect();
        let mut scales: [[f64; 2]; FEATURE_COUNT] = std::array::from_fn(|at| {
            let values = features.iter().map(|features| features[at]);
            [values.clone().sum::<f64>() / count, std_dev(values).max(2.0)]
        });
        // One unit for both coordinates of the foot point keeps the image's proportions.
        let foot_px = (0.5 * (scales[0][1].powi(2) + scales[1][1].powi(2))).sqrt();
        (scales[0][1], scales[1][1]) = (foot_px, foot_px);
        let centre = EastNorth {
            east_m: rows.iter().map(|row| row.label.east_m).sum::<f64>() / count,
            north_m: rows.iter().map(|row| row.label.north_m).sum::<f64>() / count,
        };
        let variance_m2 = rows.iter().map(|row| row.label.error_per_axis_m2(centre)).sum::<f64>() / count;
        Self { scales, centre, unit_m: variance_m2.sqrt().max(0.1), coefficients: [0.0; COEFFICIENTS] }
    }

    #[inline]
    fn terms(&self, bounding_box: &BoundingBox) -> [f64; TERMS] {
        let features = features_of(bounding_box);
        let scaled = |at: usize| (features[at] - self.scales[at][0]) / self.scales[at][1];
        let bounded = |at: usize| scaled(at).clamp(-LARGEST_SIZE, LARGEST_SIZE);
        [1.0, scaled(0), scaled(1), bounded(2), bounded(3)]
    }

    /// Terms, position and denominator at a box.
    #[inline]
    pub(crate) fn at(&self, bounding_box: &BoundingBox) -> Projected {
        let terms = self.terms(bounding_box);
        let c = &self.coefficients;
        let dot = |from: usize| (0..TERMS).map(|at| c[from + at] * terms[at]).sum::<f64>();
        let denominator = (0..FEATURE_COUNT)
            .fold(1.0, |sum, at| sum + c[2 * TERMS + at] * terms[1 + at])
            .max(LEAST_DENOMINATOR);
        Projected { terms, position: [dot(0) / denominator, dot(TERMS) / denominator], denominator }
    }

    /// Derivatives of one axis of the position (m) with respect to its own numerator's coefficients, then
    /// to those of the denominator.
    #[inline]
    pub(crate) fn derivatives_m(&self, projected: &Projected, axis: usize) -> [f64; TERMS + FEATURE_COUNT] {
        let Projected { terms, position, denominator } = projected;
        std::array::from_fn(|at| match at.checked_sub(TERMS) {
            None => self.unit_m * terms[at] / denominator,
            Some(feature) => -self.unit_m * position[axis] * terms[1 + feature] / denominator,
        })
    }

    /// Indexes of the coefficients of [`Self::derivatives_m`].
    pub(crate) fn coefficient_indexes(axis: usize) -> [usize; TERMS + FEATURE_COUNT] {
        std::array::from_fn(|at| if at < TERMS { TERMS * axis + at } else { TERMS + at })
    }

    /// Position of a box's target in the plane; `extra` is added in units of position.
    #[inline]
    #[must_use]
    pub fn project(&self, bounding_box: &BoundingBox, extra: [f64; 2]) -> EastNorth {
        let [east, north] = self.at(bounding_box).position;
        self.in_metres([east + extra[0], north + extra[1]])
    }

    /// The same, limited to the least and greatest value of each axis, in units of position.
    #[inline]
    pub(crate) fn project_within(
        &self,
        bounding_box: &BoundingBox,
        extra: [f64; 2],
        bounds: &[[f64; 2]; 2],
    ) -> EastNorth {
        let [east, north] = self.at(bounding_box).position;
        let limited = |axis: usize, value: f64| (value + extra[axis]).clamp(bounds[axis][0], bounds[axis][1]);
        self.in_metres([limited(0, east), limited(1, north)])
    }

    #[inline]
    fn in_metres(&self, [east, north]: [f64; 2]) -> EastNorth {
        EastNorth {
            east_m: self.centre.east_m + self.unit_m * east,
            north_m: self.centre.north_m + self.unit_m * north,
        }
    }

    /// True if the foot point of a box lies below the horizon, on the image of the ground.
    #[must_use]
    pub fn is_below_horizon(&self, bounding_box: &BoundingBox) -> bool {
        self.at(bounding_box).denominator > LEAST_DENOMINATOR
    }

    /// A position in units about the centre.
    #[inline]
    pub(crate) fn in_units(&self, position: EastNorth) -> [f64; 2] {
        [
            (position.east_m - self.centre.east_m) / self.unit_m,
            (position.north_m - self.centre.north_m) / self.unit_m,
        ]
    }

    /// The standardised features of a box, for a network.
    #[inline]
    pub(crate) fn standardised(&self, bounding_box: &BoundingBox) -> [f32; FEATURE_COUNT] {
        let features = features_of(bounding_box);
        std::array::from_fn(|at| ((features[at] - self.scales[at][0]) / self.scales[at][1]) as f32)
    }
}
