//! How sure a fitted encoder is, from held-out residuals: the error of the regression without the
//! receiver's.
//!
//! Squared misses less the receiver's variance would be the plain way (METHOD 2.4), but the
//! difference of two large numbers is mostly noise. Passes tell it better: within one patch of the
//! image the receiver's errors of different passes are independent, so what their means share is
//! the regression's own error. What never happens here: a look at the truth.

use super::coverage::Coverage;
use super::local_boxes::{Cells, Encode, Slopes, edge_variance_m2, slopes_at};
use crate::domain::BoundingBox;
use crate::geo::EastNorth;
use crate::model::artifact::Parts;
use crate::model::encoder::projective::Doubt;
use crate::model::fitting::candidates::BLOCKS;
use crate::model::progress::FitError;
use crate::model::regressor::{R95_PER_SIGMA, Regression, Regressor};
use crate::model::samples::rows::{Row, Rows, median, second_differences, steady_mean};
use crate::model::samples::whitening::FixNoise;

/// Patches of the image.
const PATCHES: usize = 64;
/// Residuals beyond this many standard deviations are wild.
const CREDIBLE_SIGMAS: f64 = 3.0;
/// Standard errors by which a shared error is taken for larger than it came out.
const DOUBT_OF_SHARED: f64 = 0.5;
/// The receiver's variance may be this many times what the fits have left of it.
const MOST_UNDERSTATED: f64 = 1.5;
/// A squared residual counts up to this many times what is expected of it.
const WILD: f64 = 6.0;
/// Share of the unusual boxes of training that show what such boxes are like; the rest are single.
const SHOWN: f64 = 0.95;
/// Variance of the factor on an unusual box's error before anything is known of it.
const PRIOR_VARIANCE: f64 = 4.0;
/// Taken where no three boxes follow each other, px2.
const UNKNOWN_EDGE_NOISE_PX2: f64 = 1.0;
/// The error varies over the image, so its distribution has longer tails than a normal one.
const TAIL: f64 = 1.1;
/// A hole longer than this ends a session, s.
const SESSION_HOLE_S: f64 = 1_800.0;
/// Independent fixes that a session needs to be heard.
const FEWEST_OF_SESSION: f64 = 4.0;
/// Factor on the error variance of boxes that the image's border cuts, where training had few.
const RARE_BORDER_FACTOR: f64 = 4.0;
/// Share of training boxes whose reconstruction error is usual for certain, and the factor on it up
/// to which any is.
const USUAL: f64 = 0.995;
const USUAL_FACTOR: f64 = 2.0;

/// What [`calibrate`] found, per axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Calibration {
    /// Error variance of the regression, mean over the training boxes, m2.
    pub(crate) error_m2: f64,
    /// The receiver's variance as the rows show it, with what lasts for a whole block of time, m2.
    pub(crate) receiver_m2: f64,
}

