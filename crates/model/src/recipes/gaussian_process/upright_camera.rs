//! Geometry from boxes alone: an upright pinhole camera above flat ground.
//!
//! Targets of one kind are about equally tall, so the heights of their boxes over the image tell where
//! the horizon is and how large a target's height is against the camera's (Hoiem, Efros and Hebert 2008,
//! "Putting objects in perspective"). Square pixels and a centred principal point are assumed; the focal
//! length is known a priori within a factor. Fixes then need to tell little more than place and direction.
//!
//! Without the height ratio the parameters are one to one with the eight coefficients of a homography, so
//! what boxes say is a prior on these.

use nalgebra::{SMatrix, SVector};

use super::projective_mean::{Box4, FOOT_COEFFICIENTS, ProjectiveMean};
use crate::statistics::median;

/// Log focal length (px), pitch (rad, down), roll (rad), log of target height over camera height, log
/// camera height (m), yaw (rad), east and north of the camera less the centre of the positions (m), log
/// aspect ratio of the pixels.
pub(crate) const PARAMETERS: usize = 9;
/// Index of the height ratio, the one that a homography does not depend on.
const RATIO: usize = 3;
/// Parameters that boxes alone tell of.
const OF_BOXES: usize = 4;
/// Focal lengths that a search starts from, in image widths, and the prior's median and logarithmic sigma.
const FOCAL_LENGTHS: [f64; 5] = [0.5, 0.65, 0.85, 1.1, 1.45];
const FOCAL_PRIOR: (f64, f64) = (0.75, 0.35);
const START_PITCHES: [f64; 3] = [0.12, 0.3, 0.6];
/// Prior standard deviations of pitch about 0.25 and of roll about 0, rad.
const PITCH_PRIOR: (f64, f64) = (0.25, 0.4);
const ROLL_PRIOR: f64 = 0.035;
/// Standard deviation of the logarithm of the height between targets, and of one box's beside pixels.
const BETWEEN_TARGETS: f64 = 0.06;
const WITHIN_TARGET: f64 = 0.03;
/// Standard deviation of a box's height by the detector, px.
const HEIGHT_NOISE_PX: f64 = 3.0;
/// Boxes per target at most: neighbours say the same.
const BOXES_PER_TARGET: usize = 20;
/// Targets at most.
const MAX_TARGETS: usize = 500;
/// Boxes nearer to the border are cut by it, px.
const BORDER_PX: f64 = 3.0;
/// Differences of a real camera from the ideal one: standard deviations of log focal length, pitch, roll
/// and log height ratio that no number of boxes goes below.
const MODEL_ERROR: [f64; OF_BOXES] = [0.02, 0.003, 0.004, 0.01];
/// Prior standard deviation of the log aspect ratio; it also absorbs lens distortion.
const ASPECT_PRIOR: f64 = 0.02;
const ROUNDS: usize = 25;
/// Step of numerical derivatives.
const DIFFERENCE: f64 = 1e-5;
/// A Gauss-Newton step changes angles (rad) and logarithms by at most so much.
const MAX_STEP: f64 = 0.2;

pub(crate) type Parameters = SVector<f64, PARAMETERS>;
/// Derivatives of a homography's coefficients by the parameters but for the height ratio.
type Jacobian = SMatrix<f64, FOOT_COEFFICIENTS, FOOT_COEFFICIENTS>;
type Information = SMatrix<f64, PARAMETERS, PARAMETERS>;

/// Boxes that show whole targets, by target.
#[derive(Debug, Clone)]
pub(crate) struct UprightCamera {
    width_px: f64,
    height_px: f64,
    targets: Vec<Vec<Box4>>,
    /// Prior of the logarithm of a target's height in m: median, sigma.
    target_height: (f64, f64),
}

/// The evidence of boxes and priors about a set of parameters.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Evidence {
    /// Half the misfit, gradient of minus it, and information.
    pub(crate) misfit: f64,
    pub(crate) gradient: Parameters,
    pub(crate) information: Information,
}

/// A camera's rays in the roll-free frame.
struct Ray {
    right: f64,
    down: f64,
    forward: f64,
    x: f64,
    y: f64,
}

