//! The auto-encoder that every model of this recipe holds beside its map: it makes the service that of the
//! paper whatever the position comes from. Its reconstruction error eX (2) tells boxes that no training box
//! resembles; Es (4) scales it to an error.

use crate::artifact::tensors::is_usable;
use crate::artifact::{ModelParts, Scale};
use crate::domain::{Error, Result};
use crate::encoder::auto_encoder::{AutoEncoder, OutputScale, Trained, shape, train};
use crate::encoder::features::{FEATURE_COUNT, reconstruction_error};
use crate::encoder::stored_network::{put_network, take_network};
use crate::geo::EastNorth;
use crate::progress::{FitError, Phase};
use crate::samples::rows::TrainingRows;

/// Five layers of nodes as in the paper: 4-16-2-16-4.
const HIDDEN: [usize; 1] = [16];
/// Default number of epochs.
pub(crate) const EPOCHS: u32 = 30;
/// Rows that it is trained on at most; more are thinned evenly.
const MAX_ROWS: usize = 4_000;
/// Smallest reconstruction error that Es divides by, in squared box heights: rounding of f32.
const LEAST_RECONSTRUCTION: f64 = 1e-9;
/// Range of Es, m2 per squared box height.
const ERROR_SCALE_RANGE: [f64; 2] = [1e-9, 1e9];

const PREFIX: &str = "auto_encoder.";
const SCALES: &str = "auto_encoder.scales";
const POSITION: &str = "auto_encoder.position";

/// Trains the auto-encoder and stores it in the model with Es.
pub(crate) fn fit(
    rows: &TrainingRows,
    epochs: u32,
    parts: &mut ModelParts,
    phase: &mut Phase<'_, '_>,
) -> std::result::Result<(), FitError> {
    let stride = rows.rows.len().div_ceil(MAX_ROWS).max(1);
    let thinned = rows.filtered(|row| row.is_multiple_of(stride));
    let trained = train(&thinned, &HIDDEN, epochs, phase)?;
    put(&trained, parts);
    let auto_encoder = AutoEncoder::from(trained);
    let errors: Vec<(f64, f64)> = thinned
        .rows
        .iter()
        .map(|row| {
            let encoded = auto_encoder.encode(&row.bounding_box);
            let reconstruction = reconstruction_error(&row.bounding_box, &encoded).max(LEAST_RECONSTRUCTION);
            (encoded.position.error_per_axis_m2(row.label), reconstruction)
        })
        .collect();
    let mean = |of: &dyn Fn(&(f64, f64)) -> f64| errors.iter().map(of).sum::<f64>() / errors.len() as f64;
    let [least, most] = ERROR_SCALE_RANGE;
    parts.error_scale = mean(&|(position_m2, box_error)| position_m2 / box_error).clamp(least, most);
    // The mean of the ratios has a heavy tail; the ratio of the means has not.
    parts.set("auto_encoder.ratio_of_means_m2", mean(&|own| own.0) / mean(&|own| own.1));
    Ok(())
}

fn put(trained: &Trained, parts: &mut ModelParts) {
    let OutputScale { centre, unit_m } = trained.output;
    let scales = trained.scales.iter().flat_map(|scale| [scale.offset, scale.factor]).collect();
    parts.tensors.put_f64(SCALES, &[FEATURE_COUNT, 2], scales);
    parts.tensors.put_f64(POSITION, &[3], vec![centre.east_m, centre.north_m, unit_m]);
    put_network(&mut parts.tensors, PREFIX, &trained.shape, &trained.parameters);
}

/// The auto-encoder of a model; `None` where the fit was not the last one.
///
/// # Errors
/// Names the tensor that is missing or cannot be used.
pub(crate) fn take(parts: &mut ModelParts) -> Result<Option<AutoEncoder>> {
    let tensors = &mut parts.tensors;
    if !tensors.holds(SCALES) {
        return Ok(None);
    }
    let scales = tensors.take_f64(SCALES, &[FEATURE_COUNT, 2])?;
    let position = tensors.take_f64(POSITION, &[3])?;
    let factors = scales.iter().skip(1).step_by(2);
    if !factors.chain([&position[2]]).all(|factor| *factor > 0.0 && is_usable(1.0 / factor)) {
        return Err(Error::invalid("weights", "auto_encoder must have scales above 0"));
    }
    Ok(Some(AutoEncoder {
        scales: std::array::from_fn(|at| Scale { offset: scales[2 * at], factor: scales[2 * at + 1] }),
        output: OutputScale {
            centre: EastNorth { east_m: position[0], north_m: position[1] },
            unit_m: position[2],
        },
        net: take_network(tensors, PREFIX, shape(&HIDDEN))?,
    }))
}