/// Sets the error's size and shape in the parts of a model.
///
/// `residuals` are regressed position less fix (m) of each row, by encoders that had not seen it.
pub(crate) fn calibrate(
    parts: &mut Parts,
    rows: &Rows,
    residuals: &[[f64; 2]],
    noise: &FixNoise,
) -> Result<Calibration, FitError> {
    let mut coverage = Coverage::new(rows.rows.iter().map(|row| row.bounding_box));
    set_plain(parts, &coverage);
    let regressor = Regressor::build(parts.clone()).map_err(|error| FitError::Fault(error.into()))?;
    let regress = |drawn: &BoundingBox| regressor.regress(drawn, None);
    let encode = |drawn: &BoundingBox| regressor.encode(drawn);
    let places = Places::new(&coverage, rows, parts.doubt.as_ref(), &encode);
    let answers: Vec<Regression> = rows.rows.iter().map(|row| regress(&row.bounding_box)).collect();
    let own: Vec<[f64; 2]> = rows.rows.iter().zip(&answers).map(|(row, answer)| miss(row, answer)).collect();

    let mean_doubt_m2 = places.mean(&places.doubts_m2);
    // The fits have taken some of the noise for their own; what a profile says of it may tell more.
    let understated = (1.0 + mean_doubt_m2 / noise.variance_m2)
        .max((parts.e_gnss_m2 / noise.variance_m2).min(MOST_UNDERSTATED));
    // Held-out fixes scatter more about other blocks' maps by what those maps leave open.
    let lasting_m2 = lasting_m2(residuals, &own, mean_doubt_m2);
    let shared_m2 = shared_error(rows, &coverage, residuals).unwrap_or(0.0);
    let misfit_m2 = (shared_m2 - mean_doubt_m2).max(0.0);
    let cells = Cells::new(&coverage, &rows.rows, &encode);
    let edge_px2 = edge_noise_px2(&rows.rows, &answers, &places, &cells);

    // Both tell of errors that outlast a pass; the larger has it.
    let session_m2 = session_m2(&rows.rows, &own, noise);
    let everywhere_m2 = misfit_m2 + session_m2.max(lasting_m2 / f64::from(BLOCKS));
    coverage.errors_m2 = places
        .doubts_m2
        .iter()
        .zip(&places.edges_m2)
        .map(|(doubt_m2, edge_m2)| {
            (understated * doubt_m2 + everywhere_m2 + edge_px2 * edge_m2).max(1e-4) as f32
        })
        .collect();
    let errors_m2: Vec<f64> = coverage.errors_m2.iter().map(|error_m2| f64::from(*error_m2)).collect();
    let error_m2 = places.mean(&errors_m2);
    let unrest_m2 = edge_px2 * places.mean(&places.edges_m2);
    parts.error_scale = places.mean(&places.heights_m2).clamp(1e-9, 1e9);
    put(parts, "reconstruction_usual", usual_reconstruction(&answers));
    put(parts, "r95_scale", TAIL * R95_PER_SIGMA);
    put(parts, "unrest_share", (unrest_m2 / error_m2).clamp(0.0, 1.0));
    let image_size = regressor.image_size();
    let cut = rows.rows.iter().filter(|row| row.bounding_box.touches_border(image_size)).count();
    // Where training has seen many cut boxes, their error is in the figures already.
    let rare = (cut as f64) < 0.03 * rows.rows.len() as f64;
    put(parts, "border_factor", if rare { RARE_BORDER_FACTOR } else { 1.0 });
    put(parts, "independent_fixes", independent_fixes(&rows.rows, noise));
    for (name, value) in [
        ("error_doubt_m2", understated * mean_doubt_m2),
        ("error_misfit_m2", misfit_m2),
        ("error_lasting_m2", lasting_m2),
        ("error_session_m2", session_m2),
        ("edge_noise_px2", edge_px2),
    ] {
        put(parts, name, value);
    }
    parts.put_coverage(&coverage);
    parts.put_cells(&cells);
    calibrate_extra(parts, rows, residuals, independent_fixes(&rows.rows, noise))?;
    Ok(Calibration { error_m2, receiver_m2: scatter_m2(&own) + lasting_m2 })
}

/// Holds the error that unusual boxes are given (cut, astray, contradicting themselves) against the
/// held-out residuals of such boxes in training: how much of it there was, up to the largest given.
fn calibrate_extra(
    parts: &mut Parts,
    rows: &Rows,
    residuals: &[[f64; 2]],
    independent: f64,
) -> Result<(), FitError> {
    let regressor = Regressor::build(parts.clone()).map_err(|error| FitError::Fault(error.into()))?;
    for (sight, [upto, factor]) in Regressor::SHOWN_NAMES.into_iter().enumerate() {
        if let Some(found) = extra_of(&regressor, rows, residuals, independent, sight) {
            put(parts, factor, found.0);
            put(parts, upto, found.1);
        }
    }
    Ok(())
}