impl UprightCamera {
    /// From boxes (with their targets' sequence numbers, in order); `None` for fewer than 20 whole ones.
    /// `target_height_m` is the median height of a target with its logarithmic standard deviation.
    pub(crate) fn new(
        boxes: &[(u32, Box4)],
        (width_px, height_px): (f64, f64),
        target_height_m: (f64, f64),
    ) -> Option<Self> {
        let whole = |sides: &Box4| {
            let [u, v, width, height] = *sides;
            u - 0.5 * width > BORDER_PX
                && u + 0.5 * width < width_px - BORDER_PX
                && v - height > BORDER_PX
                && v < height_px - BORDER_PX
        };
        let mut targets: Vec<Vec<Box4>> = boxes
            .chunk_by(|one, next| one.0 == next.0)
            .map(|own| {
                let own: Vec<Box4> = own.iter().map(|(_, sides)| *sides).filter(whole).collect();
                let stride = own.len().div_ceil(BOXES_PER_TARGET).max(1);
                own.into_iter().step_by(stride).collect()
            })
            .filter(|own: &Vec<Box4>| !own.is_empty())
            .collect();
        let stride = targets.len().div_ceil(MAX_TARGETS).max(1);
        targets = targets.into_iter().step_by(stride).collect();
        let enough = targets.iter().map(Vec::len).sum::<usize>() >= 20;
        let target_height = (target_height_m.0.ln(), target_height_m.1);
        enough.then_some(Self { width_px, height_px, targets, target_height })
    }

    fn ray(&self, parameters: &Parameters, u: f64, v: f64) -> Ray {
        let focal_px = parameters[0].exp();
        let (x, y) = (
            (u - 0.5 * self.width_px) / focal_px,
            (v - 0.5 * self.height_px) / (focal_px * parameters[8].exp()),
        );
        let (sin_roll, cos_roll) = parameters[2].sin_cos();
        let (sin_pitch, cos_pitch) = parameters[1].sin_cos();
        let (right, along) = (x * cos_roll + y * sin_roll, y * cos_roll - x * sin_roll);
        Ray {
            right,
            down: along * cos_pitch + sin_pitch,
            forward: cos_pitch - along * sin_pitch,
            x: right,
            y: along,
        }
    }

    /// Log density of the focal length a priori, but for a constant.
    pub(crate) fn log_focal_prior(&self, parameters: &Parameters) -> f64 {
        let (focal, sigma) = FOCAL_PRIOR;
        -0.5 * ((parameters[0] - (focal * self.width_px).ln()) / sigma).powi(2)
    }

    /// Where the ray of a pixel meets the ground, in m to the right of and ahead of the camera; `None` beyond
    /// the horizon.
    pub(crate) fn ground_m(&self, parameters: &Parameters, u: f64, v: f64) -> Option<[f64; 2]> {
        let ray = self.ray(parameters, u, v);
        let camera_m = parameters[4].exp();
        (ray.down > 0.01).then(|| [camera_m * ray.right / ray.down, camera_m * ray.forward / ray.down])
    }

    /// Height in pixels of the box of a target of usual height whose foot is there; `None` beyond the
    /// horizon.
    fn box_height_px(&self, parameters: &Parameters, u: f64, v: f64) -> Option<f64> {
        let ray = self.ray(parameters, u, v);
        let (sin_roll, cos_roll) = parameters[2].sin_cos();
        let (sin_pitch, cos_pitch) = parameters[1].sin_cos();
        let lift = parameters[3].exp() * ray.down;
        let depth = 1.0 - lift * sin_pitch;
        if ray.down <= 1e-3 || depth <= 0.05 {
            return None;
        }
        let top = (ray.x / depth) * sin_roll + (ray.y - lift * cos_pitch) / depth * cos_roll;
        let foot = ray.x * sin_roll + ray.y * cos_roll;
        let height_px = (parameters[0] + parameters[8]).exp() * (foot - top);
        (height_px > 1.0).then_some(height_px)
    }

