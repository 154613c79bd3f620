//! The fit of a model: checks, receiver error, cross-validation, final fit, calibration.
//!
//! It runs on the calling thread and starts no other.

use std::ops::ControlFlow;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::findings::{Selection, training_report};
use super::held_out::{choose, cross_validate};
use super::observed_scene::put_scene;
use super::report::{
    coverage_of_fixes, held_out_error, mean_variance_m2, note_choice, note_errors, note_samples,
};
use super::track_noise::estimate_track_noise;
use super::widening::widen_radius;
use crate::artifact::{Artifact, FORMAT, ModelParts};
use crate::domain::{
    CandidateReport, Detection, Error, GaussMarkovNoise, GnssError, GnssErrorSource, HeldOutError,
    HeldOutSampleError, ImageSize, KnownPoint, ModelMetadata, OriginDeg, Recipe, RunProgress, Sample,
    TrainingReport,
};
use crate::encoder::geometry::{GeometricCovariance, fit_geometry};
use crate::encoder::projection_fit::ParameterCovariance;
use crate::network::LossWeights;
use crate::progress::{FitError, FitEvent, FitRun, Phase};
use crate::recipes::gaussian_process::target_height_m;
use crate::recipes::{self, Candidate, ErrorSource, FitContext};
use crate::regressor::Regressor;
use crate::samples::rows::{HELD_OUT_BLOCKS, TrainingRow, TrainingRows, sha256_of};
use crate::samples::unpaired::unpaired_boxes;
use crate::uncertainty::calibration::{HeldOut, calibrate, calibrate_reconstruction};
use crate::uncertainty::error_model::set_image_size;

/// Rows that a fit uses at most: neighbours repeat each other, and time and memory stay bounded.
pub(super) const MAX_ROWS: usize = 20_000;
/// Least error variance of a receiver that is estimated, m2.
pub(super) const LEAST_GNSS_VARIANCE_M2: f64 = 1e-4;

/// The training input of a fit.
#[derive(Debug, Clone, Copy)]
pub struct FitInput<'a> {
    /// Boxes with the fix of the same instant.
    pub samples: &'a [Sample],
    /// Boxes without a fix. They tell the geometry of a camera whose image size is known; recipes
    /// `gaussian_process` and `auto` use those of the class that most samples have.
    pub unpaired: &'a [Detection],
    /// Points of the ground whose place an operator has stated. They take away the bias that all fixes have in common,
    /// and tell the geometry where nobody walked. With any, `auto` is `gaussian_process`, which alone uses them.
    pub known_points: &'a [KnownPoint],
}

impl<'a> From<&'a [Sample]> for FitInput<'a> {
    fn from(samples: &'a [Sample]) -> Self {
        Self { samples, unpaired: &[], known_points: &[] }
    }
}

impl<'a> From<&'a Vec<Sample>> for FitInput<'a> {
    fn from(samples: &'a Vec<Sample>) -> Self {
        Self::from(samples.as_slice())
    }
}

/// The options of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct FitOptions {
    /// The recipe.
    pub recipe: Recipe,
    /// Seed of everything random.
    pub seed: u64,
    /// Training epochs; `None` for the recipe's own number.
    pub epochs: Option<u32>,
    /// Size of the camera's image, if known.
    pub image_size: Option<ImageSize>,
    /// The receiver's error, if known.
    pub gnss_error: GnssError,
    /// Standard deviation per axis, m, of the bias that all fixes of the training have in common and that
    /// no sample can show: that of the one session of the one receiver, or what several receivers share.
    /// `None` for a share of the estimated receiver error.
    pub gnss_bias_sigma_m: Option<f64>,
}

/// Changes to a fit for an evaluation; operators have no access to them.
#[derive(Debug, Clone, Copy, Default)]
pub struct FitOverrides<'a> {
    /// The only candidate, by its name in the report.
    pub candidate: Option<&'a str>,
    /// Loss weights that replace the recipe's own.
    pub loss_weights: Option<LossWeights>,
}

