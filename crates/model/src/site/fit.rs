//! The fit of a site: robust starts per camera, then all cameras together.

use std::ops::ControlFlow;

use nalgebra::Vector2;

use super::ground_map::GroundMap;
use super::input::{FEWEST_ROWS, SiteFitError, SiteFitInput, SiteFix, SitePair, foot_and_size, is_foot_cut};
use super::least_squares::{FixRow, LeastSquaresProblem, Transfer};
use super::maps::SiteMaps;
use crate::domain::{GaussMarkovNoise, NoiseCorrelation};
use crate::recipes::gaussian_process::projective_mean::Box4;
use crate::recipes::gaussian_process::{FootPrior, UprightGeometry, UprightStarts};
use crate::statistics::median;

/// Standard deviation per axis of the fixes and of the feet before they are estimated, m and px.
const FIRST_SIGMA_M: f64 = 3.0;
const FIRST_FOOT_SIGMA_PX: f64 = 4.0;
/// Ranges of the estimates.
const SIGMA_RANGE_M: [f64; 2] = [0.02, 100.0];
const FOOT_SIGMA_RANGE_PX: [f64; 2] = [0.5, 50.0];
/// White shares of the receivers' variance that are compared.
const WHITE_SHARES: [f64; 8] = [0.02, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8];
/// Steps of the search for a standard deviation: to 0.1 %.
const SECTIONS: usize = 20;
/// Groups of receivers that starts leave out in turn.
const START_GROUPS: usize = 8;
/// Rounds of solution and noise estimate.
const ROUNDS: usize = 3;
/// The same where a prior on the heights of boxes is linearised again in each.
const UPRIGHT_ROUNDS: usize = 6;
/// Fixes of all receivers and of one, and transfers between all cameras and between two: more are thinned evenly.
const MAX_ROWS: usize = 20_000;
const MAX_RECEIVER_ROWS: usize = 300;
const LEAST_RECEIVER_ROWS: usize = 10;
const MAX_TRANSFERS: usize = 60_000;
const MAX_PAIR_TRANSFERS: usize = 4_000;
/// Between two boxes of which the noise of a detector is independent, s, and the largest lag at which a target is near
/// the place where it was.
const LASTING_LAG_S: [f64; 2] = [2.0, 6.0];
/// Largest difference of two feet that counts, in standard deviations.
const LARGEST_DIFFERENCE: f64 = 4.0;
/// Largest share of the feet's variance that lasts.
const MOST_LASTING: f64 = 0.9;
/// Median of a chi-square variable with 2 degrees of freedom: 2 ln 2.
const MEDIAN_CHI_SQUARE: f64 = 1.386;

/// Fits the maps of all cameras of a site together.
///
/// # Errors
/// A camera has too few rows, or there is no finite solution.
pub fn fit_site(input: &SiteFitInput<'_>) -> Result<SiteMaps, SiteFitError> {
    fit_site_observed(input, &[], &mut || ControlFlow::Continue(()))
}

/// The same under an observer that is asked before each step, and ends the fit by a break. `upright` are the cameras that
/// the heights of boxes allow, by camera, if these are to have a say.
///
/// # Errors
/// As [`fit_site`], and [`SiteFitError::Cancelled`].
pub(crate) fn fit_site_observed(
    input: &SiteFitInput<'_>,
    upright: &[Option<UprightStarts>],
    observer: &mut dyn FnMut() -> ControlFlow<()>,
) -> Result<SiteMaps, SiteFitError> {
    let receivers = receiver_rows(input);
    let transfers = transfers(input);
    let mut maps = initial_maps(input.image_sizes.len(), &receivers, &transfers)?;
    let mut geometries = upright_geometries(upright, &receivers, &mut maps);
    let noise = GaussMarkovNoise::new(FIRST_SIGMA_M, input.correlation);
    let mut problem = LeastSquaresProblem::new(
        receivers,
        transfers,
        input.known_points.to_vec(),
        noise,
        FIRST_FOOT_SIGMA_PX,
    );
    problem.foot_priors = foot_priors(&mut geometries, &maps);
    let mut covariance = problem.solve(&mut maps, observer)?;
    let rounds = if geometries.iter().any(Option::is_some) { UPRIGHT_ROUNDS } else { ROUNDS };
    for _ in 1..rounds {
        problem.estimate_noise(&maps);
        problem.foot_priors = foot_priors(&mut geometries, &maps);
        covariance = problem.solve(&mut maps, observer)?;
    }
    let foot_lasting_share = lasting_share(input, &maps, problem.foot_sigma_px);
    let views_px = (0..maps.len()).map(|camera| view_px(&problem, camera)).collect();
    Ok(SiteMaps {
        maps,
        covariance,
        foot_sigma_px: problem.foot_sigma_px,
        foot_lasting_share,
        noise: problem.noise(),
        image_sizes: input.image_sizes.to_vec(),
        views_px,
    })
}