    /// Coefficients of the homography that the camera is, in the mean's scales; `None` where the centre of
    /// the feet is not on the ground.
    pub(crate) fn coefficients(
        &self,
        parameters: &Parameters,
        mean: &ProjectiveMean,
    ) -> Option<SVector<f64, FOOT_COEFFICIENTS>> {
        let [[u, u_unit], [v, v_unit], ..] = mean.scales_px;
        let at = [
            self.ray(parameters, u, v),
            self.ray(parameters, u + u_unit, v),
            self.ray(parameters, u, v + v_unit),
        ];
        if at[0].down <= 1e-3 {
            return None;
        }
        let linear = |of: fn(&Ray) -> f64| {
            let constant = of(&at[0]);
            [constant, of(&at[1]) - constant, of(&at[2]) - constant]
        };
        let (right, down, forward) =
            (linear(|ray| ray.right), linear(|ray| ray.down), linear(|ray| ray.forward));
        let camera_m = parameters[4].exp();
        let (sin_yaw, cos_yaw) = parameters[5].sin_cos();
        let mut coefficients = SVector::zeros();
        for term in 0..3 {
            let east =
                parameters[6] * down[term] + camera_m * (cos_yaw * right[term] + sin_yaw * forward[term]);
            let north =
                parameters[7] * down[term] + camera_m * (cos_yaw * forward[term] - sin_yaw * right[term]);
            coefficients[term] = east / down[0];
            coefficients[3 + term] = north / down[0];
            if term > 0 {
                coefficients[5 + term] = down[term] / down[0];
            }
        }
        Some(coefficients)
    }

    fn jacobian(&self, parameters: &Parameters, mean: &ProjectiveMean) -> Option<Jacobian> {
        let mut jacobian = Jacobian::zeros();
        for at in (0..PARAMETERS).filter(|at| *at != RATIO) {
            let mut moved = [*parameters; 2];
            moved[0][at] += DIFFERENCE;
            moved[1][at] -= DIFFERENCE;
            let difference = self.coefficients(&moved[0], mean)? - self.coefficients(&moved[1], mean)?;
            jacobian.set_column(at - usize::from(at > RATIO), &(difference / (2.0 * DIFFERENCE)));
        }
        Some(jacobian)
    }

    /// The camera whose homography is, to first order, the one with those coefficients, and whose height
    /// ratio suits the boxes. Angles and logarithms change by at most [`MAX_STEP`].
    pub(crate) fn moved_to(
        &self,
        parameters: &Parameters,
        mean: &ProjectiveMean,
        foot: &SVector<f64, FOOT_COEFFICIENTS>,
    ) -> Option<Parameters> {
        let apart = foot - self.coefficients(parameters, mean)?;
        let own = self.jacobian(parameters, mean)?.lu().solve(&apart)?;
        let mut step = own.insert_row(RATIO, 0.0);
        let largest =
            (0..PARAMETERS).filter(|at| *at < 6 || *at == 8).map(|at| step[at].abs()).fold(0.0, f64::max);
        if largest > MAX_STEP {
            step *= MAX_STEP / largest;
        }
        let mut moved = parameters + step;
        let evidence = self.evidence(&moved)?;
        moved[RATIO] += evidence.gradient[RATIO] / evidence.information[(RATIO, RATIO)];
        Some(moved)
    }

    /// Returns the evidence of boxes and priors; `None` where a box is beyond the horizon.
    pub(crate) fn evidence(&self, parameters: &Parameters) -> Option<Evidence> {
        let mut evidence = self.prior(parameters);
        for target in &self.targets {
            // Sherman and Morrison: one height per target, beside the noise of each box.
            let (mut information, mut weighted) = (Information::zeros(), Parameters::zeros());
            let (mut gradient, mut sum, mut total, mut misfit) = (Parameters::zeros(), 0.0, 0.0, 0.0);
            for sides in target {
                let (residual, slopes) = self.height_residual(parameters, sides)?;
                let variance = WITHIN_TARGET.powi(2) + (HEIGHT_NOISE_PX / sides[3]).powi(2);
                let square = residual * residual / (variance + BETWEEN_TARGETS.powi(2));
                let weight = 1.0 / ((1.0 + square / 9.0) * variance);
                information += weight * slopes * slopes.transpose();
                weighted += weight * slopes;
                gradient += weight * residual * slopes;
                sum += weight * residual;
                total += weight;
                misfit += weight * residual * residual;
            }
            let shared = 1.0 / (BETWEEN_TARGETS.powi(-2) + total);
            evidence.information += information - shared * weighted * weighted.transpose();
            evidence.gradient += gradient - shared * sum * weighted;
            evidence.misfit += 0.5 * (misfit - shared * sum * sum);
        }
        Some(evidence)
    }

