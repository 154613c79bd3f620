//! The answer: position, covariance and 95 % radius of one box, by plain loops without allocation.
//!
//! The variance is taken in the eigenbasis of what training has determined of the kernel's weights:
//! q = U_r^T L^-1 k(x), with U the eigenvectors of Phi^T Phi. Directions that are left out of q keep their prior,
//! which never makes the variance smaller. The mean has all weights.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::box_plausibility::{BoxPlausibility, Deviation, RecentBoxes};
use super::candidate::MapCandidate;
use super::edge_noise::{by_edge, edges_px, position_noise_m2};
use super::f_distribution::f_quantile;
use super::kernel::{InputScales, LengthScales};
use super::projective_mean::{Box4, COEFFICIENTS, EvaluatedMean, ProjectiveMean};

/// Directions of the kernel's weights at most.
pub(crate) const MAX_RANK: usize = 40;
/// A direction is left out where training takes away less than this share of its prior variance.
const MIN_DETERMINED: f64 = 0.02;
/// Points of the radius' table, between one and two degrees of freedom.
pub(crate) const QUANTILES: usize = 5;
/// For an implausible box the answer moves by this share of its weight toward that of the plausible box.
pub(crate) const SHRINKAGE: f64 = 0.5;
/// Share of the squared distance between its edges and the plausible ones that each edge may be wrong by.
pub(crate) const UNEXPLAINED_SHARE: f64 = 0.2;

/// Parts of the stated error that are not in the maps, and the test of boxes.
pub(crate) struct Stated {
    pub(crate) edge_px2: [f64; 16],
    pub(crate) shared_bias_m2: f64,
    pub(crate) freedom: f64,
    pub(crate) plausibility: BoxPlausibility,
}

/// One deviation of the jackknife: of the tangent, and of the kernel weights per axis.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CoefficientDeviation {
    pub(crate) tangent: [f64; COEFFICIENTS],
    pub(crate) kernel: [Vec<f64>; 2],
}

/// One map of the mixture.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PositionMap {
    /// Weights of all maps sum to 1.
    pub(crate) weight: f64,
    /// The ratio about which the map was linearised.
    pub(crate) mean: ProjectiveMean,
    /// The solution less the coefficients of `mean`. The map answers by the tangent of `mean`, for its kernel weights, its
    /// covariance and its calibration belong to that tangent.
    pub(crate) step: [f64; COEFFICIENTS],
    pub(crate) lengths: LengthScales,
    /// Prior variance of the residual, m2.
    pub(crate) residual_m2: f64,
    pub(crate) inducing: Vec<[f64; 4]>,
    pub(crate) rank: usize,
    /// Per inducing point its share in each direction: m rows of `rank`.
    pub(crate) basis: Vec<f64>,
    /// Share of each direction's prior variance that training takes away.
    pub(crate) determined: Vec<f64>,
    /// The part that the kernel takes over from the tangent: per axis, `rank` rows of 14.
    pub(crate) absorbed: [Vec<f64>; 2],
    /// Lower Cholesky factor of the tangent coefficients' covariance, 14 rows of 14.
    pub(crate) tangent_factor: Vec<f64>,
    /// Scaled so that the sum of squares is the variance to add.
    pub(crate) deviations: Vec<CoefficientDeviation>,
    /// Kernel weights per axis and inducing point, m: all of them, for the answer is the mean that was calibrated.
    pub(crate) point_weights: [Vec<f64>; 2],
}

/// A fitted model, ready to answer.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Predictor {
    pub(crate) maps: Vec<PositionMap>,
    pub(crate) input_scales: InputScales,
    /// Covariance of left, top, right and bottom, px2.
    pub(crate) edge_px2: [f64; 16],
    /// Factor on the maps' covariance.
    pub(crate) widening: f64,
    pub(crate) shared_bias_m2: f64,
    /// Quantiles of F for numerators of 1, 1.25, ... 2 degrees of freedom.
    pub(crate) quantiles: [f64; QUANTILES],
    pub(crate) plausibility: BoxPlausibility,
}