impl LeastSquaresProblem {
    /// Estimates the variance of the feet from the median of the transfers, then the receivers' noise, variance and white
    /// share, by the likelihood of the fixes' residuals.
    fn estimate_noise(&mut self, maps: &[GroundMap]) {
        let distances = self.transfer_distances(maps);
        if distances.len() >= FEWEST_ROWS {
            let sigma_px = (median(distances) / MEDIAN_CHI_SQUARE).sqrt();
            self.foot_sigma_px = sigma_px.clamp(FOOT_SIGMA_RANGE_PX[0], FOOT_SIGMA_RANGE_PX[1]);
        }
        self.set_foot_noise(maps);
        let count: usize = self.receivers.iter().map(|rows| 2 * rows.len()).sum();
        let freedom = count as f64 - 8.0 * maps.len() as f64;
        if freedom <= 0.0 {
            return;
        }
        let residuals = self.residuals_m(maps);
        let GaussMarkovNoise { correlation, .. } = self.noise();
        let noise_of = |white_share: f64| {
            let correlation = NoiseCorrelation { white_share, ..correlation };
            let of_log = |log_sigma: f64| GaussMarkovNoise::new(log_sigma.exp(), correlation);
            let log_sigma = least_argument(SIGMA_RANGE_M.map(f64::ln), |log_sigma| {
                self.noise_misfit(&residuals, &of_log(log_sigma))
            });
            (self.noise_misfit(&residuals, &of_log(log_sigma)), of_log(log_sigma))
        };
        let candidates = WHITE_SHARES.map(noise_of).into_iter();
        if let Some((_, mut noise)) = candidates.min_by(|one, other| one.0.total_cmp(&other.0)) {
            // The maps follow a part of the errors.
            noise.variance_m2 *= count as f64 / freedom;
            self.set_noise(noise);
        }
    }
}

/// The argument of the least value of a function that falls, then rises, by golden sections.
fn least_argument([mut low, mut high]: [f64; 2], value: impl Fn(f64) -> f64) -> f64 {
    let section = 0.5 * (5.0_f64.sqrt() - 1.0);
    let mut inner = [high - section * (high - low), low + section * (high - low)];
    let mut values = inner.map(&value);
    for _ in 0..SECTIONS {
        if values[0] <= values[1] {
            high = inner[1];
            inner = [high - section * (high - low), inner[0]];
            values = [value(inner[0]), values[0]];
        } else {
            low = inner[0];
            inner = [inner[1], low + section * (high - low)];
            values = [values[1], value(inner[1])];
        }
    }
    0.5 * (low + high)
}

/// Share of the feet's variance that lasts: the autocovariance of the differences between two cameras over the lags of
/// [`LASTING_LAG_S`], by their mean square, with every difference limited to [`LARGEST_DIFFERENCE`]. A homography that is
/// not quite the camera's, and a box whose foot is not below its target, differ for as long as the target is
/// near a place.
fn lasting_share(input: &SiteFitInput<'_>, maps: &[GroundMap], foot_sigma_px: f64) -> f64 {
    let mut pairs: Vec<&SitePair> = input.pairs.iter().filter(|pair| !is_cut(pair, input)).collect();
    pairs.sort_by(|one, other| {
        let key = |pair: &SitePair| (pair.cameras, pair.target);
        key(one).cmp(&key(other)).then(one.time_s.total_cmp(&other.time_s))
    });
    let (mut product, mut square, mut count) = (0.0, 0.0, 0);
    for own in pairs.chunk_by(|one, next| (one.cameras, one.target) == (next.cameras, next.target)) {
        let differences: Vec<(f64, Vector2<f64>)> = own
            .iter()
            .filter_map(|pair| {
                let transfer =
                    Transfer { cameras: pair.cameras, feet: pair.boxes.map(|it| foot_and_size(&it)) };
                let difference = transfer.difference(maps)? / foot_sigma_px;
                Some((pair.time_s, difference * (LARGEST_DIFFERENCE / difference.norm()).min(1.0)))
            })
            .collect();
        for (at, (time_s, difference)) in differences.iter().enumerate() {
            let [least_s, greatest_s] = LASTING_LAG_S;
            let later = differences[at..].partition_point(|(later_s, _)| later_s - time_s < least_s);
            let Some((later_s, later)) = differences.get(at + later) else { continue };
            if later_s - time_s <= greatest_s {
                product += difference.dot(later);
                square += 0.5 * (difference.norm_squared() + later.norm_squared());
                count += 1;
            }
        }
    }
    if count < FEWEST_ROWS || square <= 0.0 { 0.0 } else { (product / square).clamp(0.0, MOST_LASTING) }
}

