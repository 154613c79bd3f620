//! Points of the ground whose place in the image and on the earth is known: evidence beside the fixes, without a
//! receiver's error.
//!
//! A point has no box. It gets the sides that the boxes at its place have on average, and enters the Gram matrix of a fit
//! as a row that is white and never left out.

use nalgebra::{Matrix3, Vector3};

use super::kernel::InputScales;
use super::map_rows::{Evidence, MapRows};
use super::noise::{Epoch, ReceiverNoise, ReceiverWhitener};
use super::projective_mean::{Box4, ProjectiveMean};

/// Name of the parameter that says how many known points a model was trained with.
pub const KNOWN_POINTS: &str = "known_points";
/// Standard deviation per axis of a pointer on a picture, px.
pub(crate) const POINTER_SIGMA_PX: f64 = 2.0;
/// Standard deviations of the fixes by which their map may be off where a point is.
const START_SIGMAS: f64 = 3.0;
/// Variance of a point beyond the horizon, m2: it has no part in the next step.
const BEYOND_M2: f64 = 1e12;
/// Ridge of the sides' regression, in rows.
const RIDGE: f64 = 1.0;

/// A point of the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct KnownFoot {
    /// Where it is in the image.
    pub(crate) image_px: [f64; 2],
    /// Where it is in the plane, m.
    pub(crate) position_m: [f64; 2],
    /// Error variance per axis of that position, m2.
    pub(crate) variance_m2: f64,
}

/// The known points of a fit in the form of its rows.
#[derive(Debug, Clone, Default)]
pub(crate) struct KnownRows {
    pub(crate) rows: MapRows,
    pub(crate) inputs: Vec<[f64; 4]>,
    variances_m2: Vec<f64>,
}

impl KnownRows {
    /// Points with the sides that boxes have where they are.
    pub(crate) fn new(points: &[KnownFoot], fixed: &MapRows) -> Self {
        let sides = [2, 3].map(|side| SideByFoot::fit(&fixed.boxes, side));
        let box_at = |point: &KnownFoot| {
            let [u, v] = point.image_px;
            let [width, height] = sides.each_ref().map(|side| side.at(point.image_px));
            [u, v, width, height]
        };
        let boxes: Vec<Box4> = points.iter().map(box_at).collect();
        Self {
            inputs: Vec::new(),
            rows: MapRows {
                epochs: (0..).zip(points).map(|(sequence, _)| Epoch { time_s: 0.0, sequence }).collect(),
                labels_m: points.iter().map(|point| point.position_m).collect(),
                boxes,
            },
            variances_m2: points.iter().map(|point| point.variance_m2).collect(),
        }
    }

    /// The same as the kernel takes them.
    pub(crate) fn with_inputs(self, scales: &InputScales) -> Self {
        Self { inputs: self.rows.boxes.iter().map(|sides| scales.input(sides)).collect(), ..self }
    }

    /// Rows with the points beside them, repeated until they are half as many: a robust start counts rows, and few walks tell
    /// little of the places where the points are.
    pub(crate) fn beside(&self, fixed: &MapRows) -> MapRows {
        let mut all = fixed.clone();
        let copies =
            (fixed.boxes.len() / 2).checked_div(self.rows.boxes.len()).map_or(0, |copies| copies.max(1));
        for _ in 0..copies {
            all.epochs.extend(&self.rows.epochs);
            all.boxes.extend(&self.rows.boxes);
            all.labels_m.extend(&self.rows.labels_m);
        }
        all
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.variances_m2.is_empty()
    }

    /// Error variance per axis of each point's position, m2.
    pub(crate) fn variances_m2(&self) -> impl Iterator<Item = f64> {
        self.variances_m2.iter().copied()
    }