/// Fits a model on the calling thread.
///
/// The same samples, options and seed give the same artifact bit for bit on one machine.
///
/// # Errors
/// [`FitError::Cancelled`] when the observer breaks, [`FitError::Unusable`] where the samples cannot
/// support a fit.
pub fn fit<'a>(
    input: impl Into<FitInput<'a>>,
    options: &FitOptions,
    observer: &mut dyn FnMut(FitEvent<'_>) -> ControlFlow<()>,
) -> Result<Artifact, FitError> {
    fit_with(input, options, FitOverrides::default(), observer)
}

/// Fits a model with some overrides.
///
/// # Errors
/// As [`fit`], and [`FitError::Fault`] where the recipe has no such candidate.
pub fn fit_with<'a>(
    input: impl Into<FitInput<'a>>,
    options: &FitOptions,
    overrides: FitOverrides<'_>,
    observer: &mut dyn FnMut(FitEvent<'_>) -> ControlFlow<()>,
) -> Result<Artifact, FitError> {
    let FitInput { samples, unpaired, known_points } = input.into();
    let rows = TrainingRows::new(samples).map_err(FitError::Unusable)?.thinned(MAX_ROWS);
    let unpaired = unpaired_boxes(samples, unpaired);
    let geometry = fit_geometry(&rows);
    let (e_gnss_m2, e_gnss_source) = receiver_variance(&rows, options.gnss_error, &geometry.noise);
    let context = FitContext {
        e_gnss_m2,
        e_gnss_is_estimated: e_gnss_source == GnssErrorSource::Estimated,
        image_size: options.image_size,
        gnss_bias_sigma_m: options.gnss_bias_sigma_m,
        unpaired: &unpaired,
        known_points,
        target_height_m: target_height_m(samples.iter().map(|sample| sample.class.as_ref())),
        noise: geometry.noise,
        epochs: options.epochs,
        seed: options.seed,
        loss_weights: overrides.loss_weights,
    };
    let mut run = FitRun { observer, progress: RunProgress::default() };
    let recipe = match options.recipe {
        Recipe::Auto if !known_points.is_empty() => Recipe::GaussianProcess,
        stated => stated,
    };
    let candidates = selected(recipe, overrides.candidate)?;
    let chosen = select(samples, &rows, &context, &candidates, &mut run)?;
    let fit = FinalFit { samples, rows: &rows, context: &context, options, e_gnss_source };
    let (parts, held_out) = fit.run(&chosen, geometry.covariance, &mut run)?;
    note_errors(&held_out, &parts, &mut run)?;
    let report = training_report(&chosen.selection(), &held_out, &rows, &parts, options.image_size);
    for line in report.to_string().lines() {
        run.note(line)?;
    }
    let artifact = artifact_of(parts, &fit, chosen, held_out, report)?;
    // A model that does not pass the checks of every loaded model must not be stored.
    artifact.load().map_err(FitError::Unusable)?;
    Ok(artifact)
}

/// The candidates of a recipe, or the one of that name.
fn selected(recipe: Recipe, name: Option<&str>) -> Result<Vec<&'static Candidate>, FitError> {
    let candidates: Vec<&Candidate> = recipes::candidates(recipe)
        .filter(|candidate| name.is_none_or(|only| only == candidate.name))
        .collect();
    if candidates.is_empty() {
        let message = format!("must be one of the candidates of {recipe}");
        return Err(FitError::fault(Error::invalid("candidate", message)));
    }
    Ok(candidates)
}

/// The receiver's error variance per axis (m2): as stated, else the variance of the fixes about the
/// geometric map.
pub(super) fn receiver_variance(
    rows: &TrainingRows,
    known: GnssError,
    noise: &GaussMarkovNoise,
) -> (f64, GnssErrorSource) {
    match (known, rows.stated_variance_m2()) {
        (GnssError::Known(sigma), _) => (sigma.variance_m2(), GnssErrorSource::Profile),
        (GnssError::Unknown, Some(variance_m2)) => (variance_m2, GnssErrorSource::Profile),
        (GnssError::Unknown, None) => {
            (noise.variance_m2.max(LEAST_GNSS_VARIANCE_M2), GnssErrorSource::Estimated)
        }
    }
}