/// The factor on the error given to the unusual boxes of one sight, and the error up to which there
/// were enough of them, m2; `None` where there were none.
fn extra_of(
    regressor: &Regressor,
    rows: &Rows,
    residuals: &[[f64; 2]],
    independent: f64,
    sight: usize,
) -> Option<(f64, f64)> {
    let (mut calm, mut unusual) = (Sum::default(), Sum::default());
    let (mut given, mut passes, mut last) = (Vec::new(), 0.0, None);
    let usual_m2 = scatter_m2(residuals);
    for (row, [east, north]) in rows.rows.iter().zip(residuals) {
        let extra_m2 = regressor.extra_m2(&row.bounding_box);
        // A wild fix must not speak for the boxes, nor a wild box for more than its error says.
        let square_m2 = (0.5 * (east * east + north * north)).min(WILD * (usual_m2 + extra_m2));
        if extra_m2 <= 0.0 {
            calm.add(square_m2);
        } else if regressor.sight(&row.bounding_box) == sight {
            unusual.add(square_m2);
            given.push(extra_m2);
            passes += f64::from(u8::from(last.replace(row.pass) != Some(row.pass)));
        }
    }
    if given.is_empty() || calm.count < 1.0 {
        return None;
    }
    given.sort_by(f64::total_cmp);
    let given_m2 = given.iter().sum::<f64>() / given.len() as f64;
    let found = (unusual.mean() - calm.mean()) / given_m2;
    // Fixes of one pass may err alike, so what counts is how many independent ones there were; the
    // geometry's own word stands beside.
    let worth = (unusual.count * independent / rows.rows.len() as f64).max(passes);
    let doubt = (calm.mean() / given_m2).powi(2) / worth;
    let factor = (found * PRIOR_VARIANCE + doubt) / (PRIOR_VARIANCE + doubt);
    Some((factor.clamp(0.01, 2.0), given[((given.len() - 1) as f64 * SHOWN) as usize]))
}

#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    sum: f64,
    count: f64,
}

impl Sum {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1.0;
    }

    fn mean(self) -> f64 {
        self.sum / self.count
    }
}

fn put(parts: &mut Parts, name: &str, value: f64) {
    parts.parameters.insert(name.to_owned(), value);
}

/// Regressed position less fix, m.
fn miss(row: &Row, answer: &Regression) -> [f64; 2] {
    let point = answer.regressed;
    [point.east_m - row.label.east_m, point.north_m - row.label.north_m]
}

/// Reconstruction error up to which a box contradicts itself no more than those of training.
fn usual_reconstruction(answers: &[Regression]) -> f64 {
    let mut rebuilt: Vec<f64> = answers.iter().map(|answer| answer.reconstruction_error).collect();
    rebuilt.sort_by(f64::total_cmp);
    rebuilt[((rebuilt.len() - 1) as f64 * USUAL) as usize].max(1e-4) * USUAL_FACTOR
}

/// What an encoder does at each centre of the coverage.
struct Places {
    /// Centre of each row.
    of_row: Vec<usize>,
    /// Rows at each centre.
    counts: Vec<f64>,
    /// Variance per axis that the fixes' noise has left, m2.
    doubts_m2: Vec<f64>,
    /// Variance per axis by an independent pixel of noise in each edge, m2.
    edges_m2: Vec<f64>,
    /// Variance per axis by a box height of noise in the foot point, m2.
    heights_m2: Vec<f64>,
}

impl Places {
    fn new(coverage: &Coverage, rows: &Rows, doubt: Option<&Doubt>, encode: &Encode<'_>) -> Self {
        let of_row: Vec<usize> = rows.rows.iter().map(|row| coverage.nearest(&row.bounding_box)).collect();
        let mut counts = vec![0.0; coverage.centres.len()];
        of_row.iter().for_each(|at| counts[*at] += 1.0);
        let mut places =
            Self { of_row, counts, doubts_m2: Vec::new(), edges_m2: Vec::new(), heights_m2: Vec::new() };
        for centre in coverage.boxes() {
            let slopes = centre.map_or([[0.0; 4]; 2], |centre| slopes_at(encode, &centre).0);
            let height_px = centre.map_or(0.0, |centre| centre.height_px());
            let variance_m2 = |doubt: &Doubt| centre.map_or(0.0, |centre| doubt.variance_m2(&centre));
            places.doubts_m2.push(doubt.map_or(0.0, variance_m2));
            places.edges_m2.push(edge_variance_m2(&slopes));
            places.heights_m2.push(foot_variance_m2(&slopes) * height_px * height_px);
        }
        places
    }

    /// Mean over the training boxes of something known at the centres.
    fn mean(&self, values: &[f64]) -> f64 {
        let total: f64 = self.counts.iter().sum();
        values.iter().zip(&self.counts).map(|(value, count)| value * count).sum::<f64>() / total
    }
}

