//! A box's place on the ground as a ratio of linear functions of the box, and its robust fit.
//!
//! With the foot point alone this is the homography of the ground plane: eight numbers. With the
//! sides of the box as well the ground point may lie anywhere in the box, and a target's size may
//! tell its distance. Extra columns (a network's hidden units) may add what no camera model has.
//! What never happens here: a choice between those forms; held-out blocks make it.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::domain::BoundingBox;
use crate::geo::{EastNorth, LocalPlane, Position};
use crate::model::samples::rows::{Row, median, second_differences, spread, steady_mean};
use crate::model::samples::whitening::{FixNoise, Whitener};

/// Numbers of a box: foot x, foot y, width, height.
pub(crate) const SIDES: usize = 4;
/// Numerators of both axes and the denominator without its 1: columns 1, x, y, width, height.
pub(crate) const COEFFICIENTS: usize = 14;
/// The denominator is kept above it, so that a box near the horizon stays finite.
const LEAST_DENOMINATOR: f64 = 0.02;
/// Widths and heights beyond so many units say no more, lest a wild box land far away.
const FARTHEST_SIDE: f64 = 3.5;
const STARTS: usize = 300;
/// The starts are the same for every run, so that no answer hangs on the run's seed.
const START_SEED: u64 = 1;
const STEPS: usize = 25;
/// Rounds of refinement and re-weighting.
const ROUNDS: usize = 4;

/// A whitener that trusts differences between neighbours too much fits the unrest of boxes, which
/// draws the map together (errors in variables). So the white part of the fixes' error is taken for
/// at least this many times the unrest of the regressed positions.
const UNREST_FACTOR: f64 = 20.0;

/// The map itself.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// Middle and unit of foot x, foot y, width, height, px.
    pub(crate) scales: [[f64; 2]; SIDES],
    /// Middle of the positions, and their unit, m.
    pub(crate) middle: EastNorth,
    pub(crate) unit_m: f64,
    /// 5 of east, 5 of north, 4 of the denominator, all in units.
    pub(crate) coefficients: [f64; COEFFICIENTS],
}

/// What a fit may use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Form {
    /// Whether width and height count.
    pub(crate) sides: bool,
    /// Standard deviation of an extra column's weight, in units of position.
    pub(crate) extra_sigma: f64,
}

/// A fitted map with the weights of the extra columns and the error about it.
#[derive(Debug, Clone)]
pub(crate) struct Fitted {
    pub(crate) projection: Projection,
    /// Weights of the extra columns for east, then north, in units of position.
    pub(crate) extra: [Vec<f64>; 2],
    pub(crate) noise: FixNoise,
    pub(crate) doubt: MapDoubt,
}

/// What the noise of so many fixes leaves open in a map: the covariance of its parameters.
#[derive(Debug, Clone)]
pub(crate) struct MapDoubt {
    projection: Projection,
    covariance: DMatrix<f64>,
}

impl MapDoubt {
    pub(crate) const fn projection(&self) -> &Projection {
        &self.projection
    }

    /// Variance per axis of the map at a box, m2; `columns` are the values of the extra ones there.
    pub(crate) fn variance_m2(&self, bounding_box: &BoundingBox, columns: &[f64]) -> f64 {
        let Projection { unit_m, .. } = self.projection;
        let terms = self.projection.terms(bounding_box);
        let ratio = self.projection.ratio(&terms);
        let mut sum = 0.0;
        for axis in 0..2 {
            let mut slope = DVector::<f64>::zeros(self.covariance.nrows());
            for (term, value) in terms.iter().enumerate() {
                slope[5 * axis + term] = unit_m * value / ratio[2];
            }
            for term in 0..4 {
                slope[10 + term] = -unit_m * ratio[axis] * terms[1 + term] / ratio[2];
            }
            for (at, value) in columns.iter().enumerate() {
                slope[COEFFICIENTS + axis * columns.len() + at] = unit_m * value;
            }
            sum += slope.dot(&(&self.covariance * &slope));
        }
        0.5 * sum
    }
}

#[inline]
pub(crate) fn sides_of(bounding_box: &BoundingBox) -> [f64; SIDES] {
    let [foot_x, foot_y] = bounding_box.foot_px();
    [foot_x, foot_y, bounding_box.width_px(), bounding_box.height_px()]
}