/// The chosen candidate with its held-out residuals, and the reports of all candidates.
struct Chosen {
    candidate: Candidate,
    residuals: Vec<[f64; 2]>,
    /// Held-out group of each row.
    groups: Vec<u32>,
    held_out: HeldOutError,
    /// The candidates that could be fitted, their errors and scores, and the index of the chosen one.
    usable: Vec<&'static Candidate>,
    reports: Vec<CandidateReport>,
    scores: Vec<f64>,
    index: usize,
}

impl Chosen {
    fn selection(&self) -> Selection<'_> {
        let Self { usable, reports, scores, index, .. } = self;
        Selection { candidates: usable, reports, scores, chosen: *index }
    }
}

/// Cross-validates the candidates and chooses one.
fn select(
    samples: &[Sample],
    rows: &TrainingRows,
    context: &FitContext<'_>,
    candidates: &[&'static Candidate],
    run: &mut FitRun<'_>,
) -> Result<Chosen, FitError> {
    let longest = candidates.iter().map(|candidate| candidate.total_epochs(context, true)).max().unwrap_or(1);
    let (groups, count) = rows.held_out_groups(HELD_OUT_BLOCKS);
    let in_blocks: u32 =
        candidates.iter().map(|candidate| count * candidate.total_epochs(context, false)).sum();
    run.progress.epochs = in_blocks + longest;
    note_samples(rows, context, run)?;
    let mut usable = Vec::with_capacity(candidates.len());
    let mut validated = Vec::with_capacity(candidates.len());
    let mut reports = Vec::with_capacity(candidates.len());
    for (at, candidate) in candidates.iter().enumerate() {
        let held_out = match cross_validate(candidate, rows, (&groups, count), context, run) {
            // Another candidate may do with these samples.
            Err(FitError::Unusable(reason)) if at + 1 < candidates.len() || !usable.is_empty() => {
                run.note(&format!("{}: left out, {reason}", candidate.name))?;
                continue;
            }
            held_out => held_out?,
        };
        usable.push(*candidate);
        let report = held_out_error(&held_out, count, context.e_gnss_m2);
        run.note(&format!("{}: {:.3} m from the held-out fixes", candidate.name, report.mean_to_fix_m))?;
        reports.push(CandidateReport { candidate: candidate.name.to_owned(), held_out: report });
        validated.push(held_out);
    }
    let residuals: Vec<&[[f64; 2]]> = validated.iter().map(|it| it.residuals.as_slice()).collect();
    let (chosen, scores) = choose(rows, &residuals);
    note_choice(&usable, chosen, &scores, run)?;
    let error_of = |(row, [east, north]): (&TrainingRow, &[f64; 2])| {
        let Sample { time, target_id, .. } = &samples[row.sample as usize];
        HeldOutSampleError { time: *time, target_id: target_id.clone(), distance_m: east.hypot(*north) }
    };
    let errors: Vec<HeldOutSampleError> = rows.rows.iter().zip(residuals[chosen]).map(error_of).collect();
    run.notify(FitEvent::HeldOut(&errors))?;
    // The final fit may be shorter than the longest candidate's.
    run.progress.epochs = in_blocks + usable[chosen].total_epochs(context, true);
    Ok(Chosen {
        candidate: *usable[chosen],
        residuals: validated.swap_remove(chosen).residuals,
        groups,
        held_out: reports[chosen].held_out.clone(),
        usable,
        reports,
        scores,
        index: chosen,
    })
}

/// The fit of the chosen candidate to all rows.
struct FinalFit<'a> {
    samples: &'a [Sample],
    rows: &'a TrainingRows,
    context: &'a FitContext<'a>,
    options: &'a FitOptions,
    e_gnss_source: GnssErrorSource,
}

