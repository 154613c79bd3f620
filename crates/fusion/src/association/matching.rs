//! Boxes matched with receivers where a model regresses positions.

use rand::Rng;

use super::assignment::posterior;
use super::cancellation::Cancellation;
use super::carriers::{MatchedGroup, MatchedPiece, Matching};
use super::chains::{Chain, ChainSettings, Piece, PieceTable};
use super::companions::View;
use super::company::Company;
use super::cuts;
use super::evidence::EvidenceModel;
use super::groups::{Candidate, Together, groups};
use super::recording::Scene;
use super::tracklet::{SceneMotion, TimedFix, Tracklet};
use crate::domain::{
    ClockOffset, Detection, Error, ErrorKind, GaussMarkovNoise, ReceivedFix, Receivers, Result,
};
use crate::model::Regressor;

/// Step of the search for a receiver's clock offset, s.
const OFFSET_STEP_S: f64 = 0.5;
/// Posterior probabilities below it are not reported.
const LEAST_PROBABILITY: f64 = 0.01;
/// Posterior probability from which on pieces are sure where nothing else is asked for.
const MIN_PROBABILITY: f64 = 0.9;
/// White error per axis that every receiver has at least, m: differences of its fixes are not trusted
/// further.
pub(super) const LEAST_WHITE_SIGMA_M: f64 = 0.5;

/// How tracklets are matched with receivers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchSettings {
    /// Posterior probability from which on a box counts as the receiver's, 0.5 to 1; `None` for 0.9 by a known model, and
    /// 0.8 without one.
    pub min_probability: Option<f64>,
    /// A receiver's clock is off by at most this, s; 0 for clocks that are exact.
    pub clock_window_s: f64,
    /// Error of the receivers; `None` for what the model states, else that of a phone.
    pub gnss: Option<GaussMarkovNoise>,
    /// Evidence and prior probabilities.
    pub chains: ChainSettings,
    /// Size of a recording.
    pub limits: MatchLimits,
}

/// The largest recording that is matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MatchLimits {
    /// Number of tracklets.
    pub tracklets: usize,
    /// Number of receivers.
    pub receivers: usize,
    /// Pairs of a tracklet and a fix during it, for each clock offset that is tried.
    pub comparisons: u64,
}

impl Default for MatchLimits {
    fn default() -> Self {
        Self { tracklets: 20_000, receivers: 200, comparisons: u64::MAX }
    }
}

impl MatchSettings {
    /// # Errors
    /// Names `min_probability` unless it is from 0.5 to 1, and `clock_window_s` unless it is from 0 to 30 s.
    pub fn new(min_probability: Option<f64>, clock_window_s: f64, limits: MatchLimits) -> Result<Self> {
        if min_probability.is_some_and(|given| !(0.5..=1.0).contains(&given)) {
            return Err(Error::invalid("min_probability", "must be a number from 0.5 to 1"));
        }
        if !(0.0..=30.0).contains(&clock_window_s) {
            return Err(Error::invalid("clock_window_s", "must be a number of seconds from 0 to 30"));
        }
        Ok(Self { min_probability, clock_window_s, limits, ..Self::default() })
    }
}

impl Default for MatchSettings {
    fn default() -> Self {
        Self {
            min_probability: None,
            clock_window_s: 0.0,
            gnss: None,
            chains: ChainSettings::default(),
            limits: MatchLimits::default(),
        }
    }
}

/// Receivers' fixes and tracklets in one plane.
pub(super) struct Located<'a> {
    pub(super) tracklets: &'a [Tracklet],
    /// Detections of the points of each tracklet.
    pub(super) detections: &'a [Vec<usize>],
    pub(super) fixes: &'a [Vec<TimedFix>],
    pub(super) gnss: GaussMarkovNoise,
}

/// Matches detections with fixes by the positions that a model regresses.
///
/// # Errors
/// `TooLarge` for more tracklets, receivers or comparisons than the settings allow; `Cancelled`.
pub fn match_with_model(
    detections: &[Detection],
    fixes: &[ReceivedFix],
    receivers: &Receivers,
    regressor: &Regressor,
    settings: &MatchSettings,
    random: &mut impl Rng,
    cancellation: Cancellation<'_>,
) -> Result<Matching> {
    let scene = Scene::new(detections, fixes, receivers, cancellation);
    check_size(&scene, settings)?;
    let gnss = settings.gnss.unwrap_or_else(|| receiver_noise(Some(regressor)));
    match_scene(&scene, regressor, gnss, settings, random)
}

