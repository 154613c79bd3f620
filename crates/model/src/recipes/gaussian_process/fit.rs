//! From rows to a model: robust start, hyper-parameters, candidates, weights, calibration.

use super::box_plausibility::BoxPlausibility;
use super::candidate::{Draft, Inducing, MapCandidate, MapForm};
use super::edge_noise::edge_covariance_px2;
use super::groups::{Grouping, groups};
use super::hyperparameters::{Hyperparameters, Priors};
use super::kernel::InputScales;
use super::known_rows::{KnownFoot, KnownRows};
use super::leave_out::{bounded_m2, calibrate, weigh};
use super::map_rows::{Evidence, MapRows, scatter_m2};
use super::noise::{Epoch, ReceiverNoise, ReceiverWhitener};
use super::predictor::{PositionMap, Predictor, Stated};
use super::projective_mean::{Box4, ProjectiveMean};
use super::sessions::SessionBiases;
use super::upright_camera::UprightCamera;
use crate::domain::GaussMarkovNoise;
use crate::samples::rows::SESSION_GAP_S;
use crate::statistics::median;

/// Rows that a fit uses at most; more are thinned evenly.
const MAX_ROWS: usize = 20_000;
/// A candidate of less weight is left out of the mixture.
const MIN_WEIGHT: f64 = 0.02;
/// Standard deviation of a bias that all receivers share, as a share of that of the coloured part of their
/// error: no training sample can show it, so it is a prior.
pub(crate) const SHARED_BIAS_SHARE: f64 = 0.1;
/// Degrees of freedom that the prior of the slow part is worth: a logarithm with a standard deviation of 0.5
/// has about the tails of an inverse chi-square with four.
const PRIOR_FREEDOM: f64 = 4.0;
/// Coefficients of a homography per axis, which as many independent fixes determine.
const MAP_COEFFICIENTS: f64 = 4.0;
/// The least inverse degrees of freedom, those of the normal distribution.
const MIN_INVERSE_FREEDOM: f64 = 1e-6;
/// Share by which the miss to the own rows may exceed that to left-out ones, and standard errors of the mean square of
/// independent fixes beside it.
const OWN_MISS_TOLERANCE: f64 = 0.05;
const OWN_MISS_ERRORS: f64 = 2.0;
/// Least variance of the fixes about the homography, m2.
const MIN_SCATTER_M2: f64 = 1e-6;