    /// The variance of each point about a mean: its own, and that of the pointer, m2.
    pub(crate) fn noise_m2(&self, mean: &ProjectiveMean) -> Vec<f64> {
        let of_pointer = |sides: &Box4| {
            let [east, north] = mean.jacobian(&mean.evaluate(sides));
            let square = east[0].powi(2) + east[1].powi(2) + north[0].powi(2) + north[1].powi(2);
            0.5 * POINTER_SIGMA_PX.powi(2) * square
        };
        self.rows.boxes.iter().zip(&self.variances_m2).map(|(sides, own)| own + of_pointer(sides)).collect()
    }

    /// Extra variance of points that are far from where the fixes alone have them, m2: four points determine a map, and would
    /// bend it after a wrong one before anything contradicts that. `scatter_m2` is the variance of the fixes about that map.
    pub(crate) fn first_inflation_m2(&self, mean: &ProjectiveMean, scatter_m2: f64) -> Vec<f64> {
        let allowed_m2: Vec<f64> =
            self.noise_m2(mean).iter().map(|own| own + START_SIGMAS * START_SIGMAS * scatter_m2).collect();
        self.inflation_m2(mean, &self.rows.misses_m(mean), &allowed_m2)
    }

    /// Extra variance of points that residuals contradict under a variance of each, and of those that a mean has beyond its
    /// horizon, m2.
    pub(crate) fn inflation_m2(
        &self,
        mean: &ProjectiveMean,
        residuals_m: &[[f64; 2]],
        variances_m2: &[f64],
    ) -> Vec<f64> {
        let whole_m2 = self.whitener(variances_m2).inflation_m2(residuals_m);
        let of_point = |((sides, whole_m2), own_m2): ((&Box4, &f64), &f64)| {
            if mean.evaluate(sides).is_beyond_horizon() { BEYOND_M2 } else { (whole_m2 - own_m2).max(0.0) }
        };
        self.rows.boxes.iter().zip(&whole_m2).zip(variances_m2).map(of_point).collect()
    }

    /// The whitener of the points, whose errors are independent, with white variances per point, m2.
    pub(crate) fn whitener(&self, variances_m2: &[f64]) -> ReceiverWhitener {
        ReceiverWhitener::new(&self.rows.epochs, &ReceiverNoise::white(0.0), variances_m2)
    }

    pub(crate) fn evidence(&self) -> Evidence<'_> {
        Evidence { rows: &self.rows, inputs: &self.inputs }
    }
}

/// A side of the boxes as a linear function of their foot.
struct SideByFoot {
    centre_px: [f64; 2],
    /// At the centre, px; then per pixel of foot u and v.
    coefficients: Vector3<f64>,
    range_px: [f64; 2],
}

impl SideByFoot {
    fn fit(boxes: &[Box4], side: usize) -> Self {
        let count = boxes.len() as f64;
        let centre_px = [0, 1].map(|axis| boxes.iter().map(|sides| sides[axis]).sum::<f64>() / count);
        let terms = |sides: &Box4| Vector3::new(1.0, sides[0] - centre_px[0], sides[1] - centre_px[1]);
        let mut normal = Matrix3::from_diagonal_element(RIDGE);
        let mut right = Vector3::zeros();
        let (mut least_px, mut most_px) = (f64::INFINITY, 1.0_f64);
        for sides in boxes {
            let terms = terms(sides);
            normal += terms * terms.transpose();
            right += terms * sides[side];
            least_px = least_px.min(sides[side]);
            most_px = most_px.max(sides[side]);
        }
        let coefficients = normal.cholesky().map_or_else(Vector3::zeros, |factor| factor.solve(&right));
        Self { centre_px, coefficients, range_px: [least_px.min(most_px), most_px] }
    }

    /// Within the range of the boxes, px.
    fn at(&self, [u, v]: [f64; 2]) -> f64 {
        let terms = Vector3::new(1.0, u - self.centre_px[0], v - self.centre_px[1]);
        self.coefficients.dot(&terms).clamp(self.range_px[0], self.range_px[1])
    }
}