/// The position of one box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MapPrediction {
    /// East and north, m.
    pub(crate) position_m: [f64; 2],
    /// East, cross, north, m2.
    pub(crate) covariance_m2: [f64; 3],
    /// Radius that holds the truth with 95 %, in standard deviations per axis (the root of half the
    /// covariance's trace).
    pub(crate) r95_scale: f64,
    /// The part of it that is new with each box: east, cross, north, m2.
    pub(crate) box_noise_m2: [f64; 3],
    /// How the box deviates from those of training.
    pub(crate) deviation: Deviation,
}

/// The terms of one map for one box.
struct MapTerms {
    evaluation: EvaluatedMean,
    q: [f64; MAX_RANK],
    position_m: [f64; 2],
    /// Derivatives by foot u, foot v, width, height, m per px.
    jacobian: [[f64; 4]; 2],
}

/// The directions that the map's covariance depends on.
struct Directions {
    /// Prior variance of the residual, m2.
    prior_m2: f64,
    q: [f64; MAX_RANK],
    /// Derivatives of east and north by the coefficients.
    tangent: [[f64; COEFFICIENTS]; 2],
}

/// The mixture of all maps for one box.
pub(super) struct Mixture {
    pub(super) position_m: [f64; 2],
    /// Covariance of the maps and of their differences, m2.
    pub(super) map_m2: [f64; 3],
    /// Derivatives by left, top, right, bottom, m per px.
    pub(super) by_edge: [[f64; 4]; 2],
}

impl MapPrediction {
    /// Mean variance per axis, m2.
    #[inline]
    pub(crate) fn variance_m2(&self) -> f64 {
        0.5 * (self.covariance_m2[0] + self.covariance_m2[2])
    }
}

impl PositionMap {
    /// `None` for matrices that are not positive definite.
    pub(crate) fn new(
        candidate: &MapCandidate,
        deviations: &[(DVector<f64>, [DVector<f64>; 2])],
        weight: f64,
    ) -> Option<Self> {
        let MapCandidate { parameters, posterior, inducing, .. } = candidate;
        let (directions, determined) = determined_directions(candidate);
        let residual_m = if inducing.is_empty() { 0.0 } else { parameters.residual_m };
        let inverse_factor = parameters.lengths.inverse_factor(inducing)?;
        let basis = directions.transpose() * &inverse_factor * residual_m;
        let project = |weights: &DVector<f64>| (directions.transpose() * weights).as_slice().to_vec();
        let deviations = deviations.iter().map(|(tangent, kernel)| CoefficientDeviation {
            tangent: std::array::from_fn(|at| tangent[at]),
            kernel: std::array::from_fn(|axis| project(&kernel[axis])),
        });
        let tangent_factor = posterior.tangent_covariance.clone().cholesky()?.unpack();
        let mean = candidate.mean.clone();
        let step = std::array::from_fn(|at| posterior.tangent[at] - mean.coefficients[at]);
        let tangent_factor = tangent_factor.transpose().as_slice().to_vec();
        Some(Self {
            step,
            lengths: parameters.lengths,
            residual_m2: residual_m * residual_m,
            inducing: inducing.clone(),
            rank: determined.len(),
            basis: basis.as_slice().to_vec(),
            determined,
            point_weights: std::array::from_fn(|axis| {
                (inverse_factor.tr_mul(&posterior.kernel[axis]) * residual_m).as_slice().to_vec()
            }),
            absorbed: std::array::from_fn(|axis| {
                (directions.transpose() * &posterior.absorbed[axis]).transpose().as_slice().to_vec()
            }),
            deviations: deviations.collect(),
            ..Self::without_kernel(weight, mean, tangent_factor)
        })
    }

    /// A map without a residual.
    pub(crate) const fn without_kernel(weight: f64, mean: ProjectiveMean, tangent_factor: Vec<f64>) -> Self {
        Self {
            weight,
            mean,
            step: [0.0; COEFFICIENTS],
            lengths: LengthScales { place: 1.0, size: 1.0 },
            residual_m2: 0.0,
            inducing: Vec::new(),
            rank: 0,
            basis: Vec::new(),
            determined: Vec::new(),
            absorbed: [Vec::new(), Vec::new()],
            tangent_factor,
            deviations: Vec::new(),
            point_weights: [Vec::new(), Vec::new()],
        }
    }

