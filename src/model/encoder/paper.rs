//! The recipe `paper`: Liang et al. 2022 to the letter, for the record and for parity.
//!
//! Raw pixels and standardised degrees `(deg - offset) * 1e4`, a 6-h-2-h-6 auto-encoder and a
//! 4-h-2-h-4 of its own for GNSS denied, L = 1 eX + 2000 eZ, Adam at 0.005, Es by (4) from the last
//! epoch. What never happens here: any of the cures that `docs/method.md` tells; the network that
//! sees the fix learns to repeat it.

use std::sync::Arc;

use crate::domain::{BoundingBox, FeatureScale, Recipe, Result};
use crate::geo::{EastNorth, LocalPlane, Position};
use crate::model::artifact::Parts;
use crate::model::artifact::tensors::Tensors;
use crate::model::network::forward::{Activation, Net, NetShape};
use crate::model::network::training::{LossSums, LossWeights, Schedule, TrainingSet};
use crate::model::progress::FitError;
use crate::model::progress::Phase;
use crate::model::regressor::R95_PER_SIGMA;
use crate::model::samples::rows::Rows;

/// Degrees to units.
const UNITS_PER_DEGREE: f64 = 1e4;
/// Metres per degree at the equator, only for positions that have left the globe.
const METRES_PER_DEGREE: f64 = 111_320.0;
/// Hidden units; the paper leaves them open.
const HIDDEN: usize = 32;
/// Passes over the samples unless the run says otherwise; the paper leaves them open.
pub(crate) const EPOCHS: u32 = 100;
const BATCH: usize = 128;
const WEIGHTS: LossWeights = LossWeights { reconstruction: 1.0, regression: 2000.0 };
const FEATURES: [&str; 6] = ["left_px", "top_px", "width_px", "height_px", "longitude_deg", "latitude_deg"];

