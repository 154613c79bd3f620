//! A predictor as tensors and scalars of a model, and back.

use super::box_plausibility::{BoxPlausibility, Cell, MAX_CELLS};
use super::candidate::MAX_INDUCING;
use super::groups::GROUPS;
use super::kernel::{InputScales, LengthScales};
use super::predictor::{CoefficientDeviation, MAX_RANK, PositionMap, Predictor, QUANTILES};
use super::projective_mean::{COEFFICIENTS, ProjectiveMean};
use crate::artifact::ModelParts;
use crate::domain::{Error, FeatureScale, Result};
use crate::encoder::features::FEATURES;

/// Maps of a mixture at most.
const MAX_MAPS: usize = 4;
/// Numbers of a cell: centre 2, coefficients 6, whitening 3, leverage 6.
/// Weight, centre 2, spread, residual variance and two length scales before the mean's coefficients.
const MEAN_SCALARS: usize = 7;
const CELL_NUMBERS: usize = 17;
const MAPS: &str = "gaussian_process.maps";
pub(super) const WIDENING: &str = "gaussian_process.widening";
const SHARED_BIAS: &str = "gaussian_process.shared_bias_m2";

impl Predictor {
    /// Scaling of the projective mean's inputs, for the metadata.
    pub(crate) fn features(&self) -> Vec<FeatureScale> {
        let scales = self.maps.first().map_or([[0.0, 1.0]; 4], |map| map.mean.scales_px);
        let feature = |(name, [centre, unit]): (&str, [f64; 2])| FeatureScale {
            feature: name.to_owned(),
            offset: centre,
            factor: 1.0 / unit,
        };
        FEATURES.into_iter().zip(scales).map(feature).collect()
    }

    /// Adds the predictor to a model whose features are [`Self::features`].
    pub(crate) fn put(&self, parts: &mut ModelParts) {
        parts.set(MAPS, self.maps.len() as f64);
        parts.set(WIDENING, self.widening);
        parts.set(SHARED_BIAS, self.shared_bias_m2);
        let tensors = &mut parts.tensors;
        tensors.put_f64("input_scales", &[4, 2], self.input_scales.0.concat());
        tensors.put_f64("edge_px2", &[4, 4], self.edge_px2.to_vec());
        tensors.put_f64("r95_quantiles", &[QUANTILES], self.quantiles.to_vec());
        self.plausibility.put(parts);
        for (at, map) in self.maps.iter().enumerate() {
            map.put(&format!("map{at}."), parts);
        }
    }

    /// Takes the predictor out of a model.
    ///
    /// # Errors
    /// Names the tensor or scalar that is missing or cannot be used.
    pub(crate) fn take(parts: &mut ModelParts) -> Result<Self> {
        let count = parts.positive_parameter(MAPS)?;
        if !(1.0..=MAX_MAPS as f64).contains(&count) {
            return Err(Error::invalid(
                format!("metadata.parameters.{MAPS}"),
                format!("must be from 1 to {MAX_MAPS}"),
            ));
        }
        let scales = parts.scales(FEATURES)?.map(|scale| [scale.offset, 1.0 / scale.factor]);
        let input_scales = pairs(&parts.tensors.take_f64("input_scales", &[4, 2])?);
        if input_scales.iter().any(|[_, unit]| *unit <= 0.0) {
            return Err(invalid("input_scales must have units above 0"));
        }
        let edge_px2 = parts.tensors.take_f64("edge_px2", &[4, 4])?;
        let quantiles = parts.tensors.take_f64("r95_quantiles", &[QUANTILES])?;
        if quantiles.iter().any(|quantile| *quantile <= 0.0) {
            return Err(invalid("r95_quantiles must be above 0"));
        }
        let maps = (0..count as usize)
            .map(|at| PositionMap::take(&format!("map{at}."), scales, parts))
            .collect::<Result<Vec<PositionMap>>>()?;
        Ok(Self {
            maps,
            input_scales: InputScales(input_scales),
            edge_px2: std::array::from_fn(|at| edge_px2[at]),
            widening: parts.positive_parameter(WIDENING)?,
            shared_bias_m2: parts.parameter(SHARED_BIAS)?.max(0.0),
            quantiles: std::array::from_fn(|at| quantiles[at]),
            plausibility: BoxPlausibility::take(parts)?,
        })
    }
}