    #[inline]
    fn terms(&self, sides: &Box4, input: &[f64; 4], by_px: &[f64; 4]) -> MapTerms {
        let mut q = [0.0; MAX_RANK];
        let (mut residual_m, mut gradient) = ([0.0; 2], [[0.0; 4]; 2]);
        for (point, inducing) in self.inducing.iter().enumerate() {
            let (correlation, slope) = self.lengths.matern(input, inducing);
            let own = &self.basis[point * self.rank..(point + 1) * self.rank];
            for (q, basis) in q.iter_mut().zip(own) {
                *q += correlation * basis;
            }
            for axis in 0..2 {
                let weight = self.point_weights[axis][point];
                residual_m[axis] += weight * correlation;
                let weighted = weight * slope;
                for side in 0..4 {
                    gradient[axis][side] += weighted * (input[side] - inducing[side]);
                }
            }
        }
        let evaluation = self.mean.evaluate(sides);
        let moved_m = evaluation.moved_m(&self.step);
        let mut jacobian = self.mean.jacobian(&evaluation);
        let of_move = self.mean.jacobian_of_move(&evaluation, &self.step, &jacobian);
        let squares = [self.lengths.place.powi(-2), self.lengths.size.powi(-2)];
        for axis in 0..2 {
            for side in 0..4 {
                jacobian[axis][side] +=
                    of_move[axis][side] + gradient[axis][side] * squares[side / 2] * by_px[side];
            }
        }
        let position_m = [0, 1].map(|axis| {
            self.mean.centre_m[axis] + evaluation.offset_m[axis] + moved_m[axis] + residual_m[axis]
        });
        MapTerms { evaluation, q, position_m, jacobian }
    }

    /// Where a box is among the directions that are uncertain.
    #[inline]
    fn directions(&self, terms: &MapTerms) -> Directions {
        Directions { prior_m2: self.residual_m2, q: terms.q, tangent: terms.evaluation.tangent() }
    }

    /// The same of the difference between the answers to two boxes, with the kernel's inputs of both.
    fn directions_between(&self, [from, to]: [(&MapTerms, &[f64; 4]); 2]) -> Directions {
        let [one, other] = [from, to].map(|(terms, _)| self.directions(terms));
        let (correlation, _) = self.lengths.matern(from.1, to.1);
        Directions {
            prior_m2: 2.0 * (1.0 - correlation) * self.residual_m2,
            q: std::array::from_fn(|at| other.q[at] - one.q[at]),
            tangent: std::array::from_fn(|axis| {
                std::array::from_fn(|at| other.tangent[axis][at] - one.tangent[axis][at])
            }),
        }
    }

    /// Covariance of the map: the residual's, the tangent's, and the jackknife's, m2.
    #[inline]
    fn covariance_m2(&self, Directions { prior_m2, q, tangent }: &Directions) -> [f64; 3] {
        let mut own_m2 = *prior_m2;
        for (q, determined) in q.iter().zip(&self.determined) {
            own_m2 -= determined * q * q;
        }
        let own_m2 = own_m2.max(0.0);
        let mut whitened = [[0.0; COEFFICIENTS]; 2];
        for axis in 0..2 {
            let mut left = tangent[axis];
            for (direction, q) in q.iter().enumerate().take(self.rank) {
                let absorbed = &self.absorbed[axis][direction * COEFFICIENTS..(direction + 1) * COEFFICIENTS];
                for (left, absorbed) in left.iter_mut().zip(absorbed) {
                    *left -= q * absorbed;
                }
            }
            for (row, left) in left.iter().enumerate() {
                let factor = &self.tangent_factor[row * COEFFICIENTS..(row + 1) * COEFFICIENTS];
                for (value, factor) in whitened[axis].iter_mut().zip(factor) {
                    *value += left * factor;
                }
            }
        }
        let mut sum = self.jackknife_m2(q, tangent);
        sum[0] += own_m2;
        sum[2] += own_m2;
        let [east, north] = whitened;
        for (east, north) in east.into_iter().zip(north) {
            add_outer(&mut sum, [east, north], 1.0);
        }
        sum
    }