pub(super) fn match_scene(
    scene: &Scene<'_>,
    regressor: &Regressor,
    gnss: GaussMarkovNoise,
    settings: &MatchSettings,
    random: &mut impl Rng,
) -> Result<Matching> {
    let (tracklets, points) = scene.regressed(regressor);
    let located =
        Located { tracklets: &tracklets, detections: &points, fixes: &scene.fixes(regressor.plane()), gnss };
    match_located(scene, &located, settings, random)
}

/// The error of the receivers by a model; without one, that of a phone.
pub(super) fn receiver_noise(regressor: Option<&Regressor>) -> GaussMarkovNoise {
    let noise = regressor.and_then(|regressor| {
        let correlation = regressor.track_noise()?.gnss;
        Some(GaussMarkovNoise { variance_m2: regressor.e_gnss_m2(), correlation })
    });
    noise.unwrap_or(GaussMarkovNoise::PHONE).with_white_at_least(LEAST_WHITE_SIGMA_M * LEAST_WHITE_SIGMA_M)
}

pub(super) fn check_size(scene: &Scene<'_>, settings: &MatchSettings) -> Result<()> {
    let limits = settings.limits;
    let refuse = |what: &str, count: usize, most: usize| {
        let message = format!(
            "there are {count} {what}, at most {most} are matched at once; split the recording by time"
        );
        Err(Error::refused(ErrorKind::TooLarge, message))
    };
    match (scene.tracklets.len(), scene.receiver_ids.len()) {
        (count, _) if count > limits.tracklets => refuse("tracklets", count, limits.tracklets),
        (_, count) if count > limits.receivers => refuse("receivers", count, limits.receivers),
        _ => check_comparisons(scene, settings),
    }
}

fn check_comparisons(scene: &Scene<'_>, settings: &MatchSettings) -> Result<()> {
    let comparisons = scene.comparisons().saturating_mul(passes(settings));
    if comparisons > settings.limits.comparisons {
        let message = format!(
            "there are {comparisons} comparisons of fixes with tracklets, at most {} are made at once \
             (limits.match_comparisons); split the recording by time, or give a smaller clock_window_s",
            settings.limits.comparisons
        );
        return Err(Error::refused(ErrorKind::TooLarge, message));
    }
    Ok(())
}

pub(super) fn match_located(
    scene: &Scene<'_>,
    located: &Located<'_>,
    settings: &MatchSettings,
    random: &mut impl Rng,
) -> Result<Matching> {
    let cancellation = scene.cancellation;
    let model = EvidenceModel { gnss: located.gnss, motion: SceneMotion::of(located.tracklets) };
    let offsets_s = clock_offsets_s(located, &model, settings, cancellation)?;
    let timed: Vec<(&[TimedFix], f64)> =
        located.fixes.iter().map(Vec::as_slice).zip(offsets_s.iter().copied()).collect();
    let posterior =
        piece_posterior(located.tracklets, &timed, &model, &settings.chains, random, cancellation)?;
    let view = View::of(scene.detections);
    let own_probability = |piece: &Piece| {
        let Piece { tracklet, first, end } = *piece;
        view.own_probability(scene.detections, &located.detections[tracklet][first..end])
    };
    let shown = ShownPieces {
        scene,
        located,
        own_probabilities: posterior.pieces.iter().map(own_probability).collect(),
        posterior,
    };
    let min_probability = settings.min_probability.unwrap_or(MIN_PROBABILITY);
    let mut matching = Matching {
        min_probability,
        pieces: shown.matched(),
        groups: shown.groups(min_probability),
        tracklets: located.tracklets.len(),
        receivers: scene.receiver_ids.len(),
        cuts: shown.posterior.pieces.len().saturating_sub(located.tracklets.len()),
        ..Matching::default()
    };
    let found = scene.receiver_ids.iter().zip(offsets_s).filter(|(_, offset_s)| *offset_s != 0.0);
    matching.clock_offsets = found
        .filter_map(|(id, offset_s)| Some((id.clone(), ClockOffset::from_seconds(offset_s).ok()?)))
        .collect();
    Ok(matching)
}

