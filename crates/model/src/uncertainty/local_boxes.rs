//! A local model of the training boxes, for the error of boxes whose edges are not consistent.
//!
//! The boxes of a target on the ground lie near a two-dimensional surface in the space of their four
//! edges `x = (left, top, right, bottom)`. In each region of the image that surface is taken as flat: a
//! robust mean `m` and covariance `C` of the training boxes, to which the displacement along the
//! reconstructed box is added, so that a new position of the target is no inconsistency. With the
//! eigenvalues `l1 <= l2 <= l3 <= l4` of `C`, the two smallest belong to the *noise subspace*, in which
//! edges deviate only by the noise of the detector.
//!
//! For a box with `d^2 = (x - m)^T C^-1 (x - m)` above the nominal limit `D`, the encoder's Jacobian `J`
//! and `N = sum v_i v_i^T min(1, l2 / l_i)` (the projection on the noise subspace) give the additional
//! error variance per axis
//!
//! ```text
//! (1 - D / d^2) * (|J N (x - m)|^2 / 2 + ISOTROPIC_SHARE * d^2 * l2 * trace(J J^T) / 8)
//! ```
//!
//! whose second term is the fallback for a direction that the covariance determines poorly.

use nalgebra::{Matrix4, Vector4};

use super::coverage::Coverage;
use super::jacobian::{Encode, edge_variance_m2, edges_of, jacobian_at};
use crate::artifact::tensors::Tensors;
use crate::domain::{BoundingBox, Error, Result};
use crate::samples::rows::TrainingRow;
use crate::statistics::median;

/// Fewest training boxes per region.
const BOXES_PER_REGION: usize = 40;
/// The largest number of regions.
const MOST_REGIONS: usize = 64;
/// Least variance of an edge, px2, by its rounding to pixels.
const ROUNDING_PX2: f64 = 0.25;
/// `d^2` (4 degrees of freedom, 95 %) beyond which a box is down-weighted in the robust moments.
const NOMINAL_DISTANCE: f64 = 9.5;
/// Iterations of the robust moments.
const ITERATIONS: usize = 12;
/// The nominal limit `D` is the larger of these quantiles of the training boxes' `d^2`, each times its
/// factor.
const NOMINAL_QUANTILES: [(f64, f64); 2] = [(0.7, 4.0), (0.99, 1.5)];
/// Share of `d^2` that counts in the mean direction instead of the exact one.
pub(crate) const ISOTROPIC_SHARE: f64 = 0.25;
/// Standard deviation of the displacement along the reconstructed box, px: positions where no training box
/// was are consistent too.
const DISPLACEMENT_PX: f64 = 40.0;
/// Numbers of a stored region: mean 4, precision 16, noise gain 8, isotropic variance 1, limit 1.
const NUMBERS: usize = 30;

/// One region of the image.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Region {
    /// `m`, px.
    pub(crate) mean: [f32; 4],
    /// `C^-1`, 1/px2.
    pub(crate) precision: [[f32; 4]; 4],
    /// `J N`, m/px.
    pub(crate) noise_gain: [[f32; 4]; 2],
    /// `l2 * trace(J J^T) / 8`, m2 per axis.
    pub(crate) isotropic_m2: f32,
    /// `D`.
    pub(crate) nominal_limit: f32,
}

/// All regions; the nearest centre of the coverage determines the region of a box.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct LocalBoxModel {
    pub(crate) regions: Vec<Region>,
    /// Region of each centre.
    pub(crate) of_centre: Vec<u8>,
}

impl LocalBoxModel {
    /// Fits the regions to the training boxes, with the Jacobian of an encoder at the mean of each.
    pub(crate) fn new(coverage: &Coverage, rows: &[TrainingRow], encode: &Encode<'_>) -> Self {
        let count = (rows.len() / BOXES_PER_REGION).clamp(1, MOST_REGIONS).min(coverage.len());
        let centres = coverage.truncated_to(count);
        let mut members: Vec<Vec<Vector4<f64>>> = vec![Vec::new(); count];
        for row in rows {
            members[centres.nearest(&row.bounding_box)].push(Vector4::from(edges_of(&row.bounding_box)));
        }
        let all: Vec<Vector4<f64>> = members.iter().flatten().copied().collect();
        let regions = members
            .iter()
            .map(|members| {
                // Few boxes do not determine the covariance of a region.
                Region::new(if members.len() < BOXES_PER_REGION / 4 { &all } else { members }, encode)
            })
            .collect();
        let mut model = Self { regions, of_centre: regions_of_centres(coverage, count) };
        model.set_nominal_limit(coverage, rows);
        model
    }