impl PositionMap {
    fn put(&self, prefix: &str, parts: &mut ModelParts) {
        let (points, rank) = (self.inducing.len(), self.rank);
        let name = |own: &str| format!("{prefix}{own}");
        let tensors = &mut parts.tensors;
        let ProjectiveMean { centre_m, spread_m, coefficients, .. } = &self.mean;
        let LengthScales { place, size } = self.lengths;
        let mut mean = vec![self.weight, centre_m[0], centre_m[1], *spread_m, self.residual_m2, place, size];
        mean.extend(coefficients);
        tensors.put_f64(name("mean"), &[mean.len()], mean);
        if self.step != [0.0; COEFFICIENTS] {
            tensors.put_f64(name("step"), &[COEFFICIENTS], self.step.to_vec());
        }
        tensors.put_f32(name("tangent_factor"), &[COEFFICIENTS, COEFFICIENTS], f32s(&self.tangent_factor));
        if !self.deviations.is_empty() {
            let width = COEFFICIENTS + 2 * rank;
            let numbers = self.deviations.iter().flat_map(|deviation| {
                let CoefficientDeviation { tangent, kernel } = deviation;
                tangent.iter().chain(&kernel[0]).chain(&kernel[1]).map(|value| *value as f32)
            });
            tensors.put_f32(name("deviations"), &[self.deviations.len(), width], numbers.collect());
        }
        if rank == 0 {
            return;
        }
        tensors.put_f32(name("inducing"), &[points, 4], f32s(&self.inducing.concat()));
        tensors.put_f32(name("basis"), &[points, rank], f32s(&self.basis));
        tensors.put_f32(name("determined"), &[rank], f32s(&self.determined));
        tensors.put_f64(name("point_weights"), &[2, points], self.point_weights.concat());
        tensors.put_f32(name("absorbed"), &[2, rank, COEFFICIENTS], f32s(&self.absorbed.concat()));
    }

    fn take(prefix: &str, scales_px: [[f64; 2]; 4], parts: &mut ModelParts) -> Result<Self> {
        let name = |own: &str| format!("{prefix}{own}");
        let tensors = &mut parts.tensors;
        let mean = tensors.take_f64(&name("mean"), &[MEAN_SCALARS + COEFFICIENTS])?;
        let (weight, spread_m) = (mean[0], mean[3]);
        if !(0.0..=1.0).contains(&weight) || spread_m <= 0.0 || mean[5] <= 0.0 || mean[6] <= 0.0 {
            return Err(invalid(&format!("{prefix}mean must have a weight from 0 to 1 and scales above 0")));
        }
        let projective = ProjectiveMean {
            scales_px,
            centre_m: [mean[1], mean[2]],
            spread_m,
            coefficients: std::array::from_fn(|at| mean[MEAN_SCALARS + at]),
        };
        let tangent_factor = f64s(&tensors.take_f32(&name("tangent_factor"), &[COEFFICIENTS, COEFFICIENTS])?);
        let points = tensors.rows(&name("inducing")).unwrap_or(0);
        let rank = tensors.rows(&name("determined")).unwrap_or(0);
        if points > MAX_INDUCING || rank > MAX_RANK {
            return Err(invalid(&format!("{prefix} has too many inducing points or directions")));
        }
        let mut map = Self::without_kernel(weight, projective, tangent_factor);
        if tensors.rows(&name("step")).is_some() {
            let step = tensors.take_f64(&name("step"), &[COEFFICIENTS])?;
            map.step = std::array::from_fn(|at| step[at]);
        }
        map.residual_m2 = mean[4].max(0.0);
        map.lengths = LengthScales { place: mean[5], size: mean[6] };
        if rank > 0 {
            let inducing = f64s(&tensors.take_f32(&name("inducing"), &[points, 4])?);
            map.inducing = inducing.as_chunks().0.to_vec();
            map.rank = rank;
            map.basis = f64s(&tensors.take_f32(&name("basis"), &[points, rank])?);
            map.determined = f64s(&tensors.take_f32(&name("determined"), &[rank])?);
            map.point_weights = halves(&tensors.take_f64(&name("point_weights"), &[2, points])?);
            map.absorbed = halves(&f64s(&tensors.take_f32(&name("absorbed"), &[2, rank, COEFFICIENTS])?));
        }
        let deviations = tensors.rows(&name("deviations")).unwrap_or(0);
        if deviations > GROUPS.max(2) {
            return Err(invalid(&format!("{prefix}deviations must be at most {GROUPS}")));
        }
        if deviations > 0 {
            let width = COEFFICIENTS + 2 * rank;
            let numbers = f64s(&tensors.take_f32(&name("deviations"), &[deviations, width])?);
            map.deviations = numbers
                .chunks_exact(width)
                .map(|own| CoefficientDeviation {
                    tangent: std::array::from_fn(|at| own[at]),
                    kernel: halves(&own[COEFFICIENTS..]),
                })
                .collect();
        }
        Ok(map)
    }
}