    #[inline]
    fn jackknife_m2(&self, q: &[f64; MAX_RANK], tangent: &[[f64; COEFFICIENTS]; 2]) -> [f64; 3] {
        let mut sum = [0.0; 3];
        for deviation in &self.deviations {
            let moved_m = [0, 1].map(|axis| {
                let by_tangent: f64 =
                    tangent[axis].iter().zip(&deviation.tangent).map(|(one, other)| one * other).sum();
                let by_kernel: f64 =
                    q.iter().zip(&deviation.kernel[axis]).map(|(one, other)| one * other).sum();
                by_tangent + by_kernel
            });
            add_outer(&mut sum, moved_m, 1.0);
        }
        sum
    }
}

impl Predictor {
    pub(crate) fn new(maps: Vec<PositionMap>, input_scales: InputScales, stated: Stated) -> Self {
        Self {
            maps,
            input_scales,
            edge_px2: stated.edge_px2,
            widening: 1.0,
            shared_bias_m2: stated.shared_bias_m2,
            quantiles: std::array::from_fn(|at| {
                f_quantile(0.95, 1.0 + at as f64 / (QUANTILES - 1) as f64, stated.freedom)
            }),
            plausibility: stated.plausibility,
        }
    }

    /// Position and error of a box; `recent`, of its target, takes it in.
    pub(crate) fn predict(&self, sides: &Box4, recent: Option<&mut RecentBoxes>) -> MapPrediction {
        let mixture = self.mix(sides, true);
        let mut position_m = mixture.position_m;
        let noise_m2 = position_noise_m2(&mixture.by_edge, &self.edge_px2);
        let mut covariance_m2: [f64; 3] =
            std::array::from_fn(|at| self.widening * mixture.map_m2[at] + noise_m2[at]);
        covariance_m2[0] += self.shared_bias_m2;
        covariance_m2[2] += self.shared_bias_m2;
        let deviation = match recent {
            Some(recent) => self.plausibility.next_deviation(sides, recent),
            None => self.plausibility.deviation(sides),
        };
        if deviation.weight > 0.0 {
            let plausible = self.plausibility.nearest_plausible(sides, &deviation);
            let other_m = self.mix(&plausible, false).position_m;
            let moved_m =
                [0, 1].map(|axis| SHRINKAGE * deviation.weight * (other_m[axis] - position_m[axis]));
            add_outer(&mut covariance_m2, moved_m, 1.0);
            // Nothing says which edge is wrong: each may be by the root mean square of all.
            let moved_px2 = (edges_px(&plausible) - edges_px(sides)).norm_squared() / 4.0;
            for edge in 0..4 {
                let by_edge = [mixture.by_edge[0][edge], mixture.by_edge[1][edge]];
                add_outer(&mut covariance_m2, by_edge, UNEXPLAINED_SHARE * deviation.weight * moved_px2);
            }
            position_m = [position_m[0] + moved_m[0], position_m[1] + moved_m[1]];
        }
        MapPrediction {
            position_m,
            covariance_m2,
            r95_scale: self.r95_scale(&covariance_m2),
            box_noise_m2: noise_m2,
            deviation,
        }
    }

    /// The box that training has seen at the place of this one: the decoder.
    #[inline]
    pub(crate) fn reconstruct(&self, sides: &Box4, deviation: &Deviation) -> Box4 {
        self.plausibility.nearest_plausible(sides, deviation)
    }

    /// Mean variance per axis of the jackknife at a box, m2.
    pub(crate) fn jackknife_m2(&self, sides: &Box4) -> f64 {
        let (input, by_px) = (self.input_scales.input(sides), self.input_scales.slopes(sides));
        let of = |map: &PositionMap| {
            let Directions { q, tangent, .. } = map.directions(&map.terms(sides, &input, &by_px));
            let [east_m2, _, north_m2] = map.jackknife_m2(&q, &tangent);
            0.5 * map.weight * (east_m2 + north_m2)
        };
        self.maps.iter().map(of).sum()
    }