/// Variance per axis that a pixel of noise in both coordinates of the foot makes, m2.
fn foot_variance_m2(slopes: &Slopes) -> f64 {
    let squares = slopes.iter().map(|[left, top, right, bottom]| {
        let (across_m, along_m) = (left + right, top + bottom);
        across_m * across_m + along_m * along_m
    });
    0.5 * squares.sum::<f64>()
}

/// Values with which the encoder can be built before it is calibrated.
pub(crate) fn set_plain(parts: &mut Parts, coverage: &Coverage) {
    parts.put_coverage(coverage);
    parts.parameters.insert("border_factor".to_owned(), 1.0);
    parts.parameters.insert("reconstruction_usual".to_owned(), 1.0);
    parts.parameters.insert("r95_scale".to_owned(), R95_PER_SIGMA);
}

/// How many independent fixes the rows are worth, per axis.
pub(crate) fn independent_fixes(rows: &[Row], noise: &FixNoise) -> f64 {
    let stays = 1.0 - noise.white_share;
    let mut sum = 0.0;
    for pass in rows.chunk_by(|one, other| one.pass == other.pass) {
        let seconds = pass[pass.len() - 1].time_s - pass[0].time_s;
        let spells = (1.0 + 0.5 * seconds / noise.time_constant_s).min(pass.len() as f64);
        sum += 1.0 / (noise.white_share / pass.len() as f64 + stays / spells);
    }
    sum.max(1.0)
}

/// Variance per axis of what stays the same for a whole block of time, m2: held-out fixes scatter
/// more about a map that other blocks have made than a map's own fixes do, by it, by the share of it
/// that those other blocks left in the map, and by what the noise left open in either map.
fn lasting_m2(held_out: &[[f64; 2]], own: &[[f64; 2]], doubt_m2: f64) -> f64 {
    let others = f64::from(BLOCKS - 1);
    let of_noise_m2 = doubt_m2 * (f64::from(BLOCKS) / others + 1.0);
    (scatter_m2(held_out) - scatter_m2(own) - of_noise_m2).max(0.0) * others / (others + 1.0)
}

/// Variance per axis that a map has from sessions whose fixes are all shifted, m2: half an hour without
/// a row ends a session, and with it the errors that no filter inside of it can tell from the truth.
/// The sessions' mean residuals about one map scatter by those shifts and by what the coloured noise
/// leaves of a mean; the map has the mean of the shifts. 0 for a single session, which tells nothing.
fn session_m2(rows: &[Row], own: &[[f64; 2]], noise: &FixNoise) -> f64 {
    let credible_m2 = 2.0 * CREDIBLE_SIGMAS * CREDIBLE_SIGMAS * scatter_m2(own);
    let mut order: Vec<usize> = (0..rows.len())
        .filter(|index| own[*index][0].powi(2) + own[*index][1].powi(2) <= credible_m2)
        .collect();
    order.sort_by(|one, other| rows[*one].time_s.total_cmp(&rows[*other].time_s));
    let (mut means, mut of_noise_m2) = (Vec::new(), 0.0);
    for session in order.chunk_by(|one, next| rows[*next].time_s - rows[*one].time_s <= SESSION_HOLE_S) {
        let mut session = session.to_vec();
        // Rows of a pass stand together again.
        session.sort_unstable();
        let its: Vec<Row> = session.iter().map(|index| rows[*index]).collect();
        let worth = independent_fixes(&its, noise);
        if worth < FEWEST_OF_SESSION {
            continue;
        }
        let count = session.len() as f64;
        means.push([0, 1].map(|axis| session.iter().map(|index| own[*index][axis]).sum::<f64>() / count));
        of_noise_m2 += noise.variance_m2 / worth;
    }
    let count = means.len() as f64;
    if means.len() < 2 {
        return 0.0;
    }
    let middle = [0, 1].map(|axis| means.iter().map(|mean| mean[axis]).sum::<f64>() / count);
    let squares = means.iter().map(|mean| (mean[0] - middle[0]).powi(2) + (mean[1] - middle[1]).powi(2));
    let between_m2 = squares.sum::<f64>() / (2.0 * (count - 1.0));
    (between_m2 - of_noise_m2 / count).max(0.0) / count
}

/// Variance per axis of residuals by their median, which a few wild ones do not move, m2.
fn scatter_m2(residuals: &[[f64; 2]]) -> f64 {
    let squares = residuals.iter().map(|[east, north]| 0.5 * (east * east + north * north));
    median(squares.collect()) / std::f64::consts::LN_2
}