impl BoxPlausibility {
    fn put(&self, parts: &mut ModelParts) {
        let numbers = self.cells.iter().flat_map(|cell| {
            let Cell { centre, coefficients, whitening, leverage } = cell;
            centre.iter().chain(coefficients.as_flattened()).chain(whitening).chain(leverage)
        });
        let numbers = numbers.map(|value| *value as f32).collect();
        let tensors = &mut parts.tensors;
        tensors.put_f32("box_cells", &[self.cells.len(), CELL_NUMBERS], numbers);
        let mut scales = self.scales_px.concat();
        scales.extend(self.normal);
        scales.extend(self.recent_whitening);
        tensors.put_f64("box_limits", &[scales.len()], scales);
    }

    fn take(parts: &mut ModelParts) -> Result<Self> {
        let tensors = &mut parts.tensors;
        let count = tensors.rows("box_cells").unwrap_or(0);
        if count == 0 || count > MAX_CELLS {
            return Err(invalid(&format!("must have 1 to {MAX_CELLS} box_cells")));
        }
        let numbers = f64s(&tensors.take_f32("box_cells", &[count, CELL_NUMBERS])?);
        let limits = tensors.take_f64("box_limits", &[9])?;
        if limits[1] <= 0.0 || limits[3] <= 0.0 || limits[4] <= 0.0 || limits[5] <= 0.0 {
            return Err(invalid("box_limits must have units and limits above 0"));
        }
        let cell = |own: &[f64]| Cell {
            centre: [own[0], own[1]],
            coefficients: [[own[2], own[3], own[4]], [own[5], own[6], own[7]]],
            whitening: [own[8], own[9], own[10]],
            leverage: std::array::from_fn(|at| own[11 + at]),
        };
        Ok(Self {
            scales_px: [[limits[0], limits[1]], [limits[2], limits[3]]],
            cells: numbers.chunks_exact(CELL_NUMBERS).map(cell).collect(),
            normal: [limits[4], limits[5]],
            recent_whitening: [limits[6], limits[7], limits[8]],
        })
    }
}

fn f32s(values: &[f64]) -> Vec<f32> {
    values.iter().map(|value| *value as f32).collect()
}

fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|value| f64::from(*value)).collect()
}

fn pairs(values: &[f64]) -> [[f64; 2]; 4] {
    std::array::from_fn(|at| [values[2 * at], values[2 * at + 1]])
}

fn halves(values: &[f64]) -> [Vec<f64>; 2] {
    let (one, other) = values.split_at(values.len() / 2);
    [one.to_vec(), other.to_vec()]
}

fn invalid(message: &str) -> Error {
    Error::invalid("weights", message)
}