    fn set_nominal_limit(&mut self, coverage: &Coverage, rows: &[TrainingRow]) {
        let mut distances: Vec<f64> = rows
            .iter()
            .map(|row| {
                let region = usize::from(self.of_centre[coverage.nearest(&row.bounding_box)]);
                self.regions[region].deviation(&row.bounding_box).0
            })
            .collect();
        distances.sort_by(f64::total_cmp);
        let quantile = |share: f64| distances[((distances.len() - 1) as f64 * share) as usize];
        let limit =
            NOMINAL_QUANTILES.map(|(share, factor)| factor * quantile(share)).into_iter().fold(1.0, f64::max);
        for region in &mut self.regions {
            region.nominal_limit = limit as f32;
        }
    }

    /// The additional error variance per axis of a box whose nearest centre is given, m2; 0 for a box
    /// within the nominal limit.
    #[inline]
    pub(crate) fn inconsistent_variance_m2(&self, centre: usize, bounding_box: &BoundingBox) -> f64 {
        let region = self.of_centre.get(centre).and_then(|region| self.regions.get(usize::from(*region)));
        let Some(region) = region else {
            return 0.0;
        };
        let (distance, displacement_m2) = region.deviation(bounding_box);
        let limit = f64::from(region.nominal_limit);
        if distance <= limit {
            return 0.0;
        }
        let isotropic_m2 = ISOTROPIC_SHARE * f64::from(region.isotropic_m2) * distance;
        (1.0 - limit / distance) * (displacement_m2 + isotropic_m2)
    }

    pub(crate) fn put(&self, tensors: &mut Tensors) {
        let numbers = |region: &Region| {
            let mut numbers = region.mean.to_vec();
            numbers.extend(region.precision.iter().flatten());
            numbers.extend(region.noise_gain.iter().flatten());
            numbers.extend([region.isotropic_m2, region.nominal_limit]);
            numbers
        };
        let numbers = self.regions.iter().flat_map(numbers).collect();
        tensors.put_f32("cells", &[self.regions.len(), NUMBERS], numbers);
    }

    /// The stored regions; none where the calibration has none.
    ///
    /// # Errors
    /// Names `weights` if the numbers are not those of regions.
    pub(crate) fn take(tensors: &mut Tensors, coverage: &Coverage) -> Result<Self> {
        let Some(count) = tensors.rows("cells") else {
            return Ok(Self::default());
        };
        let numbers = tensors.take_f32("cells", &[count, NUMBERS])?;
        let (rows, rest) = numbers.as_chunks::<NUMBERS>();
        let fits = rest.is_empty() && !rows.is_empty() && rows.len() <= coverage.len();
        if !fits || rows.iter().any(|row| row[NUMBERS - 2] < 0.0 || row[NUMBERS - 1] <= 0.0) {
            return Err(Error::invalid("weights", "cells must be as many as centres at most, and usable"));
        }
        let region = |row: &[f32; NUMBERS]| Region {
            mean: std::array::from_fn(|edge| row[edge]),
            precision: std::array::from_fn(|one| std::array::from_fn(|other| row[4 + 4 * one + other])),
            noise_gain: std::array::from_fn(|axis| std::array::from_fn(|edge| row[20 + 4 * axis + edge])),
            isotropic_m2: row[28],
            nominal_limit: row[29],
        };
        let of_centre = regions_of_centres(coverage, rows.len());
        Ok(Self { regions: rows.iter().map(region).collect(), of_centre })
    }
}

