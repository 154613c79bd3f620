//! From samples to an artifact: checks, receiver error, held-out blocks of time, final fit.
//!
//! What never happens here: files, clocks, threads; the caller owns the thread that this runs on,
//! and fills in the time that is left by its own clock.

use std::ops::ControlFlow;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::artifact::{Artifact, FORMAT, Parts};
use super::projection::{self, Form};
use super::projective::Doubt;
use super::regressor::{R95_PER_SIGMA, Regressor};
use super::rows::{Rows, hash_of};
use super::run::{Phase, Run};
use super::select::{self, BLOCKS, Candidate, Common, Way};
use super::train::{LossWeights, TrainError};
use super::uncertainty;
use super::whitening::FixNoise;
use crate::domain::{
    CandidateReport, EpochReport, Error, GnssError, GnssErrorSource, HeldOutError, ImageSize, ModelMetadata,
    OriginDeg, Recipe, RunProgress, Sample,
};

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
    /// Distance in m from the held-out position to the fix, of each sample in the order of target and time,
    /// with the recipe that was chosen.
    HeldOut(&'a [f64]),
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
    Fault(Box<dyn std::error::Error + Send + Sync>),
}

impl From<TrainError> for FitError {
    fn from(error: TrainError) -> Self {
        match error {
            TrainError::Cancelled => Self::Cancelled,
            TrainError::Candle(cause) => Self::Fault(cause.into()),
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
    fit_trial(samples, options, Trial::default(), observer)
}

/// What a trial changes about a fit. Evaluations ask for it; no operator can.
#[derive(Debug, Clone, Copy, Default)]
pub struct Trial<'a> {
    /// Only this one of the recipe's candidates, by the name that its report has.
    pub candidate: Option<&'a str>,
    /// Weights of the loss in place of the recipe's own.
    pub balance: Option<LossWeights>,
}

/// The same with something changed.
///
/// # Errors
/// As [`fit`], and where the recipe has no such candidate.
pub fn fit_trial(
    samples: &[Sample],
    options: &FitOptions,
    trial: Trial<'_>,
    observer: &mut dyn FnMut(FitEvent<'_>) -> ControlFlow<()>,
) -> Result<Artifact, FitError> {
    let rows = Rows::new(samples)?;
    let about = about_geometry(&rows);
    let noise = about.noise;
    let (e_gnss_m2, e_gnss_source) = receiver_variance(&rows, options.gnss_error, &noise);
    let common =
        Common { e_gnss_m2, noise, epochs: options.epochs, seed: options.seed, balance: trial.balance };
    let candidates: Vec<&Candidate> = select::candidates(options.recipe)
        .iter()
        .filter(|candidate| trial.candidate.is_none_or(|only| only == candidate.name))
        .collect();
    if candidates.is_empty() {
        let message = format!("must be one of the candidates of {}", options.recipe);
        return Err(FitError::Fault(Error::invalid("candidate", message).into()));
    }
    let most = candidates.iter().map(|candidate| candidate.all_epochs(&common)).max().unwrap_or(1);
    let held_out = candidates.iter().map(|candidate| BLOCKS * candidate.all_epochs(&common)).sum::<u32>();
    let mut run =
        Run { observer, progress: RunProgress { epochs: held_out + most, ..RunProgress::default() } };
    tell_samples(&rows, &common, &mut run)?;

    let blocks = rows.blocks(BLOCKS);
    let mut residuals = Vec::with_capacity(candidates.len());
    let mut reports = Vec::with_capacity(candidates.len());
    for candidate in &candidates {
        let (misses, claims) = candidate.held_out(&rows, &blocks, &common, &mut run)?;
        let report = held_out_error(&misses, &claims, e_gnss_m2);
        run.note(&format!("{}: {:.3} m from the held-out fixes", candidate.name, report.mean_to_fix_m))?;
        reports.push(CandidateReport { candidate: candidate.name.to_owned(), held_out: report });
        residuals.push(misses);
    }
    let (kept, scores) = select::choose(&rows, &residuals);
    tell_choice(&candidates, kept, &scores, &mut run)?;
    let distances_m: Vec<f64> = residuals[kept].iter().map(|[east, north]| east.hypot(*north)).collect();
    run.tell(|observer, _| observer(FitEvent::HeldOut(&distances_m)))?;

    let candidate = *candidates[kept];
    // The final fit may be shorter than the longest candidate's.
    run.progress.epochs = held_out + candidate.all_epochs(&common);
    let rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut phase =
        Phase { run: &mut run, name: "final fit".to_owned(), rng, is_final: true, balance: common.balance };
    let mut parts = candidate.fit(&rows, &common, &mut phase)?;
    if let Some(size) = options.image_size {
        parts.parameters.insert("image_width_px".to_owned(), f64::from(size.width_px()));
        parts.parameters.insert("image_height_px".to_owned(), f64::from(size.height_px()));
    }
    let mut held_out = reports[kept].held_out.clone();
    if candidate.way != Way::Paper {
        // A network leaves open at least what a geometry does.
        parts.doubt.get_or_insert_with(|| Doubt::of_geometry(about.doubt));
        let calibration = uncertainty::calibrate(&mut parts, &rows, &residuals[kept], &noise)?;
        held_out.e_regression_m2 = calibration.error_m2;
        if e_gnss_source == GnssErrorSource::Estimated {
            parts.e_gnss_m2 = calibration.receiver_m2.max(1e-4);
        }
        held_out.coverage95_of_fixes = coverage_of_fixes(&parts, &rows, &residuals[kept])?;
    }
    run.note(&format!(
        "the regressed position's own error is {:.2} m per axis, the receiver's {:.2} m",
        held_out.e_regression_m2.sqrt(),
        parts.e_gnss_m2.sqrt()
    ))?;
    put_noise(&mut parts, &noise, candidate);
    let summary =
        Summary { requested: options.recipe, common, epochs: candidate.epochs(&common), e_gnss_source };
    artifact_of(parts, &rows, samples, &summary, held_out, reports)
}

/// The richest geometry, for the error of the fixes about it (coloured or white, and how large) and
/// for what they leave open.
fn about_geometry(rows: &Rows) -> projection::Fitted {
    let form = Form { sides: true, extra_sigma: 1.0 };
    projection::fit(&rows.rows, form, &[], &mut projection::same_starts())
}

fn receiver_variance(rows: &Rows, known: GnssError, noise: &FixNoise) -> (f64, GnssErrorSource) {
    match (known, rows.own_variance_m2()) {
        (GnssError::Known(sigma), _) => (sigma.variance_m2(), GnssErrorSource::Profile),
        (GnssError::Unknown, Some(variance_m2)) => (variance_m2, GnssErrorSource::Profile),
        (GnssError::Unknown, None) => (noise.variance_m2.max(1e-4), GnssErrorSource::Estimated),
    }
}

fn tell_samples(rows: &Rows, common: &Common, run: &mut Run<'_>) -> Result<(), FitError> {
    let FixNoise { white_share, time_constant_s, variance_m2 } = common.noise;
    run.note(&format!(
        "{} samples of {} targets in {} passes; the receiver's sigma is {:.2} m per axis",
        rows.rows.len(),
        rows.targets,
        rows.passes,
        common.e_gnss_m2.sqrt()
    ))?;
    let kind = if white_share < 1.0 {
        format!("{:.0} % of it stays for about {time_constant_s:.0} s", 100.0 * (1.0 - white_share))
    } else {
        "new with each fix".to_owned()
    };
    run.note(&format!(
        "about the geometry the fixes scatter by {:.2} m per axis, {kind}; they are worth {:.0} independent ones",
        variance_m2.sqrt(),
        uncertainty::independent_fixes(&rows.rows, &common.noise)
    ))
}

fn tell_choice(
    candidates: &[&Candidate],
    kept: usize,
    scores: &[f64],
    run: &mut Run<'_>,
) -> Result<(), FitError> {
    if candidates.len() == 1 {
        return Ok(());
    }
    let gain = |other: usize| 100.0 * (1.0 - scores[kept] / scores[other]);
    let richest = candidates.len() - 1;
    run.note(&format!(
        "kept {}: its mean squared miss to the held-out fixes, wild ones bounded, is {:.1} % below that of \
         {} and {:.1} % below that of {}",
        candidates[kept].name,
        gain(0),
        candidates[0].name,
        gain(richest),
        candidates[richest].name
    ))
}

fn held_out_error(residuals: &[[f64; 2]], claims: &[f64], e_gnss_m2: f64) -> HeldOutError {
    let count = residuals.len() as f64;
    let (mut distance_m, mut square_m2, mut inside) = (0.0, 0.0, 0.0);
    for ([east, north], claim) in residuals.iter().zip(claims) {
        let miss_m = east.hypot(*north);
        distance_m += miss_m;
        square_m2 += 0.5 * miss_m * miss_m;
        inside += f64::from(u8::from(miss_m <= R95_PER_SIGMA * (claim + e_gnss_m2).sqrt()));
    }
    let error_to_fix_m2 = square_m2 / count;
    HeldOutError {
        blocks: BLOCKS,
        samples: residuals.len() as u32,
        mean_to_fix_m: distance_m / count,
        error_to_fix_m2,
        e_regression_m2: (error_to_fix_m2 - e_gnss_m2).max(0.01 * error_to_fix_m2),
        coverage95_of_fixes: inside / count,
    }
}

/// Share of held-out fixes inside the radius that the calibrated error and the receiver foretell.
fn coverage_of_fixes(parts: &Parts, rows: &Rows, residuals: &[[f64; 2]]) -> Result<f64, FitError> {
    let regressor = Regressor::build(parts.clone()).map_err(|error| FitError::Fault(error.into()))?;
    let inside = rows.rows.iter().zip(residuals).filter(|(row, [east, north])| {
        let answer = regressor.regress(&row.bounding_box, None);
        let regression_m = answer.r95_scale * answer.e_regression_m2.sqrt();
        east.hypot(*north) <= regression_m.hypot(R95_PER_SIGMA * regressor.e_gnss_m2().sqrt())
    });
    Ok(inside.count() as f64 / residuals.len() as f64)
}

fn put_noise(parts: &mut Parts, noise: &FixNoise, candidate: Candidate) {
    for (name, value) in [
        ("fix_scatter_m2", noise.variance_m2),
        ("fix_white_share", noise.white_share),
        ("fix_time_constant_s", noise.time_constant_s),
        ("labels_smoothed", f64::from(u8::from(candidate.smoothed))),
    ] {
        parts.parameters.insert(name.to_owned(), value);
    }
}

struct Summary {
    requested: Recipe,
    common: Common,
    epochs: u32,
    e_gnss_source: GnssErrorSource,
}

fn artifact_of(
    parts: Parts,
    rows: &Rows,
    samples: &[Sample],
    summary: &Summary,
    held_out: HeldOutError,
    candidates: Vec<CandidateReport>,
) -> Result<Artifact, FitError> {
    let weights = parts.tensors.to_bytes().map_err(|cause| FitError::Fault(cause.into()))?;
    let origin = parts.plane.origin();
    Ok(Artifact {
        metadata: ModelMetadata {
            format: FORMAT,
            requested_recipe: summary.requested.as_str().to_owned(),
            recipe: parts.recipe.as_str().to_owned(),
            features: parts.features,
            origin: OriginDeg { longitude_deg: origin.longitude_deg(), latitude_deg: origin.latitude_deg() },
            seed: summary.common.seed,
            epochs: summary.epochs,
            training_rows_sha256: hash_of(samples),
            samples: rows.rows.len() as u32,
            targets: rows.targets,
            passes: rows.passes,
            error_scale: parts.error_scale,
            e_gnss_m2: parts.e_gnss_m2,
            e_gnss_source: summary.e_gnss_source,
            held_out: Some(held_out),
            candidates,
            parameters: parts.parameters,
        },
        weights,
    })
}
