//! The recipe `hybrid`: the paper's auto-encoder and loss on standardised boxes, in metres, without the
//! fix among the inputs, so that a label cannot predict itself.

use std::sync::Arc;

use super::{Candidate, Definition, ErrorSource, Estimator, FitContext};
use crate::artifact::{ModelParts, Scale};
use crate::domain::{BoundingBox, FeatureScale, Recipe, Result};
use crate::encoder::auto_encoder::{self, AutoEncoder, OutputScale, Trained};
use crate::encoder::features::{Encoded, FEATURES};
use crate::encoder::stored_network::{put_network, take_network};
use crate::encoder::{Encoder, FittedEncoder};
use crate::geo::LocalPlane;
use crate::onnx::answer::{Answer, GraphContext};
use crate::onnx::network;
use crate::progress::{FitError, Phase};
use crate::samples::rows::TrainingRows;

/// The recipe.
pub(super) static DEFINITION: Definition = Definition {
    candidates: &[
        Candidate { name: "hybrid", estimator: &Hybrid, is_smoothed: false },
        Candidate { name: "hybrid+smoothed", estimator: &Hybrid, is_smoothed: true },
    ],
    load: |parts| Ok(Arc::new(HybridEncoder::build(parts)?)),
    error_source: ErrorSource::HeldOutRows,
};

const HIDDEN: [usize; 2] = [24, 24];

/// The fit of the recipe.
#[derive(Debug)]
struct Hybrid;

impl Estimator for Hybrid {
    fn epochs(&self) -> u32 {
        60
    }

    fn networks(&self, _is_final: bool) -> u32 {
        1
    }

    fn fit(
        &self,
        rows: &TrainingRows,
        context: &FitContext<'_>,
        epochs: u32,
        phase: &mut Phase<'_, '_>,
    ) -> Result<FittedEncoder, FitError> {
        let Trained { scales, output, shape, parameters } =
            auto_encoder::train(rows, &HIDDEN, epochs, phase)?;
        let features = FEATURES
            .iter()
            .zip(scales)
            .map(|(name, Scale { offset, factor })| FeatureScale {
                feature: (*name).to_owned(),
                offset,
                factor,
            })
            .collect();
        let mut parts = ModelParts::new(Recipe::Hybrid, rows.plane, features, context.e_gnss_m2);
        parts.set_position_scale(output.centre, output.unit_m);
        put_network(&mut parts.tensors, "", &shape, &parameters);
        Ok(FittedEncoder { parts, covariance: None })
    }
}

/// The network for inference.
#[derive(Debug)]
struct HybridEncoder(AutoEncoder);

impl HybridEncoder {
    fn build(parts: &mut ModelParts) -> Result<Self> {
        let (centre, unit_m) = parts.position_scale()?;
        Ok(Self(AutoEncoder {
            scales: parts.scales(FEATURES)?,
            output: OutputScale { centre, unit_m },
            net: take_network(&mut parts.tensors, "", auto_encoder::shape(&HIDDEN))?,
        }))
    }
}

impl Encoder for HybridEncoder {
    fn encode(&self, _plane: &LocalPlane, bounding_box: &BoundingBox) -> Encoded {
        self.0.encode(bounding_box)
    }

    fn express<'g>(&self, context: &GraphContext<'_, 'g>) -> Answer<'g> {
        context.calibrated(network::auto_encoder(&self.0, context.boxes))
    }
}
