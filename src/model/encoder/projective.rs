//! The recipe `projective`: an auto-encoder whose encoder is a camera's geometry, learned, and
//! whose decoder is that camera in reverse.
//!
//! The encoder maps a box to the ground by a ratio of linear functions; where held-out blocks say
//! it pays, the hidden units of a small network, trained by the hybrid loss on what the geometry
//! leaves, join it as further columns. The decoder maps the position back to a box by another such
//! ratio. What never happens here: a fix among the inputs.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::hybrid::batch_of;
use super::projection::{self, COEFFICIENTS, Form, MapDoubt, Projection, SIDES, same_starts, sides_of};
use crate::domain::{BoundingBox, Error, FeatureScale, Recipe, Result};
use crate::geo::EastNorth;
use crate::model::artifact::Parts;
use crate::model::artifact::tensors::Tensors;
use crate::model::network::forward::{Activation, Net, NetShape};
use crate::model::network::training::{LossWeights, Schedule, TrainingSet};
use crate::model::progress::FitError;
use crate::model::progress::Phase;
use crate::model::samples::rows::{Row, Rows};

/// Hidden units of the residual network.
const HIDDEN: usize = 16;
/// Passes over the samples unless the run says otherwise.
pub(crate) const EPOCHS: u32 = 50;
/// Prior standard deviation of a residual column's weight, in units of position.
const RESIDUAL_SIGMA: f64 = 0.1;
const WEIGHTS: LossWeights = LossWeights { reconstruction: 0.2, regression: 1.0 };
pub(crate) const FEATURES: [&str; 4] = ["foot_x_px", "foot_y_px", "width_px", "height_px"];
/// Numbers of the reverse camera: 3 per side, and 2 of the common denominator.
const REVERSE: usize = 3 * SIDES + 2;
const LEAST_DENOMINATOR: f64 = 0.02;
/// Stands for no bound on answers, in units of position.
const UNBOUNDED: f64 = 1e9;

/// What of the recipe is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Variant {
    /// Width and height tell the position too, not only the foot point.
    pub(crate) sides: bool,
    /// A network's hidden units add what the geometry lacks.
    pub(crate) residual: bool,
}

fn shape() -> NetShape {
    NetShape::auto_encoder(SIDES, &[HIDDEN], Activation::Tanh)
}