/// Variance per axis that the passes through one patch share, over all patches, m2, with
/// its own standard error on top; `None` where too few patches have three passes.
fn shared_error(rows: &Rows, coverage: &Coverage, residuals: &[[f64; 2]]) -> Option<f64> {
    let patches = coverage.coarse(PATCHES);
    // A wild fix or box says nothing of the regression's usual error.
    let credible_m2 = 2.0 * CREDIBLE_SIGMAS * CREDIBLE_SIGMAS * scatter_m2(residuals);
    let credible = |[east, north]: &[f64; 2]| east * east + north * north <= credible_m2;
    let mut means: Vec<Vec<(f64, [f64; 2])>> = vec![Vec::new(); PATCHES];
    let mut at = 0;
    for pass in rows.rows.chunk_by(|one, other| one.pass == other.pass) {
        let mut sums = vec![(0.0, [0.0; 2]); PATCHES];
        for (row, residual) in pass.iter().zip(&residuals[at..]).filter(|(_, residual)| credible(residual)) {
            let (count, sum) = &mut sums[patches.nearest(&row.bounding_box)];
            *count += 1.0;
            (sum[0], sum[1]) = (sum[0] + residual[0], sum[1] + residual[1]);
        }
        at += pass.len();
        for (patch, (count, sum)) in means.iter_mut().zip(sums).filter(|(_, sum)| sum.0 > 0.0) {
            patch.push((count, sum.map(|sum| sum / count)));
        }
    }
    let (mut sum, mut squares, mut weights, mut weights2) = (0.0, 0.0, 0.0, 0.0);
    let mut used = 0;
    for patch in means.iter().filter(|patch| patch.len() >= 3) {
        let count = patch.len() as f64;
        let rows: f64 = patch.iter().map(|(rows, _)| rows).sum();
        let mut own = 0.0;
        for axis in 0..2 {
            // Medians and means agree without outliers; the bound keeps one bad pass harmless.
            let middle = median(patch.iter().map(|(_, mean)| mean[axis]).collect());
            let spread = 1.48 * median(patch.iter().map(|(_, mean)| (mean[axis] - middle).abs()).collect());
            let bound = 3.0 * spread + 1e-9;
            let bounded = |mean: &[f64; 2]| mean[axis].clamp(middle - bound, middle + bound);
            let mean = patch.iter().map(|(_, mean)| bounded(mean)).sum::<f64>() / count;
            let scatter = patch.iter().map(|(_, at)| (bounded(at) - mean).powi(2)).sum::<f64>();
            own += 0.5 * (mean * mean - scatter / (count * (count - 1.0)));
        }
        used += 1;
        sum += rows * own;
        squares += rows * rows * own * own;
        weights += rows;
        weights2 += rows * rows;
    }
    if used < 6 || weights < 0.5 * rows.rows.len() as f64 {
        return None;
    }
    let mean = sum / weights;
    let standard =
        (squares / (weights * weights) - mean * mean * weights2 / (weights * weights)).max(0.0).sqrt();
    Some(mean + DOUBT_OF_SHARED * standard)
}

/// Variance of one edge's frame-to-frame noise, px2, from the second differences of regressed
/// positions: a steady target's unrest, less what its motion explains. Boxes astray are left out,
/// for they are judged by how far.
fn edge_noise_px2(rows: &[Row], answers: &[Regression], places: &Places, cells: &Cells) -> f64 {
    let usual: Vec<bool> = rows
        .iter()
        .zip(&places.of_row)
        .map(|(row, at)| cells.astray_m2(*at, &row.bounding_box) <= 0.0)
        .collect();
    let points: Vec<EastNorth> = answers.iter().map(|answer| answer.regressed).collect();
    let squares = second_differences(rows, &points).filter_map(|(at, square_m2)| {
        let edge_m2 = places.edges_m2[places.of_row[at]];
        let calm = edge_m2 > 0.0 && usual[at - 1..=at + 1].iter().all(|usual| *usual);
        calm.then(|| square_m2 / (12.0 * edge_m2))
    });
    steady_mean(squares.collect()).unwrap_or(UNKNOWN_EDGE_NOISE_PX2)
}