impl FinalFit<'_> {
    /// The complete parts of the model, and its error on the held-out rows.
    fn run(
        &self,
        Chosen { candidate, residuals, groups, held_out, .. }: &Chosen,
        geometry: ParameterCovariance,
        run: &mut FitRun<'_>,
    ) -> Result<(ModelParts, HeldOutError), FitError> {
        let Self { samples, rows, context, options, e_gnss_source } = self;
        let rng = ChaCha8Rng::seed_from_u64(options.seed);
        let loss_weights = context.loss_weights;
        let mut phase = Phase { run, name: "final fit".to_owned(), rng, is_final: true, loss_weights };
        let mut fitted = candidate.fit(rows, context, &mut phase)?;
        set_image_size(&mut fitted.parts, options.image_size);
        let mut held_out = held_out.clone();
        match recipes::error_source(fitted.parts.recipe) {
            ErrorSource::Formula => {}
            ErrorSource::LeftOutTargets => {
                calibrate_reconstruction(&mut fitted.parts, &rows.rows)?;
                held_out.e_regression_m2 = mean_variance_m2(&fitted.parts, rows)?;
                held_out.coverage95_of_fixes = coverage_of_fixes(&fitted.parts, rows, residuals)?;
            }
            ErrorSource::HeldOutRows => {
                let geometry = GeometricCovariance::new(geometry, None);
                let validation = HeldOut { rows: &rows.rows, residuals, noise: &context.noise };
                let calibration = calibrate(&mut fitted, geometry, &validation, options.image_size)?;
                held_out.e_regression_m2 = calibration.error_m2;
                widen_radius(&mut fitted.parts, rows, groups, residuals, &context.noise)?;
                if *e_gnss_source == GnssErrorSource::Estimated {
                    fitted.parts.e_gnss_m2 = calibration.receiver_m2.max(LEAST_GNSS_VARIANCE_M2);
                }
                held_out.coverage95_of_fixes = coverage_of_fixes(&fitted.parts, rows, residuals)?;
            }
        }
        let mut parts = fitted.parts;
        parts.set("fix_scatter_m2", context.noise.variance_m2);
        parts.set("fix_white_share", context.noise.correlation.white_share);
        parts.set("fix_time_constant_s", context.noise.correlation.time_constant_s);
        parts.set("labels_smoothed", f64::from(u8::from(candidate.is_smoothed)));
        let regressor = Regressor::build(parts.clone()).map_err(FitError::fault)?;
        estimate_track_noise(samples, &regressor, &parts).put(&mut parts);
        put_scene(samples, &regressor, &mut parts);
        Ok((parts, held_out))
    }
}

fn artifact_of(
    parts: ModelParts,
    FinalFit { samples, rows, context, options, e_gnss_source }: &FinalFit<'_>,
    Chosen { candidate, reports, .. }: Chosen,
    held_out: HeldOutError,
    report: TrainingReport,
) -> Result<Artifact, FitError> {
    let weights = parts.tensors.to_bytes().map_err(FitError::fault)?;
    let origin = parts.plane.origin();
    Ok(Artifact {
        metadata: ModelMetadata {
            format: FORMAT,
            requested_recipe: options.recipe.as_str().to_owned(),
            recipe: parts.recipe.as_str().to_owned(),
            features: parts.features,
            origin: OriginDeg { longitude_deg: origin.longitude_deg(), latitude_deg: origin.latitude_deg() },
            seed: context.seed,
            epochs: candidate.epochs(context),
            training_rows_sha256: sha256_of(samples, context.unpaired, context.known_points),
            samples: rows.rows.len() as u32,
            targets: rows.targets,
            passes: rows.traverses,
            error_scale: parts.error_scale,
            e_gnss_m2: parts.e_gnss_m2,
            e_gnss_source: *e_gnss_source,
            held_out: Some(held_out),
            candidates: reports,
            report: Some(report),
            joint_training: None,
            parameters: parts.parameters,
        },
        weights,
    })
}
