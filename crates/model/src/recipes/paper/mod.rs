//! The recipe `paper`: Liang et al. 2022 as published, for comparison with its figures.
//!
//! Inputs are raw pixels and standardised degrees `(deg - offset) * 1e4`. Two auto-encoders, 6-h-2-h-6
//! with the fix and 4-h-2-h-4 without, are trained with L = 1 eX + 2000 eZ and Adam at 0.005; Es follows
//! (4) from the last epoch. A network that has the fix among its inputs learns to reproduce it; none of
//! the remedies in `docs/explanation/method.md` applies here.

mod onnx;

use std::sync::Arc;

use super::{Candidate, Definition, ErrorSource, Estimator, FitContext};
use crate::artifact::ModelParts;
use crate::domain::{BoundingBox, FeatureScale, Recipe, Result};
use crate::encoder::features::{Encoded, features_of};
use crate::encoder::stored_network::{put_network, take_network};
use crate::encoder::{Encoder, ErrorContext, Estimate, FittedEncoder};
use crate::geo::{EastNorth, LocalPlane, METRES_PER_DEGREE, Position};
use crate::network::{Activation, LossSums, LossWeights, Net, NetShape, Schedule, TrainingSet};
use crate::onnx::answer::{Answer, GraphContext};
use crate::progress::{FitError, Phase};
use crate::recipes::gaussian_process::RecentBoxes;
use crate::samples::rows::TrainingRows;
use crate::statistics::R95_PER_SIGMA;
use crate::uncertainty::error_model::BoxError;

/// The recipe.
pub(super) static DEFINITION: Definition = Definition {
    candidates: &[Candidate { name: "paper", estimator: &Paper, is_smoothed: false }],
    load: |parts| Ok(Arc::new(PaperEncoder::build(parts)?)),
    error_source: ErrorSource::Formula,
};

/// Units per degree.
const UNITS_PER_DEGREE: f64 = 1e4;
/// Hidden units; not specified in the paper.
const HIDDEN: usize = 32;
const BATCH: usize = 128;
const WEIGHTS: LossWeights = LossWeights { reconstruction: 1.0, regression: 2000.0 };
const INPUTS: [&str; 6] = ["left_px", "top_px", "width_px", "height_px", "longitude_deg", "latitude_deg"];
/// Number of the inputs that come from the box.
const BOX_INPUTS: usize = 4;

/// The fit of both networks.
#[derive(Debug)]
struct Paper;

impl Estimator for Paper {
    /// Not specified in the paper.
    fn epochs(&self) -> u32 {
        100
    }

    fn networks(&self, _is_final: bool) -> u32 {
        2
    }

    fn fit(
        &self,
        rows: &TrainingRows,
        context: &FitContext<'_>,
        epochs: u32,
        phase: &mut Phase<'_, '_>,
    ) -> Result<FittedEncoder, FitError> {
        let offset = lowest_corner(rows);
        let units: [Vec<f32>; 2] = std::array::from_fn(|axis| {
            rows.rows.iter().map(|row| standardised(offset, row.position)[axis]).collect()
        });
        let mut parts =
            ModelParts::new(Recipe::Paper, LocalPlane::new(offset), scales_about(offset), context.e_gnss_m2);
        parts.set("r95_scale", R95_PER_SIGMA);
        let schedule = Schedule { epochs, batch: BATCH, learning_rate: 0.005, last_rate_share: 1.0 };
        for (prefix, inputs) in [("joint.", INPUTS.len()), ("denied.", BOX_INPUTS)] {
            let shape = shape(inputs);
            let set = Arc::new(training_set(rows, &units, inputs));
            let (parameters, sums) = phase.train(prefix, &shape, set, WEIGHTS, schedule)?;
            put_network(&mut parts.tensors, prefix, &shape, &parameters);
            if inputs == BOX_INPUTS {
                parts.set("denied_error_scale", error_scale(&sums));
            } else {
                parts.error_scale = error_scale(&sums);
            }
        }
        Ok(FittedEncoder { parts, covariance: None })
    }
}

fn scales_about(offset: Position) -> Vec<FeatureScale> {
    let mut scales: Vec<FeatureScale> = INPUTS
        .iter()
        .map(|name| FeatureScale { feature: (*name).to_owned(), offset: 0.0, factor: 1.0 })
        .collect();
    for (scale, degrees) in
        scales[BOX_INPUTS..].iter_mut().zip([offset.longitude_deg(), offset.latitude_deg()])
    {
        (scale.offset, scale.factor) = (degrees, UNITS_PER_DEGREE);
    }
    scales
}

/// Es of (4), units2 per unit of eX.
fn error_scale(sums: &LossSums) -> f64 {
    (sums.ratio / sums.samples).clamp(1e-12, 1e12)
}

fn shape(inputs: usize) -> NetShape {
    NetShape::auto_encoder(inputs, &[HIDDEN], Activation::Relu)
}

fn training_set(rows: &TrainingRows, units: &[Vec<f32>; 2], inputs: usize) -> TrainingSet {
    let mut columns: Vec<Vec<f32>> = (0..BOX_INPUTS)
        .map(|side| rows.rows.iter().map(|row| row.bounding_box.sides_px()[side] as f32).collect())
        .collect();
    if inputs > BOX_INPUTS {
        columns.extend(units.iter().cloned());
    }
    TrainingSet {
        reconstruction_targets: columns.clone(),
        inputs: columns,
        position_targets: units.clone(),
        weights: vec![1.0; rows.rows.len()],
    }
}