    /// Covariance of the error that the maps make in the distance between two boxes: east, cross, north, m2. An error that
    /// both boxes share, as that of all receivers, is not part of it.
    pub(crate) fn displacement_m2(&self, boxes: [&Box4; 2]) -> [f64; 3] {
        let (mut mean_m, mut second_m2) = ([0.0; 2], [0.0; 3]);
        for map in &self.maps {
            let inputs = boxes.map(|sides| self.input_scales.input(sides));
            let [from, to] =
                [0, 1].map(|at| map.terms(boxes[at], &inputs[at], &self.input_scales.slopes(boxes[at])));
            let covariance_m2 =
                map.covariance_m2(&map.directions_between([(&from, &inputs[0]), (&to, &inputs[1])]));
            for (sum, own) in second_m2.iter_mut().zip(covariance_m2) {
                *sum += map.weight * own;
            }
            let moved_m = [0, 1].map(|axis| to.position_m[axis] - from.position_m[axis]);
            mean_m = [0, 1].map(|axis| mean_m[axis] + map.weight * moved_m[axis]);
            add_outer(&mut second_m2, moved_m, map.weight);
        }
        add_outer(&mut second_m2, mean_m, -1.0);
        second_m2.map(|own| self.widening * own)
    }

    #[inline]
    pub(super) fn mix(&self, sides: &Box4, with_error: bool) -> Mixture {
        let (input, by_px) = (self.input_scales.input(sides), self.input_scales.slopes(sides));
        let (mut mean_m, mut second_m2) = ([0.0; 2], [0.0; 3]);
        let mut jacobian = [[0.0; 4]; 2];
        let mut first_m = None;
        for map in &self.maps {
            let terms = map.terms(sides, &input, &by_px);
            // Moments about the first map's position, so that small differences keep their digits.
            let origin_m = *first_m.get_or_insert(terms.position_m);
            let from_first_m = [terms.position_m[0] - origin_m[0], terms.position_m[1] - origin_m[1]];
            mean_m = [0, 1].map(|axis| mean_m[axis] + map.weight * from_first_m[axis]);
            if with_error {
                let covariance_m2 = map.covariance_m2(&map.directions(&terms));
                for (sum, own) in second_m2.iter_mut().zip(covariance_m2) {
                    *sum += map.weight * own;
                }
                add_outer(&mut second_m2, from_first_m, map.weight);
                for (sum, own) in jacobian.iter_mut().flatten().zip(terms.jacobian.iter().flatten()) {
                    *sum += map.weight * own;
                }
            }
        }
        add_outer(&mut second_m2, mean_m, -1.0);
        let origin_m = first_m.unwrap_or_default();
        Mixture {
            position_m: [origin_m[0] + mean_m[0], origin_m[1] + mean_m[1]],
            map_m2: second_m2,
            by_edge: jacobian.map(by_edge),
        }
    }

    /// Squared radius of 95 %: the trace times the quantile of F at the eigenvalues' own degrees of freedom
    /// (Welch and Satterthwaite).
    #[inline]
    fn r95_scale(&self, [east_m2, cross_m2, north_m2]: &[f64; 3]) -> f64 {
        let trace = east_m2 + north_m2;
        let squares = east_m2 * east_m2 + 2.0 * cross_m2 * cross_m2 + north_m2 * north_m2;
        let at = ((trace * trace / squares.max(1e-300) - 1.0).clamp(0.0, 1.0)) * (QUANTILES - 1) as f64;
        let low = (at as usize).min(QUANTILES - 2);
        let quantile =
            self.quantiles[low] + (at - low as f64) * (self.quantiles[low + 1] - self.quantiles[low]);
        (2.0 * quantile).sqrt()
    }
}

/// The directions of the kernel's weights that training determines, as columns, and the share of each
/// one's prior variance that it takes away.
fn determined_directions(candidate: &MapCandidate) -> (DMatrix<f64>, Vec<f64>) {
    let count = candidate.inducing.len();
    if count == 0 {
        return (DMatrix::zeros(0, 0), Vec::new());
    }
    let eigen = SymmetricEigen::new(candidate.total.kernel());
    let share = |at: usize| {
        let own = eigen.eigenvalues[at].max(0.0);
        own / (1.0 + own)
    };
    let mut order: Vec<usize> = (0..count).filter(|at| share(*at) >= MIN_DETERMINED).collect();
    order.sort_by(|one, other| share(*other).total_cmp(&share(*one)));
    order.truncate(MAX_RANK);
    let directions =
        DMatrix::from_fn(count, order.len(), |row, column| eigen.eigenvectors[(row, order[column])]);
    (directions, order.into_iter().map(share).collect())
}

#[inline]
fn add_outer(sum: &mut [f64; 3], [east, north]: [f64; 2], factor: f64) {
    sum[0] += factor * east * east;
    sum[1] += factor * east * north;
    sum[2] += factor * north * north;
}
