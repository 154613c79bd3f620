//! What boxes look like in each part of the image, and what a box that does not look so does to the
//! answer.
//!
//! A target that goes its ways makes boxes on a thin surface in the space of the four edges. In each
//! cell of the image that surface is taken for flat: a robust mean and covariance of the training
//! boxes tell along which directions edges go together and where they only carry the detector's
//! noise. What a box deviates in the thin directions, times the encoder's slopes, is how far it pulls
//! the answer away. What never happens here: a fix or a label.

use nalgebra::{Matrix4, Vector4};

use super::coverage::Coverage;
use crate::domain::{BoundingBox, Error, Result};
use crate::geo::EastNorth;
use crate::model::samples::rows::{Row, median};

/// Training boxes per cell, at least, and cells at most.
const ROWS_PER_CELL: usize = 40;
const MOST_CELLS: usize = 64;
/// Variance of an edge by the rounding to pixels, px2: no cell is thinner.
const ROUNDING_PX2: f64 = 0.25;
/// Squared Mahalanobis length (4 degrees, 95 %) beyond which a box counts less for its cell.
const CREDIBLE: f64 = 9.5;
const ROUNDS: usize = 12;
/// A deviation is usual up to the larger of so many times these quantiles of the training boxes'.
const USUAL: [(f64, f64); 2] = [(0.7, 4.0), (0.99, 1.5)];
/// Share of a deviation's square that counts in the mean direction, where the exact one is unsure.
const SIDEWAYS: f64 = 0.25;
/// Numbers of a cell: middle 4, precision 16, pull 8, sideways 1, usual 1.
pub(crate) const NUMBERS: usize = 30;

/// Pixels by which a box may go along with the target's place wherever geometry says so, though
/// training has not gone there.
const PLACES_PX: f64 = 40.0;

/// What an encoder makes of a box: the answer, and the sides (foot x, foot y, width, height, px) that
/// its decoder rebuilds from that.
pub(crate) type Encode<'a> = dyn Fn(&BoundingBox) -> (EastNorth, [f64; 4]) + 'a;

/// Metres that the answer moves for a pixel of each edge: east, then north.
pub(crate) type Slopes = [[f64; 4]; 2];

/// One part of the image.
#[derive(Debug, Clone, PartialEq)]
struct Cell {
    /// Mean left, top, right, bottom, px.
    middle: [f32; 4],
    /// Inverse covariance of the edges, 1 / px2.
    precision: [[f32; 4]; 4],
    /// What the answer moves by a deviation in thin directions, m per px.
    pull: [[f32; 4]; 2],
    /// Mean square of that per squared Mahalanobis length, m2 per axis.
    sideways_m2: f32,
    /// Squared Mahalanobis length up to which a deviation is usual.
    usual: f32,
}

/// All cells; the nearest centre of the coverage says which one a box belongs to.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Cells {
    cells: Vec<Cell>,
    /// Cell of each centre.
    of_centre: Vec<u8>,
}

pub(crate) fn edges_of(bounding_box: &BoundingBox) -> [f64; 4] {
    let [left, top, width, height] = bounding_box.sides_px();
    [left, top, left + width, top + height]
}

/// Slopes of an encoder at a box, by central differences of a pixel, and the rebuilt edges' own slopes
/// (rows by moved edge).
pub(crate) fn slopes_at(encode: &Encode<'_>, bounding_box: &BoundingBox) -> (Slopes, Matrix4<f64>) {
    let edges = edges_of(bounding_box);
    let mut slopes = [[0.0; 4]; 2];
    let mut rebuilt = Matrix4::zeros();
    for edge in 0..4 {
        let moved = |by_px: f64| {
            let mut edges = edges;
            edges[edge] += by_px;
            let [left, top, right, bottom] = edges;
            BoundingBox::new(left, top, right - left, bottom - top).ok().map(|moved| encode(&moved))
        };
        // A box of a pixel cannot shrink; its slopes are then unknown, and taken for none.
        if let (Some(more), Some(less)) = (moved(0.5), moved(-0.5)) {
            slopes[0][edge] = more.0.east_m - less.0.east_m;
            slopes[1][edge] = more.0.north_m - less.0.north_m;
            let [foot_x, foot_y, width, height]: [f64; 4] =
                std::array::from_fn(|side| more.1[side] - less.1[side]);
            let edges = [foot_x - 0.5 * width, foot_y - height, foot_x + 0.5 * width, foot_y];
            rebuilt.set_column(edge, &Vector4::from(edges));
        }
    }
    (slopes, rebuilt)
}