impl Projection {
    /// Scales of some rows, and a map to their middle.
    pub(crate) fn of_rows(rows: &[Row]) -> Self {
        let count = rows.len() as f64;
        let sides: Vec<[f64; SIDES]> = rows.iter().map(|row| sides_of(&row.bounding_box)).collect();
        let mut scales: [[f64; 2]; SIDES] = std::array::from_fn(|at| {
            let values = sides.iter().map(|sides| sides[at]);
            [values.clone().sum::<f64>() / count, spread(values).max(2.0)]
        });
        // One unit for both coordinates of the foot keeps the image's proportions.
        let foot_px = (0.5 * (scales[0][1].powi(2) + scales[1][1].powi(2))).sqrt();
        (scales[0][1], scales[1][1]) = (foot_px, foot_px);
        let middle = EastNorth {
            east_m: rows.iter().map(|row| row.label.east_m).sum::<f64>() / count,
            north_m: rows.iter().map(|row| row.label.north_m).sum::<f64>() / count,
        };
        let square = rows.iter().map(|row| row.label.error_per_axis_m2(middle)).sum::<f64>() / count;
        Self { scales, middle, unit_m: square.sqrt().max(0.1), coefficients: [0.0; COEFFICIENTS] }
    }

    #[inline]
    fn terms(&self, bounding_box: &BoundingBox) -> [f64; 5] {
        let sides = sides_of(bounding_box);
        let scaled = |at: usize| (sides[at] - self.scales[at][0]) / self.scales[at][1];
        let bounded = |at: usize| scaled(at).clamp(-FARTHEST_SIDE, FARTHEST_SIDE);
        [1.0, scaled(0), scaled(1), bounded(2), bounded(3)]
    }

    /// Position in units about the middle, and the denominator.
    #[inline]
    fn ratio(&self, terms: &[f64; 5]) -> [f64; 3] {
        let c = &self.coefficients;
        let dot = |from: usize| (0..5).map(|at| c[from + at] * terms[at]).sum::<f64>();
        let bottom = (0..4).fold(1.0, |sum, at| sum + c[10 + at] * terms[1 + at]).max(LEAST_DENOMINATOR);
        [dot(0) / bottom, dot(5) / bottom, bottom]
    }

    /// Where the target of a box stands; `extra` is added in units of position.
    #[inline]
    #[must_use]
    pub fn project(&self, bounding_box: &BoundingBox, extra: [f64; 2]) -> EastNorth {
        let [east, north, _] = self.ratio(&self.terms(bounding_box));
        EastNorth {
            east_m: self.middle.east_m + self.unit_m * (east + extra[0]),
            north_m: self.middle.north_m + self.unit_m * (north + extra[1]),
        }
    }

    /// The same, kept between the least and greatest of each axis, in units of position.
    #[inline]
    pub(crate) fn project_within(
        &self,
        bounding_box: &BoundingBox,
        extra: [f64; 2],
        bounds: &[[f64; 2]; 2],
    ) -> EastNorth {
        let [east, north, _] = self.ratio(&self.terms(bounding_box));
        let kept = |axis: usize, value: f64| (value + extra[axis]).clamp(bounds[axis][0], bounds[axis][1]);
        EastNorth {
            east_m: self.middle.east_m + self.unit_m * kept(0, east),
            north_m: self.middle.north_m + self.unit_m * kept(1, north),
        }
    }

    /// Whether a box lies on the ground's side of the horizon.
    #[must_use]
    pub fn sees_ground(&self, bounding_box: &BoundingBox) -> bool {
        self.ratio(&self.terms(bounding_box))[2] > LEAST_DENOMINATOR
    }

    /// A position in units about the middle.
    #[inline]
    pub(crate) fn in_units(&self, label: EastNorth) -> [f64; 2] {
        [
            (label.east_m - self.middle.east_m) / self.unit_m,
            (label.north_m - self.middle.north_m) / self.unit_m,
        ]
    }

