//! The recipe `projective`: an auto-encoder whose encoder is a [`Projection`] and whose decoder is the
//! inverse camera.
//!
//! The encoder maps a box to the ground by a ratio of linear functions. Where the held-out blocks favour
//! it, the hidden units of a small network, trained by the hybrid loss on the residuals of that map, are
//! added as columns. The decoder maps the position back to a box by a second ratio of linear functions.
//! The fix is not among the inputs.

mod onnx;

use std::sync::Arc;

use super::{Candidate, Definition, ErrorSource, Estimator, FitContext};
use crate::artifact::ModelParts;
use crate::artifact::tensors::Tensors;
use crate::domain::{BoundingBox, Error, FeatureScale, Recipe, Result};
use crate::encoder::auto_encoder::batch_size;
use crate::encoder::features::{Encoded, FEATURE_COUNT, FEATURES};
use crate::encoder::geometry::{GeometricCovariance, RESIDUAL_UNITS};
use crate::encoder::initial_projection::subset_rng;
use crate::encoder::inverse_camera::InverseCamera;
use crate::encoder::projection::{COEFFICIENTS, Projection};
use crate::encoder::projection_fit::{self, Form, ProjectionFit};
use crate::encoder::{Encoder, FittedEncoder};
use crate::geo::{EastNorth, LocalPlane};
use crate::network::{Activation, LossWeights, Net, NetShape, Schedule, TrainingSet};
use crate::onnx::answer::{Answer, GraphContext};
use crate::progress::{FitError, Phase};
use crate::samples::rows::{TrainingRow, TrainingRows};

/// Prior standard deviation of the weight of a residual column, in units of position.
const RESIDUAL_SIGMA: f64 = 0.1;
/// Bound of the residual network's targets, in standard deviations of the residuals.
const LARGEST_RESIDUAL: f64 = 4.0;
const WEIGHTS: LossWeights = LossWeights { reconstruction: 0.2, regression: 1.0 };
/// Share of the labels on either side that the bounds of the positions ignore.
const IGNORED_SHARE: usize = 100;

/// The recipe.
pub(super) static DEFINITION: Definition = Definition {
    candidates: &[
        Candidate { name: "projective/foot", estimator: &FOOT, is_smoothed: false },
        Candidate { name: "projective/sides", estimator: &SIDES, is_smoothed: false },
        Candidate { name: "projective/sides+smoothed", estimator: &SIDES, is_smoothed: true },
        Candidate { name: "projective/residual", estimator: &RESIDUAL, is_smoothed: false },
    ],
    load: |parts| Ok(Arc::new(ProjectiveEncoder::build(parts)?)),
    error_source: ErrorSource::HeldOutRows,
};

/// The parts of the recipe that are used.
#[derive(Debug, Clone, Copy)]
struct Variant {
    /// True if the position depends on width and height besides the foot point.
    uses_size: bool,
    /// True if the hidden units of a network are added to the geometric map.
    residual: bool,
}

const FOOT: Variant = Variant { uses_size: false, residual: false };
const SIDES: Variant = Variant { uses_size: true, residual: false };
const RESIDUAL: Variant = Variant { uses_size: true, residual: true };

impl Estimator for Variant {
    fn epochs(&self) -> u32 {
        50
    }

    fn networks(&self, _is_final: bool) -> u32 {
        u32::from(self.residual)
    }

    fn map_epochs(&self) -> u32 {
        20
    }

    fn fit(
        &self,
        rows: &TrainingRows,
        context: &FitContext<'_>,
        epochs: u32,
        phase: &mut Phase<'_, '_>,
    ) -> Result<FittedEncoder, FitError> {
        let form = Form { uses_size: self.uses_size, extra_sigma: RESIDUAL_SIGMA };
        let mut fitted = projection_fit::fit(&rows.rows, form, &[], &mut subset_rng());
        let features = scales_of(&fitted.projection);
        let mut parts = ModelParts::new(Recipe::Projective, rows.plane, features, context.e_gnss_m2);
        parts.set_position_scale(fitted.projection.centre, fitted.projection.unit_m);
        let mut residual = None;
        if self.residual {
            let (inputs, parameters) = train_residual(rows, &fitted, epochs, phase)?;
            let net = Net::new(shape(), &parameters);
            fitted = projection_fit::fit(&rows.rows, form, &hidden_columns(&net, &inputs), &mut subset_rng());
            put_residual(&mut parts.tensors, &parameters, &fitted.extra);
            residual = Some(ResidualNetwork { net, weights: fitted.extra.clone() });
        }
        let network = residual.as_ref().map(|residual| residual.net.clone());
        let map = ProjectiveMap {
            bounds: bounds_of(&fitted.projection, &rows.rows),
            residual,
            projection: fitted.projection,
        };
        parts.tensors.put_f64("projection", &[COEFFICIENTS], map.projection.coefficients.to_vec());
        parts.tensors.put_f64("bounds", &[2, 2], map.bounds.into_iter().flatten().collect());
        let boxes = rows.rows.iter().map(|row| {
            let position = map.projection.in_units(map.position(&row.bounding_box));
            (position, map.projection.standardised(&row.bounding_box))
        });
        InverseCamera::fit(&boxes.collect::<Vec<_>>()).put(&mut parts.tensors);
        Ok(FittedEncoder { parts, covariance: Some(GeometricCovariance::new(fitted.covariance, network)) })
    }
}