/// Variance per axis that an independent pixel of noise in each edge makes, m2.
pub(crate) fn edge_variance_m2(slopes: &Slopes) -> f64 {
    0.5 * slopes.iter().flatten().map(|slope| slope * slope).sum::<f64>()
}

impl Cells {
    /// Cells of the training boxes, with the slopes of an encoder at the middle of each.
    pub(crate) fn new(coverage: &Coverage, rows: &[Row], encode: &Encode<'_>) -> Self {
        let count = (rows.len() / ROWS_PER_CELL).clamp(1, MOST_CELLS).min(coverage.centres.len());
        let coarse = coverage.coarse(count);
        let of_centre = cells_of(coverage, count);
        let mut members: Vec<Vec<Vector4<f64>>> = vec![Vec::new(); count];
        for row in rows {
            members[coarse.nearest(&row.bounding_box)].push(Vector4::from(edges_of(&row.bounding_box)));
        }
        let mut cells = Vec::with_capacity(count);
        let whole: Vec<Vector4<f64>> = members.iter().flatten().copied().collect();
        for own in &members {
            // A cell with few boxes of its own cannot tell which directions are thin.
            let own = if own.len() < ROWS_PER_CELL / 4 { &whole } else { own };
            cells.push(Cell::new(own, encode));
        }
        let mut all = Self { cells, of_centre };
        all.set_usual(coverage, rows);
        all
    }

    fn set_usual(&mut self, coverage: &Coverage, rows: &[Row]) {
        let mut lengths: Vec<f64> = rows
            .iter()
            .map(|row| {
                let cell = &self.cells[usize::from(self.of_centre[coverage.nearest(&row.bounding_box)])];
                cell.deviation(&row.bounding_box).0
            })
            .collect();
        lengths.sort_by(f64::total_cmp);
        let quantile = |share: f64| lengths[((lengths.len() - 1) as f64 * share) as usize];
        let usual = USUAL.map(|(share, factor)| factor * quantile(share)).into_iter().fold(1.0, f64::max);
        for cell in &mut self.cells {
            cell.usual = usual as f32;
        }
    }

    /// The error variance per axis that a box adds which looks like none of those in its part of
    /// the image, m2; 0 for all others.
    #[inline]
    pub(crate) fn astray_m2(&self, centre: usize, bounding_box: &BoundingBox) -> f64 {
        let Some(cell) = self.of_centre.get(centre).and_then(|at| self.cells.get(usize::from(*at))) else {
            return 0.0;
        };
        let (length, pulled_m2) = cell.deviation(bounding_box);
        let usual = f64::from(cell.usual);
        if length <= usual {
            return 0.0;
        }
        (1.0 - usual / length) * (pulled_m2 + SIDEWAYS * f64::from(cell.sideways_m2) * length)
    }

    /// Rows of numbers, as they are stored.
    pub(crate) fn numbers(&self) -> Vec<f32> {
        let numbers = |cell: &Cell| {
            let mut numbers = cell.middle.to_vec();
            numbers.extend(cell.precision.iter().flatten());
            numbers.extend(cell.pull.iter().flatten());
            numbers.extend([cell.sideways_m2, cell.usual]);
            numbers
        };
        self.cells.iter().flat_map(numbers).collect()
    }

    /// The reverse of [`Self::numbers`].
    ///
    /// # Errors
    /// Refuses numbers that are no cells.
    pub(crate) fn from_numbers(coverage: &Coverage, numbers: &[f32]) -> Result<Self> {
        let (rows, rest) = numbers.as_chunks::<NUMBERS>();
        let fits = rest.is_empty() && !rows.is_empty() && rows.len() <= coverage.centres.len();
        if !fits || rows.iter().any(|row| row[NUMBERS - 2] < 0.0 || row[NUMBERS - 1] <= 0.0) {
            return Err(Error::invalid("weights", "cells must be as many as centres at most, and usable"));
        }
        let cell = |row: &[f32; NUMBERS]| Cell {
            middle: std::array::from_fn(|edge| row[edge]),
            precision: std::array::from_fn(|one| std::array::from_fn(|other| row[4 + 4 * one + other])),
            pull: std::array::from_fn(|axis| std::array::from_fn(|edge| row[20 + 4 * axis + edge])),
            sideways_m2: row[28],
            usual: row[29],
        };
        let of_centre = cells_of(coverage, rows.len());
        Ok(Self { cells: rows.iter().map(cell).collect(), of_centre })
    }
}