/// Fits both networks.
pub(crate) fn fit(
    rows: &Rows,
    e_gnss_m2: f64,
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<Parts, FitError> {
    let offset = lowest_corner(rows);
    let units: [Vec<f32>; 2] = std::array::from_fn(|axis| {
        rows.rows.iter().map(|row| standardised(offset, row.position)[axis]).collect()
    });
    let mut features: Vec<FeatureScale> = FEATURES
        .iter()
        .map(|name| FeatureScale { feature: (*name).to_owned(), offset: 0.0, factor: 1.0 })
        .collect();
    for (feature, degrees) in features[4..].iter_mut().zip([offset.longitude_deg(), offset.latitude_deg()]) {
        (feature.offset, feature.factor) = (degrees, UNITS_PER_DEGREE);
    }
    let mut parts = Parts {
        recipe: Recipe::Paper,
        plane: LocalPlane::new(offset),
        features,
        error_scale: 1.0,
        e_gnss_m2,
        parameters: [("r95_scale".to_owned(), R95_PER_SIGMA)].into(),
        tensors: Tensors::default(),
        doubt: None,
    };
    let schedule = Schedule { epochs, batch: BATCH, learning_rate: 0.005, last_rate_share: 1.0 };
    for (prefix, inputs) in [("joint.", 6), ("denied.", 4)] {
        let shape = shape(inputs);
        let set = Arc::new(training_set(rows, &units, inputs));
        let (parameters, sums) = phase.train(prefix, &shape, set, WEIGHTS, schedule)?;
        parts.put_net(prefix, &shape, &parameters);
        let error_scale = error_scale(&sums);
        match inputs {
            6 => parts.error_scale = error_scale,
            _ => drop(parts.parameters.insert("denied_error_scale".to_owned(), error_scale)),
        }
    }
    Ok(parts)
}

/// Es of (4), units2 per unit of eX.
fn error_scale(sums: &LossSums) -> f64 {
    (sums.ratio / sums.samples).clamp(1e-12, 1e12)
}

fn shape(inputs: usize) -> NetShape {
    NetShape::auto_encoder(inputs, &[HIDDEN], Activation::Relu)
}

fn training_set(rows: &Rows, units: &[Vec<f32>; 2], inputs: usize) -> TrainingSet {
    let mut columns: Vec<Vec<f32>> = (0..4)
        .map(|side| rows.rows.iter().map(|row| row.bounding_box.sides_px()[side] as f32).collect())
        .collect();
    if inputs == 6 {
        columns.extend(units.iter().cloned());
    }
    TrainingSet {
        rebuilt: columns.clone(),
        inputs: columns,
        targets: units.clone(),
        weights: vec![1.0; rows.rows.len()],
    }
}

/// The least longitude and latitude of the training fixes, the paper's offsets.
fn lowest_corner(rows: &Rows) -> Position {
    let origin = rows.plane.origin();
    let (mut east_deg, mut north_deg) = (f64::INFINITY, f64::INFINITY);
    for row in &rows.rows {
        east_deg = east_deg.min(turned(row.position.longitude_deg() - origin.longitude_deg()));
        north_deg = north_deg.min(row.position.latitude_deg());
    }
    Position::new(turned(origin.longitude_deg() + east_deg), north_deg).unwrap_or(origin)
}

/// Degrees brought into -180..180, for differences across the antimeridian.
fn turned(degrees: f64) -> f64 {
    (degrees + 180.0).rem_euclid(360.0) - 180.0
}

fn standardised(offset: Position, position: Position) -> [f32; 2] {
    [
        (turned(position.longitude_deg() - offset.longitude_deg()) * UNITS_PER_DEGREE) as f32,
        ((position.latitude_deg() - offset.latitude_deg()) * UNITS_PER_DEGREE) as f32,
    ]
}

/// Both networks, ready to answer.
#[derive(Debug, Clone)]
pub(crate) struct PaperRegressor {
    joint: Net,
    denied: Net,
    /// Es of (4) of both, units2 per unit of eX.
    error_scales: [f64; 2],
    /// m2 per unit2, mean of both axes.
    unit_m2: f64,
}

impl PaperRegressor {
    pub(crate) fn build(parts: &mut Parts) -> Result<Self> {
        parts.scales(FEATURES)?;
        let plane = &parts.plane;
        let corner = Position::new(
            turned(plane.origin().longitude_deg() + 1.0 / UNITS_PER_DEGREE),
            (plane.origin().latitude_deg() + 1.0 / UNITS_PER_DEGREE).min(90.0),
        );
        let unit = corner.map_or(EastNorth::default(), |corner| plane.to_plane(corner));
        Ok(Self {
            unit_m2: (0.5 * (unit.east_m * unit.east_m + unit.north_m * unit.north_m)).max(1e-6),
            error_scales: [parts.error_scale, parts.positive_parameter("denied_error_scale")?],
            joint: parts.take_net("joint.", shape(6))?,
            denied: parts.take_net("denied.", shape(4))?,
        })
    }

    pub(crate) fn regress(
        &self,
        plane: &LocalPlane,
        bounding_box: &BoundingBox,
        fix: Option<EastNorth>,
    ) -> (EastNorth, f64, f64) {
        let [left, top, width, height] = bounding_box.sides_px().map(|side| side as f32);
        let (middle, rebuilt, inputs, error_scale);
        match fix {
            Some(fix) => {
                let [east, north] = standardised(plane.origin(), plane.to_position(fix));
                let all = [left, top, width, height, east, north];
                middle = self.joint.encode(&all);
                (rebuilt, inputs, error_scale) = (self.joint.decode(middle), all, self.error_scales[0]);
            }
            None => {
                let all = [left, top, width, height, 0.0, 0.0];
                middle = self.denied.encode(&all[..4]);
                (rebuilt, inputs, error_scale) = (self.denied.decode(middle), all, self.error_scales[1]);
            }
        }
        let count = if fix.is_some() { 6 } else { 4 };
        let squares = inputs[..count].iter().zip(&rebuilt).map(|(one, other)| f64::from(one - other).powi(2));
        let reconstruction_error = squares.sum::<f64>() / count as f64;
        (in_plane(plane, middle), reconstruction_error, error_scale * reconstruction_error * self.unit_m2)
    }
}

/// Units back to metres in the plane about the offset.
fn in_plane(plane: &LocalPlane, units: [f32; 2]) -> EastNorth {
    let [east_deg, north_deg] = units.map(|unit| f64::from(unit) / UNITS_PER_DEGREE);
    let origin = plane.origin();
    let longitude_deg = origin.longitude_deg() + east_deg;
    let near = east_deg.abs() < 90.0;
    match Position::new(turned(longitude_deg), origin.latitude_deg() + north_deg) {
        Ok(position) if near => plane.to_plane(position),
        _ => EastNorth { east_m: east_deg * METRES_PER_DEGREE, north_m: north_deg * METRES_PER_DEGREE },
    }
}