/// The fixes by receiver, without cut boxes.
fn receiver_rows(input: &SiteFitInput<'_>) -> Vec<Vec<FixRow>> {
    let mut fixes: Vec<&SiteFix> = input.fixes.iter().collect();
    fixes.sort_by(|one, other| {
        (one.receiver, one.time_s)
            .partial_cmp(&(other.receiver, other.time_s))
            .unwrap_or(std::cmp::Ordering::Equal)
    });
    let row = |fix: &&SiteFix| {
        let whole = fix
            .boxes
            .iter()
            .filter(|(camera, bounding_box)| !is_foot_cut(bounding_box, input.image_sizes[*camera]));
        let feet: Vec<(usize, Box4)> = whole.map(|(camera, it)| (*camera, foot_and_size(it))).collect();
        let position = [fix.position.east_m, fix.position.north_m];
        (!feet.is_empty()).then_some(FixRow { time_s: fix.time_s, position, feet })
    };
    let receivers = fixes.chunk_by(|one, next| one.receiver == next.receiver).count();
    let most = (MAX_ROWS / receivers.max(1)).clamp(LEAST_RECEIVER_ROWS, MAX_RECEIVER_ROWS);
    let of_receiver = |own: &[&SiteFix]| thinned(own.iter().filter_map(row).collect(), most);
    let all = fixes.chunk_by(|one, next| one.receiver == next.receiver).map(of_receiver);
    all.filter(|rows| !rows.is_empty()).collect()
}

/// True if the border of an image hides the foot of either box.
fn is_cut(pair: &SitePair, input: &SiteFitInput<'_>) -> bool {
    [0, 1].into_iter().any(|at| is_foot_cut(&pair.boxes[at], input.image_sizes[pair.cameras[at]]))
}

/// Every pair in both directions, without cut boxes.
fn transfers(input: &SiteFitInput<'_>) -> Vec<Transfer> {
    let mut both_ways = Vec::with_capacity(2 * input.pairs.len());
    for pair in input.pairs {
        let [from, to] = pair.cameras;
        if from == to || is_cut(pair, input) {
            continue;
        }
        let feet = pair.boxes.map(|it| foot_and_size(&it));
        both_ways.push(Transfer { cameras: [from, to], feet });
        both_ways.push(Transfer { cameras: [to, from], feet: [feet[1], feet[0]] });
    }
    both_ways.sort_by_key(|transfer| transfer.cameras);
    let ways = both_ways.chunk_by(|one, next| one.cameras == next.cameras);
    let most = (MAX_TRANSFERS / ways.clone().count().max(1)).min(MAX_PAIR_TRANSFERS);
    ways.flat_map(|own| thinned(own.to_vec(), most)).collect()
}

fn thinned<T>(rows: Vec<T>, most: usize) -> Vec<T> {
    let stride = rows.len().div_ceil(most).max(1);
    rows.into_iter().step_by(stride).collect()
}

/// The geometries by the heights of boxes; the maps of those cameras begin there.
fn upright_geometries(
    upright: &[Option<UprightStarts>],
    receivers: &[Vec<FixRow>],
    maps: &mut [GroundMap],
) -> Vec<Option<UprightGeometry>> {
    let of_camera = |(camera, map): (usize, &mut GroundMap)| {
        let starts = upright.get(camera)?.as_ref()?;
        let rows = receivers.iter().flatten();
        let own = rows.flat_map(|row| row.feet.iter().map(move |foot| (foot, row.position)));
        let own = own.filter(|((at, _), _)| *at == camera).map(|((_, foot), position)| (*foot, position));
        let (feet, positions): (Vec<Box4>, Vec<[f64; 2]>) = own.unzip();
        let (geometry, placed) = UprightGeometry::new(starts, &map.0, (&feet, &positions))?;
        map.0 = placed;
        Some(geometry)
    };
    maps.iter_mut().enumerate().map(of_camera).collect()
}