    /// The normalised direct linear transform of the foot points of some rows; `None` where they
    /// determine nothing.
    fn direct(&self, rows: &[Row], chosen: &[usize]) -> Option<Self> {
        let mut normal = DMatrix::<f64>::identity(8, 8) * 1e-6;
        let mut right = DVector::<f64>::zeros(8);
        for at in chosen {
            let terms = self.terms(&rows[*at].bounding_box);
            for (axis, target) in self.in_units(rows[*at].label).into_iter().enumerate() {
                let mut line = [0.0; 8];
                line[3 * axis..3 * axis + 3].copy_from_slice(&terms[..3]);
                (line[6], line[7]) = (-target * terms[1], -target * terms[2]);
                for row in 0..8 {
                    right[row] += line[row] * target;
                    for column in 0..8 {
                        normal[(row, column)] += line[row] * line[column];
                    }
                }
            }
        }
        let solution = normal.cholesky()?.solve(&right);
        let mut map = self.clone();
        for (into, from) in [0, 1, 2, 5, 6, 7, 10, 11].into_iter().zip(0..8) {
            map.coefficients[into] = solution[from];
        }
        let upright = chosen.iter().all(|at| map.sees_ground(&rows[*at].bounding_box));
        upright.then_some(map)
    }

    /// Median distance to some rows, in units.
    fn typical_miss(&self, rows: &[Row], chosen: &[usize]) -> f64 {
        let misses = chosen.iter().map(|at| {
            let [east, north, _] = self.ratio(&self.terms(&rows[*at].bounding_box));
            let target = self.in_units(rows[*at].label);
            (east - target[0]).hypot(north - target[1])
        });
        median(misses.collect())
    }

    /// The best of many direct transforms of few rows each (RANSAC by the median), and of all rows.
    fn start(rows: &[Row], rng: &mut ChaCha8Rng) -> Self {
        let blank = Self::of_rows(rows);
        let judges: Vec<usize> = (0..rows.len()).step_by(rows.len().div_ceil(400)).collect();
        let all: Vec<usize> = (0..rows.len()).collect();
        let mut best = blank.direct(rows, &all);
        let mut least = best.as_ref().map_or(f64::INFINITY, |map| 0.95 * map.typical_miss(rows, &judges));
        for start in 0..STARTS {
            let count = if start % 2 == 0 { 5 } else { 20.min(rows.len()) };
            let chosen: Vec<usize> = (0..count).map(|_| rng.random_range(0..rows.len())).collect();
            let Some(map) = blank.direct(rows, &chosen) else { continue };
            let miss = map.typical_miss(rows, &judges);
            if miss < least {
                (least, best) = (miss, Some(map));
            }
        }
        best.unwrap_or(blank)
    }
}

/// The draw of starts of every recipe's fit.
pub(crate) fn same_starts() -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(START_SEED)
}

/// Fits a map of the foot points alone to pairs of boxes and positions in one plane (m), whose errors
/// are independent; `None` for fewer than 8 pairs, or pairs that are all at one spot.
#[must_use]
pub fn fit_foot_points(pairs: &[(BoundingBox, EastNorth)], rng: &mut ChaCha8Rng) -> Option<Projection> {
    let nowhere = LocalPlane::new(Position::new(0.0, 0.0).ok()?).origin();
    // Every pair is its own target, so that none is taken to err like its neighbour.
    let rows: Vec<Row> = pairs
        .iter()
        .enumerate()
        .map(|(at, (bounding_box, label))| Row {
            time_s: 0.0,
            target: at as u32,
            pass: at as u32,
            bounding_box: *bounding_box,
            position: nowhere,
            label: *label,
            own_variance_m2: None,
        })
        .collect();
    if rows.len() < 8 {
        return None;
    }
    let form = Form { sides: false, extra_sigma: 1.0 };
    let fitted = fit(&rows, form, &[], rng);
    let moves = fitted.projection.coefficients.iter().any(|coefficient| coefficient.abs() > 1e-9);
    moves.then_some(fitted.projection)
}