/// Pieces with their posterior probabilities, and what their targets' unseen companions leave of these.
struct ShownPieces<'a> {
    scene: &'a Scene<'a>,
    located: &'a Located<'a>,
    posterior: PiecePosterior,
    /// By piece, the probability that its target, rather than an unseen companion, is the one whose place it shows.
    own_probabilities: Vec<f64>,
}

impl ShownPieces<'_> {
    /// Each piece with its most probable receiver.
    fn matched(&self) -> Vec<MatchedPiece> {
        let owned = self.posterior.owned().zip(&self.own_probabilities);
        let matched = owned.map(|(own, factor)| {
            let Piece { tracklet, first, end } = own.piece;
            let detections = &self.located.detections[tracklet][first..end];
            self.piece(own.piece, detections, own.receiver, factor * own.probability)
        });
        matched.filter(|own| own.probability >= LEAST_PROBABILITY).collect()
    }

    /// The pieces that share a receiver.
    fn groups(&self, min_probability: f64) -> Vec<MatchedGroup> {
        let pieces = &self.posterior.pieces;
        let of_receiver = |receiver: usize| {
            let probable =
                |at: &usize| self.shown(&self.posterior.shares[receiver], *at) >= LEAST_PROBABILITY;
            let known: Vec<usize> = (0..pieces.len()).filter(probable).collect();
            let candidates: Vec<Candidate> = known.iter().map(|at| self.candidate(receiver, *at)).collect();
            let found = groups(&candidates, min_probability).into_iter();
            let member = |(at, probability): &(usize, f64), span_s: [f64; 2]| {
                self.during(pieces[known[*at]], receiver, *probability, span_s)
            };
            let group = |(members, span_s): Together| MatchedGroup {
                members: members.iter().map(|own| member(own, span_s)).collect(),
            };
            found.map(group).collect::<Vec<_>>()
        };
        (0..self.posterior.shares.len()).flat_map(of_receiver).collect()
    }

    /// What its target's unseen companions leave a piece of its probability.
    fn shown(&self, probabilities: &[f64], at: usize) -> f64 {
        self.own_probabilities[at] * probabilities[at]
    }

    fn candidate(&self, receiver: usize, at: usize) -> Candidate {
        let Piece { tracklet, first, end } = self.posterior.pieces[at];
        let points = &self.located.tracklets[tracklet].points;
        Candidate {
            span_s: [points[first].time_s, points[end - 1].time_s],
            posterior: self.shown(&self.posterior.probabilities[receiver], at),
            share: self.shown(&self.posterior.shares[receiver], at),
        }
    }

    /// The part of a piece within an interval, s.
    fn during(
        &self,
        piece: Piece,
        receiver: usize,
        probability: f64,
        [from_s, to_s]: [f64; 2],
    ) -> MatchedPiece {
        let points = self.located.tracklets[piece.tracklet].points.iter();
        let pieces = points.zip(&self.located.detections[piece.tracklet]).take(piece.end).skip(piece.first);
        let within = pieces.filter(|(point, _)| (from_s..=to_s).contains(&point.time_s));
        let detections: Vec<usize> = within.map(|(_, at)| *at).collect();
        self.piece(piece, &detections, receiver, probability)
    }

    fn piece(&self, piece: Piece, detections: &[usize], receiver: usize, probability: f64) -> MatchedPiece {
        MatchedPiece {
            tracker_id: self.scene.tracklets[piece.tracklet].tracker_id.clone(),
            detections: detections.to_vec(),
            receiver_id: self.scene.receiver_ids[receiver].clone(),
            probability,
        }
    }
}

/// The pieces of all tracklets in their order.
pub(super) struct PiecePosterior {
    pub(super) pieces: Vec<Piece>,
    /// By receiver, the probability that its carrier is the target of each piece, before companions share it.
    probabilities: Vec<Vec<f64>>,
    /// The same as companions share it.
    shares: Vec<Vec<f64>>,
}

/// A piece of a tracklet and the receiver, by its index, that its target carries most probably.
pub(super) struct OwnedPiece {
    pub(super) piece: Piece,
    pub(super) receiver: usize,
    pub(super) probability: f64,
}

