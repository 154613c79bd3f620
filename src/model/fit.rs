//! From samples to an artifact: checks, receiver error, held-out blocks of time, final fit.
//!
//! What never happens here: files, clocks, threads; the caller owns the thread that this runs on,
//! and fills in the time that is left by its own clock.

use std::ops::ControlFlow;
use std::sync::Arc;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::artifact::{Artifact, FORMAT, Parts};
use super::net::NetShape;
use super::regressor::{R95_PER_SIGMA, Regressor};
use super::rows::{Rows, hash_of};
use super::train::{LossSums, LossWeights, Schedule, TrainError, TrainingSet, train};
use super::{hybrid, noise, paper};
use crate::domain::{
    EpochReport, Error, GnssError, GnssErrorSource, HeldOutError, ImageSize, ModelMetadata, OriginDeg,
    Recipe, RunProgress, Sample,
};

/// Blocks of time that are held out in turn.
const BLOCKS: u32 = 4;

/// What a fit is asked to do.
#[derive(Debug, Clone, PartialEq)]
pub struct FitOptions {
    /// How to learn.
    pub recipe: Recipe,
    /// Everything random comes from it.
    pub seed: u64,
    /// Passes over the samples; `None` for the recipe's own number.
    pub epochs: Option<u32>,
    /// Size of the camera's image, if known.
    pub image_size: Option<ImageSize>,
    /// What is known of the receiver.
    pub gnss_error: GnssError,
}

/// What a fit tells on its way.
#[derive(Debug)]
pub enum FitEvent<'a> {
    /// How far it has come; `remaining_s` is left to the caller, who has a clock.
    Progress(&'a RunProgress),
    /// One epoch of the final fit.
    Epoch(&'a EpochReport),
    /// A line for the log.
    Note(&'a str),
}

/// Why a fit gave no model.
#[derive(Debug, thiserror::Error)]
pub enum FitError {
    /// The observer asked for it.
    #[error("cancelled")]
    Cancelled,
    /// The samples cannot support a fit; a refusal that names `samples` and the remedy.
    #[error("{0}")]
    Unusable(Error),
    /// Ours.
    #[error("the fit failed: {0}")]
    Fault(String),
}

impl From<TrainError> for FitError {
    fn from(error: TrainError) -> Self {
        match error {
            TrainError::Cancelled => Self::Cancelled,
            TrainError::Candle(cause) => Self::Fault(cause.to_string()),
        }
    }
}

/// The observer of a fit; returning `Break` ends it.
pub(super) type Observer<'a> = dyn FnMut(FitEvent<'_>) -> ControlFlow<()> + 'a;

/// Fits a model on the calling thread.
///
/// The same samples, options and seed give the same artifact bit for bit on one machine.
///
/// # Errors
/// [`FitError::Cancelled`] once the observer breaks, [`FitError::Unusable`] where the samples cannot
/// support a fit.
pub fn fit(
    samples: &[Sample],
    options: &FitOptions,
    observer: &mut dyn FnMut(FitEvent<'_>) -> ControlFlow<()>,
) -> Result<Artifact, FitError> {
    let rows = Rows::new(samples)?;
    let (e_gnss_m2, e_gnss_source) = receiver_variance(&rows, options.gnss_error);
    let recipe = match options.recipe {
        Recipe::Paper => Recipe::Paper,
        Recipe::Hybrid | Recipe::Projective | Recipe::Auto => Recipe::Hybrid,
    };
    let own_epochs = if recipe == Recipe::Paper { paper::EPOCHS } else { hybrid::EPOCHS };
    let epochs = options.epochs.unwrap_or(own_epochs).max(1);
    let nets = if recipe == Recipe::Paper { 2 } else { 1 };
    let mut run = Run {
        observer,
        progress: RunProgress { epochs: epochs * nets * (BLOCKS + 1), ..RunProgress::default() },
    };
    run.note(&format!(
        "{} samples of {} targets in {} passes; the receiver's sigma is {:.2} m per axis",
        rows.rows.len(),
        rows.targets,
        rows.passes,
        e_gnss_m2.sqrt()
    ))?;
    let fit_rows = |rows: &Rows, phase: &mut Phase<'_, '_>| {
        let mut parts = match recipe {
            Recipe::Paper => paper::fit(rows, e_gnss_m2, epochs, phase),
            _ => hybrid::fit(rows, e_gnss_m2, epochs, phase),
        }?;
        if let Some(size) = options.image_size {
            parts.parameters.insert("image_width_px".to_owned(), f64::from(size.width_px()));
            parts.parameters.insert("image_height_px".to_owned(), f64::from(size.height_px()));
        }
        Ok::<Parts, FitError>(parts)
    };
    let held_out = held_out(&rows, options.seed, e_gnss_m2, &mut run, &fit_rows)?;
    if let Some(held_out) = &held_out {
        run.note(&format!(
            "on {} held-out blocks of time the regressed position is {:.2} m from the fix on average",
            held_out.blocks, held_out.mean_to_fix_m
        ))?;
    }
    let rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut phase = Phase { run: &mut run, name: "final fit".to_owned(), rng, is_final: true };
    let parts = fit_rows(&rows, &mut phase)?;
    let weights = parts.tensors.to_bytes().map_err(|cause| FitError::Fault(cause.to_string()))?;
    let origin = parts.plane.origin();
    Ok(Artifact {
        metadata: ModelMetadata {
            format: FORMAT,
            requested_recipe: options.recipe.as_str().to_owned(),
            recipe: parts.recipe.as_str().to_owned(),
            features: parts.features,
            origin: OriginDeg { longitude_deg: origin.longitude_deg(), latitude_deg: origin.latitude_deg() },
            seed: options.seed,
            epochs,
            training_rows_sha256: hash_of(samples),
            samples: rows.rows.len() as u32,
            targets: rows.targets,
            passes: rows.passes,
            error_scale: parts.error_scale,
            e_gnss_m2,
            e_gnss_source,
            held_out,
            candidates: Vec::new(),
            parameters: parts.parameters,
        },
        weights,
    })
}

fn receiver_variance(rows: &Rows, known: GnssError) -> (f64, GnssErrorSource) {
    match (known, rows.own_variance_m2()) {
        (GnssError::Known(sigma), _) => (sigma.variance_m2(), GnssErrorSource::Profile),
        (GnssError::Unknown, Some(variance_m2)) => (variance_m2, GnssErrorSource::Profile),
        (GnssError::Unknown, None) => (noise::scatter_m2(rows), GnssErrorSource::Estimated),
    }
}

/// Fits without each block of time in turn and compares with its fixes; `None` where too few rows
/// are left to learn from.
fn held_out(
    rows: &Rows,
    seed: u64,
    e_gnss_m2: f64,
    run: &mut Run<'_>,
    fit_rows: &dyn Fn(&Rows, &mut Phase<'_, '_>) -> Result<Parts, FitError>,
) -> Result<Option<HeldOutError>, FitError> {
    let blocks = rows.blocks(BLOCKS);
    let (mut count, mut distance_m, mut square_m2, mut inside) = (0u32, 0.0, 0.0, 0u32);
    for block in 0..BLOCKS {
        let train = rows.filtered(|at| blocks[at] != block);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(u64::from(block) + 1);
        let name = format!("held-out block {} of {BLOCKS}", block + 1);
        let parts = fit_rows(&train, &mut Phase { run, name, rng, is_final: false })?;
        let regressor = Regressor::build(parts).map_err(|error| FitError::Fault(error.to_string()))?;
        let held = rows.rows.iter().zip(&blocks).filter(|(_, of)| **of == block);
        for (row, _) in held {
            let fix = regressor.plane().to_plane(row.position);
            // From the box alone: a network that sees the fix would be praised for repeating it.
            let answer = regressor.regress(&row.bounding_box, None);
            let miss_m = answer.regressed.distance_m(fix);
            count += 1;
            distance_m += miss_m;
            square_m2 += 0.5 * miss_m * miss_m;
            inside += u32::from(miss_m <= R95_PER_SIGMA * (answer.e_regression_m2 + e_gnss_m2).sqrt());
        }
    }
    if count == 0 {
        return Ok(None);
    }
    let error_to_fix_m2 = square_m2 / f64::from(count);
    Ok(Some(HeldOutError {
        blocks: BLOCKS,
        samples: count,
        mean_to_fix_m: distance_m / f64::from(count),
        error_to_fix_m2,
        e_regression_m2: (error_to_fix_m2 - e_gnss_m2).max(0.01 * error_to_fix_m2),
        coverage95_of_fixes: f64::from(inside) / f64::from(count),
    }))
}

/// One fit with its observer and progress.
pub(super) struct Run<'a> {
    observer: &'a mut Observer<'a>,
    progress: RunProgress,
}

impl Run<'_> {
    pub(super) fn note(&mut self, line: &str) -> Result<(), FitError> {
        self.tell(|observer, _| observer(FitEvent::Note(line)))
    }

    fn tell(
        &mut self,
        event: impl FnOnce(&mut Observer<'_>, &RunProgress) -> ControlFlow<()>,
    ) -> Result<(), FitError> {
        match event(self.observer, &self.progress) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(FitError::Cancelled),
        }
    }
}

