//! Cameras that were moved: their maps have come to disagree with those of the other cameras.
//!
//! From an onset on, each pair of cameras may place targets further apart by a step:
//!
//! ```text
//! d = m(x) + b + v o + 1[t >= onset] s + w
//! ```
//!
//! with the difference m of the maps, what a target keeps b, and the difference o of the clocks (`map_difference.rs`). If
//! camera c was moved by s_c, the steps of its pairs are s_c and those of all others are 0. The evidence for it is twice the
//! logarithm of the likelihood ratio against no step,
//!
//! ```text
//! L_c = h' W^-1 h,   h = sum_p W_p s_p,   W = sum_p W_p      over the pairs p of c, W_p the precision of the step s_p
//! ```
//!
//! and it must exceed that for any other camera: of two cameras that see the same places, without a third one, neither can
//! be told to be the one that was moved.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use nalgebra::{Matrix2, Matrix2xX, Vector2};

use super::comparisons::{CameraPair, Comparisons, LongDifference};
use super::frame::{MovedCamera, WorldTrackId};
use super::map_difference::{Observation, Regressor};
use crate::domain::CameraId;
use crate::geo::EastNorth;

/// The onset is looked for at the start of the n-th latest observation of a camera.
const ONSETS: [usize; 3] = [24, 48, 96];
/// Observations of a pair before the onset at least, and different targets of a camera after it.
const LEAST_BEFORE: usize = 8;
const LEAST_TARGETS: usize = 3;
/// By how much the evidence for a move must exceed that for a move of any other camera. Without a move it reached 5 on recorded
/// people who walk and stand about, with one it was above 100 within 40 s.
const LEAST_LEAD: f64 = 40.0;
/// Least shift, m.
const LEAST_SHIFT_M: f64 = 0.3;

/// The step of a pair of cameras: the first camera's positions beside the second's.
struct Step {
    step: Vector2<f64>,
    precision: Matrix2<f64>,
}

/// The moves of a site's cameras.
#[derive(Debug, Clone, Default)]
pub(super) struct CameraMoves {
    /// The shifts of the cameras whose moves were found, until their maps are others.
    found: BTreeMap<CameraId, EastNorth>,
}

impl CameraMoves {
    /// Looks for a camera that was moved, among those of the pairs whose long difference is new; each is returned once.
    pub(super) fn review(&mut self, comparisons: &Comparisons, new: &[CameraPair]) -> Option<MovedCamera> {
        let candidates: BTreeSet<&CameraId> = new.iter().flat_map(|(one, other)| [one, other]).collect();
        if candidates.is_empty() {
            return None;
        }
        let has_moved =
            |(one, other): &CameraPair| self.found.contains_key(one) || self.found.contains_key(other);
        let known = comparisons.overlaps().iter().filter(|(pair, _)| !has_moved(pair));
        let overlaps: BTreeMap<&CameraPair, &LongDifference> =
            known.filter_map(|(pair, overlap)| Some((pair, overlap.long.as_ref()?))).collect();
        let cameras: BTreeSet<&CameraId> = overlaps.keys().flat_map(|(one, other)| [one, other]).collect();
        let moved = candidates.iter().find_map(|camera| moved_camera(camera, &cameras, &overlaps))?;
        self.found.insert(moved.camera.clone(), moved.shift);
        Some(moved)
    }

    /// The shift of a moved camera's positions, m.
    pub(super) fn shift(&self, camera: &CameraId) -> Option<EastNorth> {
        self.found.get(camera).copied()
    }

    /// Forgets a camera, whose map is another one from now on.
    pub(super) fn forget(&mut self, camera: &CameraId) {
        self.found.remove(camera);
    }
}

fn is_of(pair: &CameraPair, camera: &CameraId) -> bool {
    pair.0 == *camera || pair.1 == *camera
}

fn moved_camera(
    camera: &CameraId,
    cameras: &BTreeSet<&CameraId>,
    overlaps: &BTreeMap<&CameraPair, &LongDifference>,
) -> Option<MovedCamera> {
    let (own, rest): (Vec<_>, Vec<_>) =
        overlaps.iter().map(|(pair, overlap)| (*pair, *overlap)).partition(|(pair, _)| is_of(pair, camera));
    let mut latest: Vec<&Observation> = own.iter().flat_map(|(_, overlap)| &overlap.observations).collect();
    latest.sort_by_key(|observation| std::cmp::Reverse(observation.began));
    ONSETS.iter().find_map(|&count| {
        let onset_at = latest.get(count - 1)?.began;
        let targets: BTreeSet<WorldTrackId> = latest[..count].iter().map(|own| own.track).collect();
        if targets.len() < LEAST_TARGETS {
            return None;
        }
        let steps_of = |(pair, overlap)| Some((pair, step(overlap, onset_at)?));
        let mut steps: Vec<(&CameraPair, Step)> = own.iter().copied().filter_map(steps_of).collect();
        let (statistic, shift) = evidence(camera, &steps)?;
        if statistic < LEAST_LEAD {
            return None;
        }
        steps.extend(rest.iter().copied().filter_map(steps_of));
        let others = cameras.iter().filter(|other| **other != camera);
        let next = others.filter_map(|other| Some(evidence(other, &steps)?.0)).fold(0.0, f64::max);
        let is_certain = statistic - next >= LEAST_LEAD && shift.norm() >= LEAST_SHIFT_M;
        let shift = EastNorth { east_m: shift[0], north_m: shift[1] };
        is_certain.then(|| MovedCamera {
            camera: camera.clone(),
            onset_at,
            shift,
            statistic,
            targets: targets.len(),
        })
    })
}

/// `None` where a pair has too few observations on one side of the onset.
fn step(LongDifference { observations, difference }: &LongDifference, onset_at: Timestamp) -> Option<Step> {
    let is_after = |at: usize| observations[at].began >= onset_at;
    let after = (0..observations.len()).filter(|at| is_after(*at)).count();
    if after == 0 || observations.len() - after < LEAST_BEFORE {
        return None;
    }
    let along = |axis: usize| {
        Matrix2xX::from_fn(observations.len(), |row, at| f64::from(u8::from(row == axis && is_after(at))))
    };
    let mut regressors: Vec<Regressor> = vec![along(0), along(1)];
    regressors.extend(difference.velocity.clone());
    let effects = difference.effects(&regressors)?;
    let covariance: Matrix2<f64> = effects.covariance.fixed_view::<2, 2>(0, 0).into_owned();
    let step = Vector2::new(effects.coefficients[0], effects.coefficients[1]);
    Some(Step { step, precision: covariance.try_inverse()? })
}

/// The evidence that a camera was moved, and by what, m; `None` without a pair of it.
fn evidence(camera: &CameraId, steps: &[(&CameraPair, Step)]) -> Option<(f64, Vector2<f64>)> {
    let (mut precision, mut sum) = (Matrix2::zeros(), Vector2::zeros());
    for ((one, _), own) in steps.iter().filter(|(pair, _)| is_of(pair, camera)) {
        let sign = if one == camera { 1.0 } else { -1.0 };
        precision += own.precision;
        sum += own.precision * own.step * sign;
    }
    let shift = precision.try_inverse()? * sum;
    Some((sum.dot(&shift), shift))
}