    /// Log of observed over predicted height, and the derivatives of the predicted one.
    fn height_residual(&self, parameters: &Parameters, sides: &Box4) -> Option<(f64, Parameters)> {
        let [u, v, _, height_px] = *sides;
        let predicted = self.box_height_px(parameters, u, v)?.ln();
        let mut slopes = Parameters::zeros();
        for at in 0..OF_BOXES {
            let mut moved = *parameters;
            moved[at] += DIFFERENCE;
            slopes[at] = (self.box_height_px(&moved, u, v)?.ln() - predicted) / DIFFERENCE;
        }
        Some((height_px.ln() - predicted, slopes))
    }

    fn prior(&self, parameters: &Parameters) -> Evidence {
        let mut evidence =
            Evidence { misfit: 0.0, gradient: Parameters::zeros(), information: Information::zeros() };
        let mut add = |direction: Parameters, value: f64, centre: f64, sigma: f64| {
            let precision = 1.0 / (sigma * sigma);
            evidence.misfit += 0.5 * precision * (value - centre).powi(2);
            evidence.gradient += precision * (centre - value) * direction;
            evidence.information += precision * direction * direction.transpose();
        };
        let unit = |at: usize| Parameters::from_fn(|row, _| if row == at { 1.0 } else { 0.0 });
        let (focal, sigma) = FOCAL_PRIOR;
        add(unit(0), parameters[0], (focal * self.width_px).ln(), sigma);
        add(unit(1), parameters[1], PITCH_PRIOR.0, PITCH_PRIOR.1);
        add(unit(2), parameters[2], 0.0, ROLL_PRIOR);
        add(unit(8), parameters[8], 0.0, ASPECT_PRIOR);
        // Camera height times the ratio is the target's height.
        let (height, sigma) = self.target_height;
        add(unit(3) + unit(4), parameters[3] + parameters[4], height, sigma);
        evidence
    }

    /// Cameras that fit the boxes, one per focal length, without place and direction.
    pub(crate) fn starts(&self) -> Vec<Parameters> {
        FOCAL_LENGTHS
            .iter()
            .filter_map(|focal| self.start(focal * self.width_px))
            .map(|(_, start)| start)
            .collect()
    }

    fn start(&self, focal_px: f64) -> Option<(f64, Parameters)> {
        let from = |pitch: f64, ratio: f64| {
            let mut at = Parameters::zeros();
            (at[0], at[1], at[3]) = (focal_px.ln(), pitch, ratio);
            at[4] = self.target_height.0 - ratio;
            let mut value = self.evidence(&at)?;
            for _ in 0..ROUNDS {
                let free = value.information.fixed_view::<3, 3>(1, 1).into_owned();
                let right = value.gradient.fixed_rows::<3>(1).into_owned();
                let step = free.cholesky()?.solve(&right);
                let taken = (0..8).find_map(|halving| {
                    let mut next = at;
                    for row in 0..3 {
                        next[1 + row] += step[row] * 0.5_f64.powi(halving);
                    }
                    next[4] = self.target_height.0 - next[3];
                    self.evidence(&next).filter(|own| own.misfit < value.misfit).map(|own| (next, own))
                });
                let Some((next, own)) = taken else { break };
                let gain = value.misfit - own.misfit;
                (at, value) = (next, own);
                if gain < 1e-4 {
                    break;
                }
            }
            Some((value.misfit, at))
        };
        let ratios = [-2.5, -1.5, -0.8];
        START_PITCHES
            .iter()
            .flat_map(|pitch| ratios.iter().filter_map(|ratio| from(*pitch, *ratio)).collect::<Vec<_>>())
            .min_by(|one, other| one.0.total_cmp(&other.0))
    }