/// Region of each centre: the first centres are those of the regions.
fn regions_of_centres(coverage: &Coverage, count: usize) -> Vec<u8> {
    let centres = coverage.truncated_to(count);
    let region = |centre: Option<BoundingBox>| centre.map_or(0, |centre| centres.nearest(&centre) as u8);
    coverage.boxes().map(region).collect()
}

impl Region {
    fn new(members: &[Vector4<f64>], encode: &Encode<'_>) -> Self {
        let (mean, mut covariance) = robust_moments(members);
        let [left, top, right, bottom] = mean.into();
        let mean_box = BoundingBox::new(left, top, right - left, bottom - top);
        let (jacobian, reconstruction) =
            mean_box.map_or(([[0.0; 4]; 2], Matrix4::zeros()), |mean_box| jacobian_at(encode, &mean_box));
        covariance += reconstruction * reconstruction.transpose() * (DISPLACEMENT_PX * DISPLACEMENT_PX);
        let eigen = covariance.symmetric_eigen();
        let mut values: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
        values.sort_by(f64::total_cmp);
        let noise_px2 = values[1];
        let (mut noise_projection, mut precision) = (Matrix4::zeros(), Matrix4::zeros());
        for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            noise_projection += vector * vector.transpose() * (noise_px2 / value).min(1.0);
            precision += vector * vector.transpose() / *value;
        }
        let noise_gain = jacobian.map(|axis| {
            let gain = Vector4::from(axis).transpose() * noise_projection;
            std::array::from_fn(|edge| gain[edge] as f32)
        });
        Self {
            mean: std::array::from_fn(|edge| mean[edge] as f32),
            precision: std::array::from_fn(|one| std::array::from_fn(|other| precision[(one, other)] as f32)),
            noise_gain,
            isotropic_m2: (noise_px2 * edge_variance_m2(&jacobian) / 4.0) as f32,
            nominal_limit: 1.0,
        }
    }

    /// `d^2`, and `|J N (x - m)|^2 / 2` (m2 per axis).
    #[inline]
    fn deviation(&self, bounding_box: &BoundingBox) -> (f64, f64) {
        let edges = edges_of(bounding_box);
        let deviation: [f32; 4] = std::array::from_fn(|edge| edges[edge] as f32 - self.mean[edge]);
        let dot = |row: &[f32; 4]| row.iter().zip(&deviation).map(|(one, other)| one * other).sum::<f32>();
        let distance: f32 =
            self.precision.iter().zip(&deviation).map(|(row, deviation)| dot(row) * deviation).sum();
        let displacement_m2: f32 = self.noise_gain.iter().map(|row| dot(row) * dot(row)).sum();
        (f64::from(distance), 0.5 * f64::from(displacement_m2))
    }
}

/// Mean and covariance with down-weighted outliers (an M-estimator of location and scatter; Maronna 1976),
/// starting from medians.
fn robust_moments(members: &[Vector4<f64>]) -> (Vector4<f64>, Matrix4<f64>) {
    let mut mean = Vector4::from_fn(|edge, _| median(members.iter().map(|member| member[edge]).collect()));
    let mut covariance = Matrix4::zeros();
    for edge in 0..4 {
        let deviations = members.iter().map(|member| (member[edge] - mean[edge]).abs()).collect();
        covariance[(edge, edge)] = (1.48 * median(deviations)).powi(2) + 4.0 * ROUNDING_PX2;
    }
    for _ in 0..ITERATIONS {
        let Some(inverse) = covariance.try_inverse() else { break };
        let (mut sum, mut squares, mut total) = (Vector4::zeros(), Matrix4::zeros(), 0.0);
        for member in members {
            let deviation = member - mean;
            let share = NOMINAL_DISTANCE / deviation.dot(&(inverse * deviation)).max(1e-9);
            let weight = if share < 1.0 { share * share } else { 1.0 };
            sum += deviation * weight;
            squares += deviation * deviation.transpose() * weight;
            total += weight;
        }
        let step = sum / total;
        mean += step;
        covariance = squares / total - step * step.transpose() + Matrix4::identity() * ROUNDING_PX2;
    }
    (mean, covariance)
}