/// Fits a map of a form to rows in the order of target and time; `columns` are the extra ones.
pub(crate) fn fit(rows: &[Row], form: Form, columns: &[Vec<f64>], rng: &mut ChaCha8Rng) -> Fitted {
    let projection = Projection::start(rows, rng);
    let mut doubts = vec![0.0; rows.len()];
    let mut fitted = Fitted {
        extra: [vec![0.0; columns.len()], vec![0.0; columns.len()]],
        doubt: MapDoubt { projection: projection.clone(), covariance: DMatrix::zeros(0, 0) },
        projection,
        noise: FixNoise::white(1.0),
    };
    let first = fitted.residuals(rows, columns);
    let misses: Vec<f64> = first[0].iter().zip(&first[1]).map(|(east, north)| east.hypot(*north)).collect();
    let usual_m = median(misses.clone()).max(1e-3);
    // Until the noise is known, whatever is far beyond the usual counts less.
    for (doubt, miss) in doubts.iter_mut().zip(&misses) {
        *doubt = (miss / (4.0 * usual_m)).powi(2) - 1.0;
        *doubt = doubt.max(0.0) * 8.0;
    }
    fitted.noise = FixNoise::white(usual_m * usual_m / 1.39);
    let mut trusted = fitted.noise;
    for round in 0..ROUNDS {
        fitted.refine(rows, form, columns, &Whitener::new(rows, &trusted, &doubts));
        let residuals = fitted.residuals(rows, columns);
        fitted.noise = FixNoise::of_residuals(rows, &residuals, &doubts);
        trusted = fitted.noise.with_white_m2(UNREST_FACTOR * fitted.unrest_m2(rows, columns));
        if round + 1 < ROUNDS {
            let whitener = Whitener::new(rows, &fitted.noise, &doubts);
            let whitened = residuals.map(|mut axis| {
                whitener.apply(&mut axis);
                axis
            });
            whitener.doubt(&fitted.noise, &whitened, &mut doubts);
        }
    }
    let whitener = Whitener::new(rows, &trusted, &doubts);
    let (normal, _) = fitted.normal_equations(rows, columns, &whitener, &fitted.prior(form));
    let size = normal.nrows();
    // The prior makes the matrix positive; were it not, nothing would be known.
    let covariance = normal.cholesky().map_or_else(|| DMatrix::identity(size, size), |it| it.inverse());
    fitted.doubt = MapDoubt { projection: fitted.projection.clone(), covariance };
    fitted
}

impl Fitted {
    /// Fix less map, m.
    pub(crate) fn residuals(&self, rows: &[Row], columns: &[Vec<f64>]) -> [Vec<f64>; 2] {
        let mut residuals = [Vec::with_capacity(rows.len()), Vec::with_capacity(rows.len())];
        for (at, row) in rows.iter().enumerate() {
            let extra = std::array::from_fn(|axis: usize| {
                self.extra[axis].iter().zip(columns).map(|(weight, column)| weight * column[at]).sum()
            });
            let point = self.projection.project(&row.bounding_box, extra);
            residuals[0].push(row.label.east_m - point.east_m);
            residuals[1].push(row.label.north_m - point.north_m);
        }
        residuals
    }

    /// Variance per axis of the frame-to-frame unrest of the map's positions, m2.
    fn unrest_m2(&self, rows: &[Row], columns: &[Vec<f64>]) -> f64 {
        let points: Vec<EastNorth> = self.residuals(rows, columns)[0]
            .iter()
            .zip(&self.residuals(rows, columns)[1])
            .zip(rows)
            .map(|((east, north), row)| EastNorth {
                east_m: row.label.east_m - east,
                north_m: row.label.north_m - north,
            })
            .collect();
        steady_mean(second_differences(rows, &points).map(|(_, square_m2)| square_m2 / 12.0).collect())
            .unwrap_or(0.0)
    }