/// The findings of a fit, for people.
#[derive(Debug, Clone)]
pub(crate) struct FitReport {
    pub(crate) parameters: Hyperparameters,
    /// The receivers' noise as estimated, before its white part was raised.
    pub(crate) receiver: ReceiverNoise,
    /// Rows left out as gross errors.
    pub(crate) gross_errors: usize,
    /// Groups left out in turn.
    pub(crate) groups: usize,
    /// Per candidate: name, weight, and mean squared miss per axis to left-out fixes, m2.
    pub(crate) candidates: Vec<(&'static str, f64, f64)>,
    /// How far the map is from each known point, and the standard deviation of that, m.
    pub(crate) known_m: Vec<(f64, f64)>,
    /// Factor on the map's variance by left-out targets.
    pub(crate) widening: f64,
    /// How sessions differ, if there are several.
    pub(crate) sessions: Option<SessionBiases>,
    /// Share of the jackknife's variance that is added, per candidate.
    pub(crate) jackknife_shares: Vec<f64>,
    /// Degrees of freedom of the radius.
    pub(crate) freedom: f64,
    /// Mean squared miss per axis of the solution to the fixes that it was fitted to, bounded as those to left-out ones, m2.
    pub(crate) own_m2: f64,
    /// Error of the mixture: mean squared miss per axis to left-out fixes, m2, and the share of these inside
    /// the radius that map and receiver state together.
    pub(crate) held_out_m2: f64,
    pub(crate) held_out_coverage: f64,
}

/// The settings of a fit besides the rows.
#[derive(Debug, Clone)]
pub(crate) struct FitSettings {
    /// Standard deviation per axis of the bias that all fixes have in common, which no training row can show,
    /// m; `None` for a share of the coloured part of the receivers' error.
    pub(crate) bias_sigma_m: Option<f64>,
    /// White share of the variance of the fixes about a geometric map.
    pub(crate) white_share: f64,
    /// Error variance per axis of the receivers, m2, where it is known.
    pub(crate) receiver_m2: Option<f64>,
    /// Seed of the bootstrap that weighs the candidates.
    pub(crate) seed: u64,
    /// Geometry by the heights of boxes, if the image size is known.
    pub(crate) upright: Option<UprightCamera>,
    /// Points of the ground whose place is known.
    pub(crate) known: Vec<KnownFoot>,
}

/// Fits a model; `None` where the rows determine nothing (not finite, or all alike).
pub(crate) fn fit(all: &MapRows, settings: &FitSettings) -> Option<(Predictor, FitReport)> {
    let thinned = all.thinned(MAX_ROWS);
    let mut mean = ProjectiveMean::of_rows(&thinned.boxes, &thinned.labels_m);
    let known = KnownRows::new(&settings.known, &thinned);
    let start = known.beside(&thinned);
    mean.fit_foot(&start.boxes, &start.labels_m);
    mean.coefficients.iter().all(|value| value.is_finite()).then_some(())?;
    let rows = thinned.without_gross_errors(&mean);
    let input_scales = InputScales::of_rows(&rows.boxes);
    let inputs: Vec<[f64; 4]> = rows.boxes.iter().map(|sides| input_scales.input(sides)).collect();
    let grouping = groups(&rows.epochs);
    let edge_px2 = edge_covariance_px2(&all.epochs, &all.boxes);
    let known = known.with_inputs(&input_scales);
    let bias = BiasPrior::new(&rows.epochs, settings.bias_sigma_m, !known.is_empty());
    let evidence = Evidence { rows: &rows, inputs: &inputs };
    let Solutions { parameters, receiver, candidates } =
        solve(evidence, &known, mean, &edge_px2, settings, &bias, &grouping)?;

    let (weights, misses_m2) = weigh(&candidates, &grouping, &rows, &parameters.noise, settings.seed);
    let kept = without_negligible(&weights);
    let jackknives: Vec<_> = candidates.iter().map(MapCandidate::jackknife).collect();
    let maps = candidates
        .iter()
        .zip(&jackknives)
        .zip(&kept)
        .filter(|(_, weight)| **weight > 0.0)
        .map(|((candidate, (_, deviations)), weight)| PositionMap::new(candidate, deviations, *weight))
        .collect::<Option<Vec<PositionMap>>>()?;
    let freedom = degrees_of_freedom(&rows.epochs, &parameters.noise, &bias);
    let stated = Stated {
        edge_px2,
        shared_bias_m2: bias.shared_m2(&receiver),
        freedom,
        plausibility: BoxPlausibility::fit(&rows.epochs, &rows.boxes),
    };
    let mut predictor = Predictor::new(maps, input_scales, stated);
    let extra_m2 = |row: usize| predictor.jackknife_m2(&rows.boxes[row]);
    let calibration = calibrate(&candidates, &kept, &grouping, &rows, &parameters.noise, &extra_m2);
    // Known points show a receiver's bias in all parts of its session alike, so these parts are one value of it, not several.
    let is_judged = known.is_empty() || !cuts_sessions(&grouping, &rows.epochs);
    predictor.widening = if is_judged { calibration.widening } else { 1.0 };
    let residuals_m: Vec<[f64; 2]> =
        (0..rows.boxes.len()).map(|row| mixed_residual(&candidates, &kept, row)).collect();
    let receiver_m2 = parameters.noise.variance_m2();
    // Rows that a fit has seen are missed by less than those that it has not: else it is no solution.
    let own_m2 = own_miss_m2(&predictor, &rows, receiver_m2);
    let by_chance = OWN_MISS_ERRORS / independent_fixes(&rows.epochs, &parameters.noise).sqrt();
    (own_m2 <= (1.0 + OWN_MISS_TOLERANCE + by_chance) * calibration.miss_m2).then_some(())?;
    let of_candidate = |((candidate, weight), miss_m2): ((&MapCandidate, &f64), &f64)| {
        (candidate.form.as_str(), *weight, *miss_m2)
    };
    let report = FitReport {
        parameters,
        receiver,
        gross_errors: thinned.boxes.len() - rows.boxes.len(),
        groups: grouping.members().len(),
        candidates: candidates.iter().zip(&weights).zip(&misses_m2).map(of_candidate).collect(),
        known_m: known_misses_m(&predictor, &known),
        widening: predictor.widening,
        sessions: SessionBiases::new(&rows.epochs, &residuals_m, &parameters.noise),
        jackknife_shares: jackknives.iter().map(|(share, _)| *share).collect(),
        freedom,
        own_m2: residuals_m.iter().map(|own_m| bounded_m2(*own_m, receiver_m2)).sum::<f64>()
            / residuals_m.len() as f64,
        held_out_m2: calibration.miss_m2,
        held_out_coverage: calibration.coverage,
    };
    Some((predictor, report))
}

/// The candidates under common hyper-parameters.
struct Solutions {
    parameters: Hyperparameters,
    /// The noise before its white part was raised.
    receiver: ReceiverNoise,
    candidates: Vec<MapCandidate>,
}

/// Estimates the hyper-parameters and solves every form of the map.
fn solve(
    Evidence { rows, inputs }: Evidence<'_>,
    known: &KnownRows,
    mean: ProjectiveMean,
    edge_px2: &[f64; 16],
    settings: &FitSettings,
    bias: &BiasPrior,
    grouping: &Grouping,
) -> Option<Solutions> {
    let residuals_m = rows.misses_m(&mean);
    let scatter_m2 = scatter_m2(&residuals_m).max(MIN_SCATTER_M2);
    let white =
        ReceiverWhitener::new(&rows.epochs, &ReceiverNoise::white(scatter_m2), &vec![0.0; rows.boxes.len()]);
    let inflation_m2 = white.inflation_m2(&residuals_m);
    let inducing = Inducing::new(inputs);
    let mut residual = Draft {
        form: MapForm::Residual,
        rows,
        inputs,
        inducing: &inducing,
        edge_px2,
        known_inflation_m2: known.first_inflation_m2(&mean, scatter_m2),
        mean,
        inflation_m2,
        known,
        upright: None,
    };
    let mut homography = Draft { form: MapForm::Homography, ..residual.clone() };
    let spread_m = residual.mean.spread_m;
    let mut priors = priors(rows, scatter_m2, spread_m, settings);
    if let BiasPrior::OfSession { sigma_m } = bias {
        priors = priors.with_session(*sigma_m);
    }
    let (parameters, receiver) = residual.estimate(&priors)?;
    homography.relinearize(&parameters)?;
    let upright =
        settings.upright.as_ref().and_then(|camera| homography.clone().into_upright(camera, &parameters));
    let mut candidates = vec![homography.solve(&parameters, grouping)?];
    candidates.extend(upright.and_then(|draft| draft.solve(&parameters, grouping)));
    candidates.push(residual.solve(&parameters, grouping)?);
    Some(Solutions { parameters, receiver, candidates })
}

/// The priors of the noise. The rows of a short walk are few independent fixes, which a map follows, so they scatter about
/// it by less than their error: the error of a phone, or the one that is stated, counts for [`PRIOR_FREEDOM`] fixes beside
/// those that are left of the map's coefficients.
fn priors(rows: &MapRows, scatter_m2: f64, spread_m: f64, settings: &FitSettings) -> Priors {
    let FitSettings { white_share, receiver_m2, .. } = *settings;
    let phone = GaussMarkovNoise::PHONE;
    let known_m2 = receiver_m2.unwrap_or(phone.variance_m2);
    let interval_s = interval_s(&rows.epochs);
    if scatter_m2 >= known_m2 {
        return Priors::new(scatter_m2.sqrt(), white_share, spread_m, interval_s);
    }
    let left = independent_fixes(&rows.epochs, &ReceiverNoise::of_gauss_markov(&phone)) - MAP_COEFFICIENTS;
    let known = PRIOR_FREEDOM / (PRIOR_FREEDOM + left.max(0.0));
    let blend = |own: f64, of_phones: f64| (1.0 - known) * own + known * of_phones;
    let scatter_m = blend(scatter_m2, known_m2).sqrt();
    let white_share = blend(white_share, phone.correlation.white_share);
    Priors::new(scatter_m, white_share, spread_m, interval_s).with_receiver(known_m2.sqrt(), known)
}

/// Fixes that would tell a mean as well if their errors were independent.
fn independent_fixes(epochs: &[Epoch], noise: &ReceiverNoise) -> f64 {
    noise.variance_m2() * information(epochs, noise)
}

/// Inverse variance of a mean of fixes, per m2.
fn information(epochs: &[Epoch], noise: &ReceiverNoise) -> f64 {
    let mut ones = vec![1.0; epochs.len()];
    ReceiverWhitener::new(epochs, noise, &vec![0.0; epochs.len()]).apply(&mut ones);
    ones.iter().map(|one| one * one).sum()
}

/// Weights that add up to 1, without the negligible ones.
fn without_negligible(weights: &[f64]) -> Vec<f64> {
    let kept = weights.iter().map(|weight| if *weight < MIN_WEIGHT { 0.0 } else { *weight });
    let sum: f64 = kept.clone().sum();
    kept.map(|weight| weight / sum).collect()
}

/// Mean squared miss per axis of a model's answers to the fixes of some rows, bounded, m2.
pub(super) fn own_miss_m2(predictor: &Predictor, rows: &MapRows, receiver_m2: f64) -> f64 {
    let square_m2 = |(sides, label_m): (&Box4, &[f64; 2])| {
        let [east_m, north_m] = predictor.mix(sides, false).position_m;
        bounded_m2([label_m[0] - east_m, label_m[1] - north_m], receiver_m2)
    };
    let sum_m2: f64 = rows.boxes.iter().zip(&rows.labels_m).map(square_m2).sum();
    sum_m2 / rows.boxes.len() as f64
}

/// How far a model's answers are from each known point, and the standard deviation of that, m.
fn known_misses_m(predictor: &Predictor, known: &KnownRows) -> Vec<(f64, f64)> {
    let of_point = |((sides, label_m), own_m2): ((&Box4, &[f64; 2]), f64)| {
        let answer = predictor.mix(sides, true);
        let [east_m, north_m] = answer.position_m;
        let [east_m2, _, north_m2] = answer.map_m2;
        let apart_m = (label_m[0] - east_m).hypot(label_m[1] - north_m);
        (apart_m, (0.5 * (east_m2 + north_m2) + own_m2).sqrt())
    };
    known.rows.boxes.iter().zip(&known.rows.labels_m).zip(known.variances_m2()).map(of_point).collect()
}

fn mixed_residual(candidates: &[MapCandidate], weights: &[f64], row: usize) -> [f64; 2] {
    let mut sum_m = [0.0; 2];
    for (candidate, weight) in candidates.iter().zip(weights).filter(|(_, weight)| **weight > 0.0) {
        let own_m = candidate.residual(&candidate.posterior, row).0;
        sum_m = [sum_m[0] + weight * own_m[0], sum_m[1] + weight * own_m[1]];
    }
    sum_m
}

/// The knowledge of the bias that all fixes have in common, which is part of every answer's error whatever
/// the number of rows.
#[derive(Debug, Clone, Copy, PartialEq)]
enum BiasPrior {
    /// Nothing: a share of the coloured part of the receivers' error.
    Unknown,
    /// Nothing, but known points show that of every receiver.
    Shown,
    /// That of several receivers or sessions, m per axis: it is added to the error of the map.
    Common { sigma_m: f64 },
    /// That of a receiver in its session, m per axis: it replaces the prior of the slow part.
    OfSession { sigma_m: f64 },
}

impl BiasPrior {
    fn new(epochs: &[Epoch], stated_sigma_m: Option<f64>, has_known_points: bool) -> Self {
        let is_of_session = has_known_points || sessions_of_receivers(epochs).count() == 1;
        match stated_sigma_m {
            Some(sigma_m) if is_of_session => Self::OfSession { sigma_m },
            Some(sigma_m) => Self::Common { sigma_m },
            None if has_known_points => Self::Shown,
            None => Self::Unknown,
        }
    }