/// One part of a run: a held-out block, or the final fit.
pub(super) struct Phase<'r, 'a> {
    pub(super) run: &'r mut Run<'a>,
    pub(super) name: String,
    pub(super) rng: ChaCha8Rng,
    /// Whether its epochs are those of the run's curve.
    pub(super) is_final: bool,
}

impl Phase<'_, '_> {
    /// Trains a network from fresh parameters; `part` tells networks of one phase apart. Returns
    /// the parameters and the sums of the last epoch.
    pub(super) fn train(
        &mut self,
        part: &str,
        shape: &NetShape,
        set: Arc<TrainingSet>,
        weights: LossWeights,
        schedule: Schedule,
    ) -> Result<(Vec<f32>, LossSums), FitError> {
        let Self { run, name, rng, is_final } = self;
        run.progress.phase = format!("{name} {}", part.trim_end_matches('.')).trim().to_owned();
        // The curve shows the network that answers when there is a fix.
        let curve = *is_final && part != "denied.";
        let mut last = LossSums::default();
        let parameters = shape.initial_parameters(rng);
        let parameters = train(shape, parameters, set, weights, schedule, rng, &mut |epoch, sums| {
            last = *sums;
            let report = EpochReport {
                epoch,
                loss: sums.loss / sums.samples,
                reconstruction_error: sums.reconstruction / sums.samples,
                regression_error: sums.regression / sums.samples,
                error_scale: sums.ratio / sums.samples,
            };
            run.progress.epoch += 1;
            run.progress.reconstruction_error = report.reconstruction_error;
            run.progress.regression_error = report.regression_error;
            run.progress.error_scale = report.error_scale;
            (run.observer)(FitEvent::Progress(&run.progress))?;
            if curve { (run.observer)(FitEvent::Epoch(&report)) } else { ControlFlow::Continue(()) }
        })?;
        Ok((parameters, last))
    }
}