/// Priors from the boxes' heights, linearised at the maps. A camera without such a prior is fitted without it.
fn foot_priors(geometries: &mut [Option<UprightGeometry>], maps: &[GroundMap]) -> Vec<Option<FootPrior>> {
    let of_camera = |(geometry, map): (&mut Option<UprightGeometry>, &GroundMap)| {
        let prior = geometry.as_mut()?.prior_at(&map.0);
        if prior.is_none() {
            *geometry = None;
        }
        prior
    };
    geometries.iter_mut().zip(maps).map(of_camera).collect()
}

/// Robust starts: from fixes where a camera has enough, else from targets in common with cameras that have a
/// map.
fn initial_maps(
    cameras: usize,
    receivers: &[Vec<FixRow>],
    transfers: &[Transfer],
) -> Result<Vec<GroundMap>, SiteFitError> {
    let mut maps: Vec<Option<GroundMap>> = (0..cameras)
        .map(|camera| {
            let of_receiver = |rows: &Vec<FixRow>| -> Vec<(Box4, [f64; 2])> {
                let feet = rows.iter().flat_map(|row| row.feet.iter().map(move |foot| (foot, row.position)));
                feet.filter(|((at, _), _)| *at == camera)
                    .map(|((_, foot), position)| (*foot, position))
                    .collect()
            };
            best_start(&receivers.iter().map(of_receiver).filter(|rows| !rows.is_empty()).collect::<Vec<_>>())
        })
        .collect();
    while let Some(camera) = maps.iter().position(Option::is_none) {
        let from_known = |camera: usize| {
            let known = transfers.iter().filter(|transfer| transfer.cameras[1] == camera);
            start(known.filter_map(|transfer| {
                let position = maps[transfer.cameras[0]].as_ref()?.position(&transfer.feet[0]);
                Some((transfer.feet[1], [position.east_m, position.north_m]))
            }))
        };
        let unknown = (0..cameras).filter(|&camera| maps[camera].is_none());
        let Some((next, map)) = unknown.filter_map(|camera| Some((camera, from_known(camera)?))).next()
        else {
            return Err(SiteFitError::TooFewRows { camera });
        };
        maps[next] = Some(map);
    }
    Ok(maps.into_iter().flatten().collect())
}

/// The best of several starts: of all receivers, and without each of [`START_GROUPS`] groups of them in turn. One receiver
/// with a large bias can lead a start to a map that no refinement leaves.
fn best_start(receivers: &[Vec<(Box4, [f64; 2])>]) -> Option<GroundMap> {
    let all: Vec<(Box4, [f64; 2])> = receivers.concat();
    let without = |group: usize| {
        let kept = receivers.iter().enumerate().filter(move |(at, _)| at % START_GROUPS != group);
        start(kept.flat_map(|(_, rows)| rows.iter().copied()))
    };
    let groups = START_GROUPS.min(receivers.len());
    let starts = start(all.iter().copied()).into_iter().chain((0..groups).filter_map(without));
    let scored = starts.map(|map| (misfit(&map, &all), map));
    scored.min_by(|one, other| one.0.total_cmp(&other.0)).map(|(_, map)| map)
}

/// Sum of Cauchy's loss of the distances between positions and fixes, in the first standard deviation.
fn misfit(map: &GroundMap, rows: &[(Box4, [f64; 2])]) -> f64 {
    let of_row = |(foot, position): &(Box4, [f64; 2])| {
        let at = map.position(foot);
        let squared_m2 = (at.east_m - position[0]).powi(2) + (at.north_m - position[1]).powi(2);
        (squared_m2 / FIRST_SIGMA_M.powi(2)).ln_1p()
    };
    rows.iter().map(of_row).sum()
}

fn start(rows: impl Iterator<Item = (Box4, [f64; 2])>) -> Option<GroundMap> {
    let (feet, positions): (Vec<Box4>, Vec<[f64; 2]>) = rows.unzip();
    (feet.len() >= FEWEST_ROWS).then(|| GroundMap::start(&feet, &positions))
}

/// Extent of the feet of a camera.
fn view_px(problem: &LeastSquaresProblem, camera: usize) -> [[f64; 2]; 2] {
    let by_fixes = problem.receivers.iter().flatten().flat_map(|row| row.feet.iter().copied());
    let by_pairs = problem.transfers.iter().map(|transfer| (transfer.cameras[0], transfer.feet[0]));
    let mut extent = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for (_, foot) in by_fixes.chain(by_pairs).filter(|(at, _)| *at == camera) {
        for (side, range) in extent.iter_mut().enumerate() {
            *range = [range[0].min(foot[side]), range[1].max(foot[side])];
        }
    }
    extent
}