/// The least longitude and latitude of the training fixes, which are the paper's offsets.
fn lowest_corner(rows: &TrainingRows) -> Position {
    let origin = rows.plane.origin();
    let (mut east_deg, mut north_deg) = (f64::INFINITY, f64::INFINITY);
    for row in &rows.rows {
        east_deg = east_deg.min(wrapped(row.position.longitude_deg() - origin.longitude_deg()));
        north_deg = north_deg.min(row.position.latitude_deg());
    }
    Position::new(wrapped(origin.longitude_deg() + east_deg), north_deg).unwrap_or(origin)
}

/// A difference of longitudes, degrees, wrapped to -180..180.
fn wrapped(degrees: f64) -> f64 {
    (degrees + 180.0).rem_euclid(360.0) - 180.0
}

fn standardised(offset: Position, position: Position) -> [f32; 2] {
    [
        (wrapped(position.longitude_deg() - offset.longitude_deg()) * UNITS_PER_DEGREE) as f32,
        ((position.latitude_deg() - offset.latitude_deg()) * UNITS_PER_DEGREE) as f32,
    ]
}

/// Both networks for inference.
#[derive(Debug)]
struct PaperEncoder {
    joint: Net,
    denied: Net,
    /// Es of (4) of the joint and of the denied network, units2 per unit of eX.
    error_scales: [f64; 2],
    /// m2 per unit2, mean of both axes.
    unit_m2: f64,
}

impl PaperEncoder {
    fn build(parts: &mut ModelParts) -> Result<Self> {
        parts.scales(INPUTS)?;
        let plane = &parts.plane;
        let corner = Position::new(
            wrapped(plane.origin().longitude_deg() + 1.0 / UNITS_PER_DEGREE),
            (plane.origin().latitude_deg() + 1.0 / UNITS_PER_DEGREE).min(90.0),
        );
        let unit = corner.map_or(EastNorth::default(), |corner| plane.to_plane(corner));
        Ok(Self {
            unit_m2: (0.5 * (unit.east_m * unit.east_m + unit.north_m * unit.north_m)).max(1e-6),
            error_scales: [parts.error_scale, parts.positive_parameter("denied_error_scale")?],
            joint: take_network(&mut parts.tensors, "joint.", shape(INPUTS.len()))?,
            denied: take_network(&mut parts.tensors, "denied.", shape(BOX_INPUTS))?,
        })
    }

    /// Position with its error by (4); the joint network if there is a fix, else the denied one.
    fn answer(
        &self,
        plane: &LocalPlane,
        bounding_box: &BoundingBox,
        fix: Option<EastNorth>,
    ) -> (EastNorth, BoxError) {
        let [left, top, width, height] = bounding_box.sides_px().map(|side| side as f32);
        let (east, north, count, network, error_scale) = match fix {
            Some(fix) => {
                let [east, north] = standardised(plane.origin(), plane.to_position(fix));
                (east, north, INPUTS.len(), &self.joint, self.error_scales[0])
            }
            None => (0.0, 0.0, BOX_INPUTS, &self.denied, self.error_scales[1]),
        };
        let inputs = &[left, top, width, height, east, north][..count];
        let bottleneck = network.encode(inputs);
        let reconstruction = network.decode(bottleneck);
        let squares = inputs.iter().zip(&reconstruction).map(|(one, other)| f64::from(one - other).powi(2));
        let reconstruction_error = squares.sum::<f64>() / count as f64;
        let variance_m2 = error_scale * reconstruction_error * self.unit_m2;
        (in_plane(plane, bottleneck), BoxError { reconstruction_error, variance_m2 })
    }
}

impl Encoder for PaperEncoder {
    fn encode(&self, plane: &LocalPlane, bounding_box: &BoundingBox) -> Encoded {
        Encoded {
            position: self.answer(plane, bounding_box, None).0,
            reconstruction_px: features_of(bounding_box),
        }
    }

    fn estimate(
        &self,
        model: &ErrorContext<'_>,
        bounding_box: &BoundingBox,
        fix: Option<EastNorth>,
        _recent: Option<&mut RecentBoxes>,
    ) -> Estimate {
        let (position, error) = self.answer(model.plane, bounding_box, fix);
        model.isotropic(position, error, model.error_model.extrapolation_ratio(bounding_box))
    }

    fn express<'g>(&self, context: &GraphContext<'_, 'g>) -> Answer<'g> {
        onnx::express(self, context)
    }

    fn uses_fix(&self) -> bool {
        true
    }
}

/// Converts units into metres in the plane about the offset.
fn in_plane(plane: &LocalPlane, units: [f32; 2]) -> EastNorth {
    let [east_deg, north_deg] = units.map(|unit| f64::from(unit) / UNITS_PER_DEGREE);
    let origin = plane.origin();
    let longitude_deg = origin.longitude_deg() + east_deg;
    let in_hemisphere = east_deg.abs() < 90.0;
    match Position::new(wrapped(longitude_deg), origin.latitude_deg() + north_deg) {
        Ok(position) if in_hemisphere => plane.to_plane(position),
        // Outside the range of coordinates.
        _ => EastNorth { east_m: east_deg * METRES_PER_DEGREE, north_m: north_deg * METRES_PER_DEGREE },
    }
}