    /// Place and direction of a camera by robust least squares on fixes: a rotation and a shift, under
    /// Cauchy's loss.
    pub(crate) fn placed(
        &self,
        start: &Parameters,
        mean: &ProjectiveMean,
        boxes: &[Box4],
        labels_m: &[[f64; 2]],
    ) -> Parameters {
        let on_ground = |(sides, label): (&Box4, &[f64; 2])| {
            let ground = self.ground_m(start, sides[0], sides[1])?;
            Some((ground, [label[0] - mean.centre_m[0], label[1] - mean.centre_m[1]]))
        };
        let pairs: Vec<([f64; 2], [f64; 2])> = boxes.iter().zip(labels_m).filter_map(on_ground).collect();
        let mut weights = vec![1.0; pairs.len()];
        let mut placement = Placement { yaw: 0.0, shift_m: [0.0; 2] };
        for _ in 0..ROUNDS {
            placement = Placement::fit(&pairs, &weights);
            let misses_m: Vec<f64> = pairs.iter().map(|pair| placement.miss_m(pair)).collect();
            let scale_m = median(misses_m.clone()).max(1e-3);
            for (weight, miss_m) in weights.iter_mut().zip(misses_m) {
                *weight = 1.0 / (1.0 + (miss_m / (2.0 * scale_m)).powi(2));
            }
        }
        let mut placed = *start;
        (placed[5], placed[6], placed[7]) = (placement.yaw, placement.shift_m[0], placement.shift_m[1]);
        placed
    }

    /// Mean and precision of the homography's coefficients by boxes and priors, linearised at parameters.
    pub(crate) fn prior_on_coefficients(
        &self,
        parameters: &Parameters,
        mean: &ProjectiveMean,
    ) -> Option<(SVector<f64, FOOT_COEFFICIENTS>, SMatrix<f64, FOOT_COEFFICIENTS, FOOT_COEFFICIENTS>)> {
        let evidence = self.evidence(parameters)?;
        let mut information = evidence.information;
        // Direction and place: nothing is known.
        for (at, sigma) in [(5, 3.0), (6, 1e3), (7, 1e3)] {
            information[(at, at)] += f64::powi(sigma, -2);
        }
        let mut covariance = information.cholesky()?.inverse();
        let step = covariance * evidence.gradient;
        for (at, sigma) in MODEL_ERROR.iter().enumerate() {
            covariance[(at, at)] += sigma * sigma;
        }
        // The height ratio is marginalised: its row and column are left out of the covariance.
        let covariance = covariance.remove_row(RATIO).remove_column(RATIO);
        let jacobian = self.jacobian(parameters, mean)?;
        let inverse = jacobian.try_inverse()?;
        let precision = inverse.transpose() * covariance.cholesky()?.inverse() * inverse;
        let centre = self.coefficients(parameters, mean)? + jacobian * step.remove_row(RATIO);
        Some((centre, 0.5 * (precision + precision.transpose())))
    }
}

/// A point on the ground as (right, forward) of the camera, and its label as (east, north), both m.
type PointPair = ([f64; 2], [f64; 2]);

/// A rotation and a shift from (right, forward) of the camera to (east, north).
struct Placement {
    yaw: f64,
    shift_m: [f64; 2],
}

impl Placement {
    fn rotated(&self, [right, forward]: [f64; 2]) -> [f64; 2] {
        let (sin_yaw, cos_yaw) = self.yaw.sin_cos();
        [cos_yaw * right + sin_yaw * forward, cos_yaw * forward - sin_yaw * right]
    }

    /// Weighted least squares (Kabsch 1976 in the plane).
    fn fit(pairs: &[PointPair], weights: &[f64]) -> Self {
        let weighted = || pairs.iter().zip(weights);
        let total: f64 = weights.iter().sum();
        let mean = |of: fn(&PointPair) -> [f64; 2]| {
            [0, 1].map(|axis| weighted().map(|(pair, weight)| weight * of(pair)[axis]).sum::<f64>() / total)
        };
        let (from, to) = (mean(|pair| pair.0), mean(|pair| pair.1));
        let (mut cosine, mut sine) = (0.0, 0.0);
        for ((ground, label), weight) in weighted() {
            let (a, b) = ([ground[0] - from[0], ground[1] - from[1]], [label[0] - to[0], label[1] - to[1]]);
            cosine += weight * (a[0] * b[0] + a[1] * b[1]);
            sine += weight * (a[1] * b[0] - a[0] * b[1]);
        }
        let mut placement = Self { yaw: sine.atan2(cosine), shift_m: [0.0; 2] };
        let rotated = placement.rotated(from);
        placement.shift_m = [to[0] - rotated[0], to[1] - rotated[1]];
        placement
    }

    fn miss_m(&self, (ground, label): &PointPair) -> f64 {
        let [east, north] = self.rotated(*ground);
        (east + self.shift_m[0] - label[0]).hypot(north + self.shift_m[1] - label[1])
    }
}
