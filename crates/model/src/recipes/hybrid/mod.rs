//! The recipe `hybrid`: the paper's auto-encoder and loss on standardised boxes, in metres, without the
//! fix among the inputs, so that a label cannot predict itself.

use crate::artifact::{ModelParts, Scale};
use crate::domain::{BoundingBox, FeatureScale, Recipe, Result};
use crate::encoder::FittedEncoder;
use crate::encoder::auto_encoder::{self, AutoEncoder, OutputScale, Trained};
use crate::encoder::features::{Encoded, FEATURES};
use crate::encoder::stored_network::{put_network, take_network};
use crate::progress::{FitError, Phase};
use crate::samples::rows::TrainingRows;

const HIDDEN: [usize; 2] = [24, 24];
/// Default number of epochs.
pub(crate) const EPOCHS: u32 = 60;

/// Fits the network.
pub(crate) fn fit(
    rows: &TrainingRows,
    e_gnss_m2: f64,
    epochs: u32,
    phase: &mut Phase<'_, '_>,
) -> Result<FittedEncoder, FitError> {
    let Trained { scales, output, shape, parameters } = auto_encoder::train(rows, &HIDDEN, epochs, phase)?;
    let features = FEATURES
        .iter()
        .zip(scales)
        .map(|(name, Scale { offset, factor })| FeatureScale { feature: (*name).to_owned(), offset, factor })
        .collect();
    let mut parts = ModelParts::new(Recipe::Hybrid, rows.plane, features, e_gnss_m2);
    parts.set_position_scale(output.centre, output.unit_m);
    put_network(&mut parts.tensors, "", &shape, &parameters);
    Ok(FittedEncoder { parts, covariance: None })
}

/// The network for inference.
#[derive(Debug, Clone)]
pub(crate) struct HybridEncoder(pub(crate) AutoEncoder);

impl HybridEncoder {
    pub(super) fn build(parts: &mut ModelParts) -> Result<Self> {
        let (centre, unit_m) = parts.position_scale()?;
        Ok(Self(AutoEncoder {
            scales: parts.scales(FEATURES)?,
            output: OutputScale { centre, unit_m },
            net: take_network(&mut parts.tensors, "", auto_encoder::shape(&HIDDEN))?,
        }))
    }

    /// Position and reconstruction of a box.
    #[inline]
    pub(crate) fn encode(&self, bounding_box: &BoundingBox) -> Encoded {
        self.0.encode(bounding_box)
    }
}