/// Fits a variant.
pub(crate) fn fit(
    rows: &Rows,
    variant: Variant,
    e_gnss_m2: f64,
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<Parts, FitError> {
    let form = Form { sides: variant.sides, extra_sigma: RESIDUAL_SIGMA };
    let mut fitted = projection::fit(&rows.rows, form, &[], &mut same_starts());
    let mut parts = Parts {
        recipe: Recipe::Projective,
        plane: rows.plane,
        features: features_of(&fitted.projection),
        error_scale: 1.0,
        e_gnss_m2,
        parameters: [
            ("east_offset_m", fitted.projection.middle.east_m),
            ("north_offset_m", fitted.projection.middle.north_m),
            ("position_scale_m", fitted.projection.unit_m),
        ]
        .map(|(name, value)| (name.to_owned(), value))
        .into(),
        tensors: Tensors::default(),
        doubt: None,
    };
    let mut net = None;
    if variant.residual {
        let (inputs, parameters) = train_residual(rows, &fitted, epochs, phase)?;
        let layer = shape().layer(0);
        let trained = Net::new(shape(), &parameters);
        let columns = hidden_columns(&trained, &inputs);
        fitted = projection::fit(&rows.rows, form, &columns, &mut same_starts());
        parts.tensors.put_f32("residual.0.weight", &[HIDDEN, SIDES], parameters[..layer.biases].to_vec());
        let biases = parameters[layer.biases..layer.biases + HIDDEN].to_vec();
        parts.tensors.put_f32("residual.0.bias", &[HIDDEN], biases);
        let weights = fitted.extra.iter().flatten().copied().collect();
        parts.tensors.put_f64("residual.1.weight", &[2, HIDDEN], weights);
        net = Some(trained);
    }
    let coefficients = fitted.projection.coefficients.to_vec();
    parts.tensors.put_f64("projection", &[COEFFICIENTS], coefficients);
    let bounds = bounds_of(&fitted.projection, &rows.rows);
    parts.tensors.put_f64("bounds", &[2, 2], bounds.into_iter().flatten().collect());
    let encoder = Encoder {
        bounds,
        residual: net.map(|net| Residual { net, weights: fitted.extra.clone() }),
        projection: fitted.projection,
    };
    let net = encoder.residual.as_ref().map(|residual| residual.net.clone());
    parts.doubt = Some(Doubt { map: fitted.doubt, net });
    parts.tensors.put_f64("reverse", &[REVERSE], reverse_of(&encoder, &rows.rows).to_vec());
    Ok(parts)
}

/// Least and greatest position per axis that an answer may have, in units: the fixes' own range but
/// for the wildest, and as much again on either side. A wild box near the horizon ends there.
fn bounds_of(projection: &Projection, rows: &[Row]) -> [[f64; 2]; 2] {
    std::array::from_fn(|axis| {
        let mut values: Vec<f64> = rows.iter().map(|row| projection.in_units(row.label)[axis]).collect();
        values.sort_by(f64::total_cmp);
        let wild = values.len() / 100;
        let (low, high) = (values[wild], values[values.len() - 1 - wild]);
        let range = (high - low).max(1.0);
        [low - range, high + range]
    })
}

/// What the fixes leave open in a fitted encoder.
#[derive(Debug, Clone)]
pub(crate) struct Doubt {
    map: MapDoubt,
    net: Option<Net>,
}

impl Doubt {
    /// That of a geometry without a network.
    pub(crate) const fn of_geometry(map: MapDoubt) -> Self {
        Self { map, net: None }
    }

    /// Error variance per axis at a box that the noise of the fixes has left, m2.
    pub(crate) fn variance_m2(&self, bounding_box: &BoundingBox) -> f64 {
        let Some(net) = &self.net else {
            return self.map.variance_m2(bounding_box, &[]);
        };
        let hidden: [f32; HIDDEN] = net.first_hidden(&scaled(self.map.projection(), bounding_box));
        self.map.variance_m2(bounding_box, &hidden.map(f64::from))
    }
}

fn features_of(projection: &Projection) -> Vec<FeatureScale> {
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

fn scaled(projection: &Projection, bounding_box: &BoundingBox) -> [f32; SIDES] {
    let sides = sides_of(bounding_box);
    std::array::from_fn(|at| ((sides[at] - projection.scales[at][0]) / projection.scales[at][1]) as f32)
}

/// Trains the network on what the geometry leaves, by the hybrid loss.
fn train_residual(
    rows: &Rows,
    fitted: &projection::Fitted,
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<(Vec<[f32; SIDES]>, Vec<f32>), FitError> {
    let inputs: Vec<[f32; SIDES]> =
        rows.rows.iter().map(|row| scaled(&fitted.projection, &row.bounding_box)).collect();
    let columns: Vec<Vec<f32>> =
        (0..SIDES).map(|at| inputs.iter().map(|input| input[at]).collect()).collect();
    // In units of its own spread, so that the two errors stand in the same balance as in `hybrid`.
    let residuals = fitted.residuals(&rows.rows, &[]);
    let unit_m = fitted.noise.variance_m2.sqrt().max(1e-3);
    // A fix that is far off must not pull the network.
    let bounded = |value: &f64| (value / unit_m).clamp(-4.0, 4.0) as f32;
    let set = TrainingSet {
        rebuilt: columns.clone(),
        inputs: columns,
        targets: residuals.each_ref().map(|axis| axis.iter().map(bounded).collect()),
        weights: vec![1.0; rows.rows.len()],
    };
    let schedule =
        Schedule { epochs, batch: batch_of(rows.rows.len()), learning_rate: 0.01, last_rate_share: 0.02 };
    let (parameters, _) = phase.train("", &shape(), Arc::new(set), WEIGHTS, schedule)?;
    Ok((inputs, parameters))
}

fn hidden_columns(net: &Net, inputs: &[[f32; SIDES]]) -> Vec<Vec<f64>> {
    let hidden: Vec<[f32; HIDDEN]> = inputs.iter().map(|input| net.first_hidden(input)).collect();
    (0..HIDDEN).map(|unit| hidden.iter().map(|units| f64::from(units[unit])).collect()).collect()
}

/// The camera in reverse: position to sides, by reweighted linear least squares, with boxes that
/// disagree by far counted less.
fn reverse_of(encoder: &Encoder, rows: &[Row]) -> [f64; REVERSE] {
    let projection = &encoder.projection;
    let pairs: Vec<([f64; 2], [f32; SIDES])> = rows
        .iter()
        .map(|row| {
            let point = projection.in_units(encoder.regress(&row.bounding_box));
            (point, scaled(projection, &row.bounding_box))
        })
        .collect();
    let mut reverse = [0.0; REVERSE];
    for round in 0..6 {
        let mut normal = DMatrix::<f64>::identity(REVERSE, REVERSE) * (1e-6 * rows.len() as f64);
        let mut right = DVector::<f64>::zeros(REVERSE);
        for ([east, north], sides) in &pairs {
            let bottom = denominator(&reverse, *east, *north);
            let rebuilt = sides_at(&reverse, *east, *north);
            for (side, value) in sides.iter().enumerate() {
                let value = f64::from(*value);
                let miss = if round == 0 { 0.0 } else { (value - rebuilt[side]) / 0.3 };
                let weight = 1.0 / (bottom * bottom * (1.0 + miss * miss));
                let mut line = [0.0; REVERSE];
                line[3 * side..3 * side + 3].copy_from_slice(&[1.0, *east, *north]);
                line[REVERSE - 2..].copy_from_slice(&[-value * east, -value * north]);
                for row in 0..REVERSE {
                    if line[row] == 0.0 {
                        continue;
                    }
                    right[row] += weight * line[row] * value;
                    for column in 0..REVERSE {
                        normal[(row, column)] += weight * line[row] * line[column];
                    }
                }
            }
        }
        let Some(factor) = normal.cholesky() else { break };
        factor.solve_mut(&mut right);
        reverse.copy_from_slice(right.as_slice());
    }
    reverse
}

#[inline]
fn denominator(reverse: &[f64; REVERSE], east: f64, north: f64) -> f64 {
    (1.0 + reverse[REVERSE - 2] * east + reverse[REVERSE - 1] * north).max(LEAST_DENOMINATOR)
}

#[inline]
fn sides_at(reverse: &[f64; REVERSE], east: f64, north: f64) -> [f64; SIDES] {
    let bottom = denominator(reverse, east, north);
    std::array::from_fn(|side| {
        (reverse[3 * side] + reverse[3 * side + 1] * east + reverse[3 * side + 2] * north) / bottom
    })
}

#[derive(Debug, Clone)]
struct Residual {
    net: Net,
    weights: [Vec<f64>; 2],
}

#[derive(Debug, Clone)]
struct Encoder {
    projection: Projection,
    bounds: [[f64; 2]; 2],
    residual: Option<Residual>,
}

impl Encoder {
    #[inline]
    fn regress(&self, bounding_box: &BoundingBox) -> EastNorth {
        let extra = self.residual.as_ref().map_or([0.0; 2], |residual| {
            let hidden: [f32; HIDDEN] = residual.net.first_hidden(&scaled(&self.projection, bounding_box));
            std::array::from_fn(|axis: usize| {
                let terms = residual.weights[axis].iter().zip(&hidden);
                terms.map(|(weight, unit)| weight * f64::from(*unit)).sum()
            })
        });
        self.projection.project_within(bounding_box, extra, &self.bounds)
    }
}

/// Encoder and reverse camera, ready to answer.
#[derive(Debug, Clone)]
pub(crate) struct ProjectiveRegressor {
    encoder: Encoder,
    reverse: [f64; REVERSE],
}

impl ProjectiveRegressor {
    pub(crate) fn build(parts: &mut Parts) -> Result<Self> {
        let scales = parts.scales(FEATURES)?;
        let coefficients = parts.tensors.take_f64("projection", &[COEFFICIENTS])?;
        let projection = Projection {
            scales: scales.map(|scale| [scale.offset, 1.0 / scale.factor]),
            middle: EastNorth {
                east_m: parts.parameter("east_offset_m")?,
                north_m: parts.parameter("north_offset_m")?,
            },
            unit_m: parts.positive_parameter("position_scale_m")?,
            coefficients: std::array::from_fn(|at| coefficients[at]),
        };
        if projection.scales.iter().any(|[_, unit]| !unit.is_finite()) {
            return Err(Error::invalid("metadata.features", "must have factors whose inverse is finite"));
        }
        let residual = if parts.tensors.holds("residual.0.weight") {
            let mut parameters = parts.tensors.take_f32("residual.0.weight", &[HIDDEN, SIDES])?;
            parameters.extend(parts.tensors.take_f32("residual.0.bias", &[HIDDEN])?);
            parameters.resize(shape().parameter_count(), 0.0);
            let weights = parts.tensors.take_f64("residual.1.weight", &[2, HIDDEN])?;
            let (east, north) = weights.split_at(HIDDEN);
            Some(Residual { net: Net::new(shape(), &parameters), weights: [east.to_vec(), north.to_vec()] })
        } else {
            None
        };
        // Models of before answers were bounded have none.
        let bounds = if parts.tensors.holds("bounds") {
            parts.tensors.take_f64("bounds", &[2, 2])?
        } else {
            vec![-UNBOUNDED, UNBOUNDED, -UNBOUNDED, UNBOUNDED]
        };
        let bounds = [[bounds[0], bounds[1]], [bounds[2], bounds[3]]];
        if bounds.iter().any(|[low, high]| low > high) {
            return Err(Error::invalid("weights", "bounds must have the least before the greatest"));
        }
        let reverse = parts.tensors.take_f64("reverse", &[REVERSE])?;
        Ok(Self {
            encoder: Encoder { projection, bounds, residual },
            reverse: std::array::from_fn(|at| reverse[at]),
        })
    }

    /// Position, and the sides (foot x, foot y, width, height, px) that belong to it.
    #[inline]
    pub(crate) fn regress(&self, bounding_box: &BoundingBox) -> (EastNorth, [f64; SIDES]) {
        let regressed = self.encoder.regress(bounding_box);
        let projection = &self.encoder.projection;
        let [east, north] = projection.in_units(regressed);
        let sides = sides_at(&self.reverse, east, north);
        let px = std::array::from_fn(|at| projection.scales[at][0] + projection.scales[at][1] * sides[at]);
        (regressed, px)
    }
}