    /// Variance per axis of what all receivers have in common, m2.
    fn shared_m2(&self, receiver: &ReceiverNoise) -> f64 {
        match self {
            Self::Unknown => SHARED_BIAS_SHARE.powi(2) * (receiver.short_m2 + receiver.session_m2),
            Self::Common { sigma_m } => sigma_m * sigma_m,
            Self::Shown | Self::OfSession { .. } => 0.0,
        }
    }
}

/// Rows of each receiver in each of its sessions.
fn sessions_of_receivers(epochs: &[Epoch]) -> impl Iterator<Item = &[Epoch]> {
    epochs.chunk_by(|one, next| one.sequence == next.sequence && next.time_s - one.time_s <= SESSION_GAP_S)
}

/// True if some rows of a receiver's session are left out together without the others.
fn cuts_sessions(grouping: &Grouping, epochs: &[Epoch]) -> bool {
    let mut from = 0;
    sessions_of_receivers(epochs).any(|session| {
        let rows = from..from + session.len();
        from = rows.end;
        grouping.cuts(rows)
    })
}

/// Median interval between neighbouring rows of a receiver, s; 0 where there are none.
fn interval_s(epochs: &[Epoch]) -> f64 {
    let neighbours = epochs.windows(2).filter(|pair| pair[0].sequence == pair[1].sequence);
    let intervals_s: Vec<f64> = neighbours.map(|pair| pair[1].time_s - pair[0].time_s).collect();
    if intervals_s.is_empty() { 0.0 } else { median(intervals_s) }
}

/// Number of independent values that the slow process has taken: one per receiver and session, and one more
/// per two time constants of the session's length.
fn independent_biases(epochs: &[Epoch], noise: &ReceiverNoise) -> f64 {
    let of_session = |session: &[Epoch]| {
        let length_s = session.last().map_or(0.0, |last| last.time_s) - session[0].time_s;
        1.0 + 0.5 * length_s / noise.session_time_s
    };
    sessions_of_receivers(epochs).map(of_session).sum()
}

/// Degrees of freedom of the stated variance, by Welch and Satterthwaite: what differs between receivers and
/// sessions has those of its prior and two per independent bias beyond the first, what differs within them
/// two per independent fix. A bias that is stated, or that known points show, is known, not estimated.
fn degrees_of_freedom(epochs: &[Epoch], noise: &ReceiverNoise, bias: &BiasPrior) -> f64 {
    let within = ReceiverNoise { session_m2: 0.0, ..*noise };
    let (of_all, of_within) = (information(epochs, noise), information(epochs, &within));
    let between_share = (1.0 - of_all / of_within).clamp(0.0, 1.0);
    let between = match bias {
        BiasPrior::Shown | BiasPrior::OfSession { .. } => f64::INFINITY,
        _ => PRIOR_FREEDOM + 2.0 * (independent_biases(epochs, noise) - 1.0),
    };
    let within = 2.0 * (within.variance_m2() * of_within - 1.0).max(2.0);
    1.0 / (between_share.powi(2) / between + (1.0 - between_share).powi(2) / within).max(MIN_INVERSE_FREEDOM)
}