    /// Levenberg and Marquardt's steps on whitened residuals with a prior that decides only what
    /// the rows leave open.
    fn refine(&mut self, rows: &[Row], form: Form, columns: &[Vec<f64>], whitener: &Whitener) {
        let prior = self.prior(form);
        let mut damping = 1e-3;
        let mut cost = self.cost(rows, columns, whitener, &prior);
        for _ in 0..STEPS {
            let (normal, slope) = self.normal_equations(rows, columns, whitener, &prior);
            let mut damped = normal.clone();
            for at in 0..damped.nrows() {
                damped[(at, at)] *= 1.0 + damping;
            }
            let Some(factor) = damped.cholesky() else { break };
            let step = factor.solve(&slope);
            let mut moved = self.clone();
            moved.add(&step);
            let moved_cost = moved.cost(rows, columns, whitener, &prior);
            if moved_cost < cost {
                let gain = (cost - moved_cost) / cost.max(1e-12);
                (*self, cost) = (moved, moved_cost);
                damping = (damping * 0.2).max(1e-9);
                if gain < 1e-7 {
                    break;
                }
            } else {
                damping *= 8.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
    }

    /// Precision of each parameter about 0, in units.
    fn prior(&self, form: Form) -> Vec<f64> {
        let sides = if form.sides { 0.3 } else { 1e-6 };
        let mut sigmas = Vec::new();
        for _axis in 0..2 {
            sigmas.extend([10.0, 10.0, 10.0, sides, sides]);
        }
        sigmas.extend([0.7, 0.7, sides, sides]);
        sigmas.extend(std::iter::repeat_n(form.extra_sigma, 2 * self.extra[0].len()));
        sigmas.iter().map(|sigma| 1.0 / (sigma * sigma)).collect()
    }

    fn values(&self) -> impl Iterator<Item = f64> + '_ {
        self.projection.coefficients.iter().chain(self.extra.iter().flatten()).copied()
    }

    fn add(&mut self, step: &DVector<f64>) {
        let values = self.projection.coefficients.iter_mut().chain(self.extra.iter_mut().flatten());
        values.zip(step.iter()).for_each(|(value, step)| *value += step);
    }

    fn cost(&self, rows: &[Row], columns: &[Vec<f64>], whitener: &Whitener, prior: &[f64]) -> f64 {
        let misses: f64 = self
            .residuals(rows, columns)
            .into_iter()
            .map(|mut axis| {
                whitener.apply(&mut axis);
                axis.iter().map(|value| value * value).sum::<f64>()
            })
            .sum();
        misses + self.values().zip(prior).map(|(value, precision)| precision * value * value).sum::<f64>()
    }

    fn normal_equations(
        &self,
        rows: &[Row],
        columns: &[Vec<f64>],
        whitener: &Whitener,
        prior: &[f64],
    ) -> (DMatrix<f64>, DVector<f64>) {
        let size = prior.len();
        let mut normal = DMatrix::<f64>::from_diagonal(&DVector::from_column_slice(prior));
        let mut slope = DVector::from_iterator(size, self.values().zip(prior).map(|(value, p)| -value * p));
        let residuals = self.residuals(rows, columns);
        let unit_m = self.projection.unit_m;
        let ratios: Vec<([f64; 5], [f64; 3])> = rows
            .iter()
            .map(|row| {
                let terms = self.projection.terms(&row.bounding_box);
                (terms, self.projection.ratio(&terms))
            })
            .collect();
        for (axis, mut residual) in residuals.into_iter().enumerate() {
            whitener.apply(&mut residual);
            // (parameter, whitened derivative of the map by it)
            let mut slopes: Vec<(usize, Vec<f64>)> = Vec::with_capacity(9 + columns.len());
            for term in 0..5 {
                let column = ratios.iter().map(|(terms, ratio)| unit_m * terms[term] / ratio[2]);
                slopes.push((5 * axis + term, column.collect()));
            }
            for term in 0..4 {
                let column =
                    ratios.iter().map(|(terms, ratio)| -unit_m * ratio[axis] * terms[1 + term] / ratio[2]);
                slopes.push((10 + term, column.collect()));
            }
            for (at, column) in columns.iter().enumerate() {
                let parameter = COEFFICIENTS + axis * columns.len() + at;
                slopes.push((parameter, column.iter().map(|value| unit_m * value).collect()));
            }
            for (_, column) in &mut slopes {
                whitener.apply(column);
            }
            for (at, (row, left)) in slopes.iter().enumerate() {
                slope[*row] += dot(left, &residual);
                for (column, right) in &slopes[..=at] {
                    let product = dot(left, right);
                    normal[(*row, *column)] += product;
                    if row != column {
                        normal[(*column, *row)] += product;
                    }
                }
            }
        }
        (normal, slope)
    }
}

/// Sum of products in four lanes, so that the compiler may use vectors.
fn dot(left: &[f64], right: &[f64]) -> f64 {
    let (left, left_rest) = left.as_chunks::<4>();
    let (right, right_rest) = right.as_chunks::<4>();
    let mut sums = [0.0; 4];
    for (one, other) in left.iter().zip(right) {
        for lane in 0..4 {
            sums[lane] += one[lane] * other[lane];
        }
    }
    let rest: f64 = left_rest.iter().zip(right_rest).map(|(one, other)| one * other).sum();
    sums.iter().sum::<f64>() + rest
}