/// Cell of each centre: the first centres are the cells' own.
fn cells_of(coverage: &Coverage, count: usize) -> Vec<u8> {
    let coarse = coverage.coarse(count);
    coverage.boxes().map(|drawn| drawn.map_or(0, |drawn| coarse.nearest(&drawn) as u8)).collect()
}

impl Cell {
    fn new(members: &[Vector4<f64>], encode: &Encode<'_>) -> Self {
        let (middle, mut covariance) = robust_moments(members);
        let [left, top, right, bottom] = middle.into();
        let drawn = BoundingBox::new(left, top, right - left, bottom - top);
        let (slopes, rebuilt) =
            drawn.map_or(([[0.0; 4]; 2], Matrix4::zeros()), |drawn| slopes_at(encode, &drawn));
        // Where the target's place may take a box is no deviation.
        covariance += rebuilt * rebuilt.transpose() * (PLACES_PX * PLACES_PX);
        let eigen = covariance.symmetric_eigen();
        let mut values: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
        values.sort_by(f64::total_cmp);
        // Two of the four directions are the place's; the other two are thin.
        let thin_px2 = values[1];
        let (mut thin, mut precision) = (Matrix4::zeros(), Matrix4::zeros());
        for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            thin += vector * vector.transpose() * (thin_px2 / value).min(1.0);
            precision += vector * vector.transpose() / *value;
        }
        let pull = slopes.map(|slopes| {
            let pulled = Vector4::from(slopes).transpose() * thin;
            std::array::from_fn(|edge| pulled[edge] as f32)
        });
        Self {
            middle: std::array::from_fn(|edge| middle[edge] as f32),
            precision: std::array::from_fn(|one| std::array::from_fn(|other| precision[(one, other)] as f32)),
            pull,
            sideways_m2: (thin_px2 * edge_variance_m2(&slopes) / 4.0) as f32,
            usual: 1.0,
        }
    }

    /// Squared Mahalanobis length of a box's deviation, and what it pulls, m2 per axis.
    #[inline]
    fn deviation(&self, bounding_box: &BoundingBox) -> (f64, f64) {
        let edges = edges_of(bounding_box);
        let off: [f32; 4] = std::array::from_fn(|edge| edges[edge] as f32 - self.middle[edge]);
        let dot = |row: &[f32; 4]| row.iter().zip(&off).map(|(one, other)| one * other).sum::<f32>();
        let length: f32 = self.precision.iter().zip(&off).map(|(row, off)| dot(row) * off).sum();
        let pulled_m2: f32 = self.pull.iter().map(|row| dot(row) * dot(row)).sum();
        (f64::from(length), 0.5 * f64::from(pulled_m2))
    }
}

/// Mean and covariance with boxes far off counted less, from medians on.
fn robust_moments(members: &[Vector4<f64>]) -> (Vector4<f64>, Matrix4<f64>) {
    let mut middle = Vector4::from_fn(|edge, _| median(members.iter().map(|member| member[edge]).collect()));
    let mut covariance = Matrix4::zeros();
    for edge in 0..4 {
        let away = members.iter().map(|member| (member[edge] - middle[edge]).abs()).collect();
        covariance[(edge, edge)] = (1.48 * median(away)).powi(2) + 4.0 * ROUNDING_PX2;
    }
    for _ in 0..ROUNDS {
        let Some(inverse) = covariance.try_inverse() else { break };
        let (mut sum, mut squares, mut total) = (Vector4::zeros(), Matrix4::zeros(), 0.0);
        for member in members {
            let off = member - middle;
            let share = CREDIBLE / off.dot(&(inverse * off)).max(1e-9);
            let weight = if share < 1.0 { share * share } else { 1.0 };
            sum += off * weight;
            squares += off * off.transpose() * weight;
            total += weight;
        }
        let mean = sum / total;
        middle += mean;
        covariance = squares / total - mean * mean.transpose() + Matrix4::identity() * ROUNDING_PX2;
    }
    (middle, covariance)
}