fn shape() -> NetShape {
    NetShape::auto_encoder(FEATURE_COUNT, &[RESIDUAL_UNITS], Activation::Tanh)
}

/// Least and greatest value per axis of a position, in units: the range of the labels without the outermost
/// [`IGNORED_SHARE`]th, extended by its own length on either side. The position of an outlying box near the
/// horizon is limited to it.
fn bounds_of(projection: &Projection, rows: &[TrainingRow]) -> [[f64; 2]; 2] {
    std::array::from_fn(|axis| {
        let mut values: Vec<f64> = rows.iter().map(|row| projection.in_units(row.label)[axis]).collect();
        values.sort_by(f64::total_cmp);
        let ignored = values.len() / IGNORED_SHARE;
        let (low, high) = (values[ignored], values[values.len() - 1 - ignored]);
        let range = (high - low).max(1.0);
        [low - range, high + range]
    })
}

fn scales_of(projection: &Projection) -> Vec<FeatureScale> {
    FEATURES
        .iter()
        .zip(&projection.scales)
        .map(|(name, [offset, unit])| FeatureScale {
            feature: (*name).to_owned(),
            offset: *offset,
            factor: 1.0 / unit,
        })
        .collect()
}

/// Trains the network on the residuals of the geometric map by the hybrid loss. Returns its standardised
/// inputs and its parameters.
fn train_residual(
    rows: &TrainingRows,
    fitted: &ProjectionFit,
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<(Vec<[f32; FEATURE_COUNT]>, Vec<f32>), FitError> {
    let inputs: Vec<[f32; FEATURE_COUNT]> =
        rows.rows.iter().map(|row| fitted.projection.standardised(&row.bounding_box)).collect();
    let columns: Vec<Vec<f32>> =
        (0..FEATURE_COUNT).map(|at| inputs.iter().map(|input| input[at]).collect()).collect();
    // In units of the residuals' standard deviation, so that both errors have the same balance as in
    // `hybrid`; bounded, so that an outlying fix has little influence.
    let residuals = fitted.residuals(&rows.rows, &[]);
    let unit_m = fitted.noise.variance_m2.sqrt().max(1e-3);
    let bounded = |value: &f64| (value / unit_m).clamp(-LARGEST_RESIDUAL, LARGEST_RESIDUAL) as f32;
    let set = TrainingSet {
        reconstruction_targets: columns.clone(),
        inputs: columns,
        position_targets: residuals.each_ref().map(|axis| axis.iter().map(bounded).collect()),
        weights: vec![1.0; rows.rows.len()],
    };
    let schedule =
        Schedule { epochs, batch: batch_size(rows.rows.len()), learning_rate: 0.01, last_rate_share: 0.02 };
    let (parameters, _) = phase.train("", &shape(), Arc::new(set), WEIGHTS, schedule)?;
    Ok((inputs, parameters))
}

fn hidden_columns(net: &Net, inputs: &[[f32; FEATURE_COUNT]]) -> Vec<Vec<f64>> {
    let hidden: Vec<[f32; RESIDUAL_UNITS]> = inputs.iter().map(|input| net.first_hidden(input)).collect();
    (0..RESIDUAL_UNITS).map(|unit| hidden.iter().map(|units| f64::from(units[unit])).collect()).collect()
}

/// Weights of the hidden units for east and north, in units of position.
#[derive(Debug, Clone)]
struct ResidualNetwork {
    net: Net,
    weights: [Vec<f64>; 2],
}

fn put_residual(tensors: &mut Tensors, parameters: &[f32], weights: &[Vec<f64>; 2]) {
    let layer = shape().layer(0);
    tensors.put_f32(
        "residual.0.weight",
        &[RESIDUAL_UNITS, FEATURE_COUNT],
        parameters[..layer.biases].to_vec(),
    );
    let biases = parameters[layer.biases..layer.biases + RESIDUAL_UNITS].to_vec();
    tensors.put_f32("residual.0.bias", &[RESIDUAL_UNITS], biases);
    let weights = weights.iter().flatten().copied().collect();
    tensors.put_f64("residual.1.weight", &[2, RESIDUAL_UNITS], weights);
}

fn take_residual(tensors: &mut Tensors) -> Result<Option<ResidualNetwork>> {
    if !tensors.holds("residual.0.weight") {
        return Ok(None);
    }
    let mut parameters = tensors.take_f32("residual.0.weight", &[RESIDUAL_UNITS, FEATURE_COUNT])?;
    parameters.extend(tensors.take_f32("residual.0.bias", &[RESIDUAL_UNITS])?);
    parameters.resize(shape().parameter_count(), 0.0);
    let weights = tensors.take_f64("residual.1.weight", &[2, RESIDUAL_UNITS])?;
    let (east, north) = weights.split_at(RESIDUAL_UNITS);
    Ok(Some(ResidualNetwork {
        net: Net::new(shape(), &parameters),
        weights: [east.to_vec(), north.to_vec()],
    }))
}

/// The map from a box to a position.
#[derive(Debug, Clone)]
struct ProjectiveMap {
    projection: Projection,
    /// Least and greatest position per axis, in units.
    bounds: [[f64; 2]; 2],
    residual: Option<ResidualNetwork>,
}

impl ProjectiveMap {
    #[inline]
    fn position(&self, bounding_box: &BoundingBox) -> EastNorth {
        let extra = self.residual.as_ref().map_or([0.0; 2], |residual| {
            let inputs = self.projection.standardised(bounding_box);
            let hidden: [f32; RESIDUAL_UNITS] = residual.net.first_hidden(&inputs);
            std::array::from_fn(|axis: usize| {
                let terms = residual.weights[axis].iter().zip(&hidden);
                terms.map(|(weight, unit)| weight * f64::from(*unit)).sum()
            })
        });
        self.projection.project_within(bounding_box, extra, &self.bounds)
    }
}

/// Map and inverse camera for inference.
#[derive(Debug)]
struct ProjectiveEncoder {
    map: ProjectiveMap,
    decoder: InverseCamera,
}

impl ProjectiveEncoder {
    fn build(parts: &mut ModelParts) -> Result<Self> {
        let scales = parts.scales(FEATURES)?;
        let coefficients = parts.tensors.take_f64("projection", &[COEFFICIENTS])?;
        let (centre, unit_m) = parts.position_scale()?;
        let projection = Projection {
            scales: scales.map(|scale| [scale.offset, 1.0 / scale.factor]),
            centre,
            unit_m,
            coefficients: std::array::from_fn(|at| coefficients[at]),
        };
        if projection.scales.iter().any(|[_, unit]| !unit.is_finite()) {
            return Err(Error::invalid("metadata.features", "must have factors whose inverse is finite"));
        }
        let residual = take_residual(&mut parts.tensors)?;
        let bounds = take_bounds(&mut parts.tensors)?;
        let decoder = InverseCamera::take(&mut parts.tensors)?;
        Ok(Self { map: ProjectiveMap { projection, bounds, residual }, decoder })
    }
}

impl Encoder for ProjectiveEncoder {
    fn encode(&self, _plane: &LocalPlane, bounding_box: &BoundingBox) -> Encoded {
        let position = self.map.position(bounding_box);
        let projection = &self.map.projection;
        let features = self.decoder.features_at(projection.in_units(position));
        let reconstruction_px =
            std::array::from_fn(|at| projection.scales[at][0] + projection.scales[at][1] * features[at]);
        Encoded { position, reconstruction_px }
    }

    fn express<'g>(&self, context: &GraphContext<'_, 'g>) -> Answer<'g> {
        context.calibrated(onnx::encode(self, context.boxes))
    }
}

/// Bounds of the positions.
fn take_bounds(tensors: &mut Tensors) -> Result<[[f64; 2]; 2]> {
    let bounds = tensors.take_f64("bounds", &[2, 2])?;
    let bounds = [[bounds[0], bounds[1]], [bounds[2], bounds[3]]];
    if bounds.iter().any(|[low, high]| low > high) {
        return Err(Error::invalid("weights", "bounds must have the least before the greatest"));
    }
    Ok(bounds)
}