impl PiecePosterior {
    /// Each piece with its most probable receiver; none without receivers.
    pub(super) fn owned(&self) -> impl Iterator<Item = OwnedPiece> {
        self.pieces.iter().enumerate().filter_map(|(at, piece)| {
            let all = self.shares.iter().map(|own| own[at]).enumerate();
            let (receiver, probability) = all.max_by(|one, other| one.1.total_cmp(&other.1))?;
            Some(OwnedPiece { piece: *piece, receiver, probability })
        })
    }
}

/// The posterior of all pieces. Each receiver has its fixes and the offset of its clock, s.
pub(super) fn piece_posterior(
    tracklets: &[Tracklet],
    receivers: &[(&[TimedFix], f64)],
    model: &EvidenceModel,
    settings: &ChainSettings,
    random: &mut impl Rng,
    cancellation: Cancellation<'_>,
) -> Result<PiecePosterior> {
    let pieces = cuts::pieces(tracklets, receivers, model, settings);
    let table = PieceTable::new(tracklets, pieces, model.motion, settings);
    let chains: Vec<Vec<Chain>> = receivers
        .iter()
        .map(|(fixes, offset_s)| {
            cancellation.check()?;
            Ok(table.chains(fixes, *offset_s, model, settings))
        })
        .collect::<Result<_>>()?;
    let company = Company::new(&table.tracks, settings.max_gap_s);
    let probabilities = posterior(&chains, table.pieces.len(), random, cancellation)?;
    let shared =
        probabilities.iter().zip(receivers).map(|(own, receiver)| company.shared(own, *receiver, model));
    let shares = shared.collect();
    Ok(PiecePosterior { pieces: table.pieces, probabilities, shares })
}

/// The clock offset of each receiver with the largest evidence, over all chains, under a normal prior.
fn clock_offsets_s(
    located: &Located<'_>,
    model: &EvidenceModel,
    settings: &MatchSettings,
    cancellation: Cancellation<'_>,
) -> Result<Vec<f64>> {
    let offsets_s = clock_grid(settings);
    if offsets_s.len() == 1 {
        return Ok(vec![0.0; located.fixes.len()]);
    }
    let whole = |(tracklet, own): (usize, &Tracklet)| Piece { tracklet, first: 0, end: own.points.len() };
    let pieces = located.tracklets.iter().enumerate().map(whole).collect();
    let table = PieceTable::new(located.tracklets, pieces, model.motion, &settings.chains);
    let evidence = |fixes: &[TimedFix], (offset_s, log_prior): (f64, f64)| {
        let chains = table.chains(fixes, offset_s, model, &settings.chains);
        let most = chains.iter().map(|own| own.log_weight).fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = chains.iter().map(|own| (own.log_weight - most).exp()).sum();
        most + sum.ln() + log_prior
    };
    let best = |fixes: &Vec<TimedFix>| {
        let mut best = (0.0, f64::NEG_INFINITY);
        for offset in &offsets_s {
            cancellation.check()?;
            let evidence = evidence(fixes, *offset);
            // Among equals the last.
            if evidence.total_cmp(&best.1).is_ge() {
                best = (offset.0, evidence);
            }
        }
        Ok(best.0)
    };
    located.fixes.iter().map(best).collect()
}

/// The clock offsets that are tried, s, with the logarithms of their prior probabilities: normal, with half of the window as
/// standard deviation.
pub(super) fn clock_grid(settings: &MatchSettings) -> Vec<(f64, f64)> {
    let steps = (settings.clock_window_s / OFFSET_STEP_S).floor() as i32;
    let offsets_s = (-steps..=steps).map(|step| f64::from(step) * OFFSET_STEP_S);
    let sigma_s = 0.5 * settings.clock_window_s.max(OFFSET_STEP_S);
    let weighed: Vec<(f64, f64)> =
        offsets_s.map(|offset_s| (offset_s, -0.5 * (offset_s / sigma_s).powi(2))).collect();
    let log_sum = weighed.iter().map(|(_, log_weight)| log_weight.exp()).sum::<f64>().ln();
    weighed.into_iter().map(|(offset_s, log_weight)| (offset_s, log_weight - log_sum)).collect()
}

/// Passes over all comparisons: one for each clock offset that is tried, and that with the best.
fn passes(settings: &MatchSettings) -> u64 {
    match clock_grid(settings).len() as u64 {
        1 => 1,
        offsets => offsets + 1,
    }
}
