//! The fitted maps of a site's cameras, with the covariance of their errors.

use nalgebra::{DMatrix, Matrix2, Vector2};

use super::ground_map::{GroundMap, PARAMETERS};
use super::input::{foot_and_size, is_foot_cut};
use crate::domain::{BoundingBox, GaussMarkovNoise, ImageSize};
use crate::geo::{EastNorth, PlaneCovariance};
use crate::recipes::gaussian_process::{FittedFootMap, FootCovariance};

/// Standard deviation of the foot of a box that the image border cuts, relative to its height.
const CUT_FOOT_SHARE: f64 = 0.25;
/// Margin around the feet of training within which a camera sees a place, relative to their extent.
const VIEW_MARGIN: f64 = 0.1;

/// A box's position by its camera's map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SitePosition {
    /// In the site's plane, m.
    pub position: EastNorth,
    /// Covariance of the box's noise that is independent from box to box, m2.
    pub box_noise_m2: PlaneCovariance,
    /// Covariance of the box's noise that lasts while the target moves some metres, m2.
    pub lasting_noise_m2: PlaneCovariance,
    /// Covariance of the part of the map's error that other cameras do not share (V_rel), m2.
    pub relative_m2: PlaneCovariance,
    /// Covariance of the part of the map's error that all cameras which see the place have in common (V_com), m2.
    pub common_m2: PlaneCovariance,
}

impl SitePosition {
    /// Covariance of the whole error, m2.
    #[must_use]
    pub fn covariance_m2(&self) -> PlaneCovariance {
        self.box_noise_m2.plus(self.lasting_noise_m2).plus(self.relative_m2).plus(self.common_m2)
    }
}

/// The maps of all cameras of a site.
#[derive(Debug, Clone)]
pub struct SiteMaps {
    pub(super) maps: Vec<GroundMap>,
    /// Covariance of all parameters, camera by camera.
    pub(super) covariance: DMatrix<f64>,
    pub(super) foot_sigma_px: f64,
    /// Share of the feet's variance that lasts while a target moves some metres.
    pub(super) foot_lasting_share: f64,
    pub(super) noise: GaussMarkovNoise,
    pub(super) image_sizes: Vec<Option<ImageSize>>,
    /// Extent of the feet of training per camera: least and greatest u and v, px.
    pub(super) views_px: Vec<[[f64; 2]; 2]>,
}

impl SiteMaps {
    /// Standard deviation of a foot per axis, px.
    #[must_use]
    pub const fn foot_sigma_px(&self) -> f64 {
        self.foot_sigma_px
    }

    /// Share of a foot's variance that lasts while its target moves some metres, within 0 and 1.
    #[must_use]
    pub const fn foot_lasting_share(&self) -> f64 {
        self.foot_lasting_share
    }

    /// Noise of the receivers' fixes per axis.
    #[must_use]
    pub const fn receiver_noise(&self) -> GaussMarkovNoise {
        self.noise
    }

    /// The map of a camera with its own covariance; `shared_bias_m2` is the variance per axis of the bias that all
    /// receivers have in common.
    pub(crate) fn foot_map(&self, camera: usize, shared_bias_m2: f64, freedom: f64) -> FittedFootMap {
        let first = PARAMETERS * camera;
        FittedFootMap {
            mean: self.maps[camera].0.clone(),
            covariance: FootCovariance::from_fn(|row, column| self.covariance[(first + row, first + column)]),
            foot_sigma_px: self.foot_sigma_px,
            shared_bias_m2,
            freedom,
        }
    }

    /// Number of cameras.
    #[must_use]
    pub fn cameras(&self) -> usize {
        self.maps.len()
    }

    /// Where a box's target stands, by the map of its camera (an index of the fit's input).
    #[must_use]
    pub fn locate(&self, camera: usize, bounding_box: &BoundingBox) -> SitePosition {
        let foot = foot_and_size(bounding_box);
        let tangent = self.maps[camera].tangent(&foot);
        let is_cut = is_foot_cut(bounding_box, self.image_sizes[camera]);
        let cut_px = if is_cut { CUT_FOOT_SHARE * bounding_box.height_px() } else { 0.0 };
        let foot_px2 = self.foot_sigma_px.powi(2);
        let of_foot = |px2: f64| PlaneCovariance::from(tangent.by_foot * tangent.by_foot.transpose() * px2);
        let own = self.block(camera, &tangent.by_parameters, camera, &tangent.by_parameters);
        let common = self.common_part(camera, tangent.position, &tangent.by_parameters, own);
        SitePosition {
            position: EastNorth { east_m: tangent.position[0], north_m: tangent.position[1] },
            box_noise_m2: of_foot((1.0 - self.foot_lasting_share) * foot_px2 + cut_px.powi(2)),
            lasting_noise_m2: of_foot(self.foot_lasting_share * foot_px2),
            relative_m2: PlaneCovariance::from(own - common),
            common_m2: PlaneCovariance::from(common),
        }
    }

    /// The mean of the cross-covariances of all pairs of cameras that see a place: the part that no averaging over
    /// these cameras removes. All of it, where no other camera sees the place.
    fn common_part(
        &self,
        camera: usize,
        position: Vector2<f64>,
        slopes: &[[f64; PARAMETERS]; 2],
        own: Matrix2<f64>,
    ) -> Matrix2<f64> {
        let mut seen_by = vec![(camera, *slopes)];
        for (other, map) in self.maps.iter().enumerate().filter(|(other, _)| *other != camera) {
            let Some(foot) = map.foot_at(position).filter(|foot| self.is_in_view(other, *foot)) else {
                continue;
            };
            let [.., width, height] = map.0.scales_px.map(|scale| scale[0]);
            seen_by.push((other, map.tangent(&[foot[0], foot[1], width, height]).by_parameters));
        }
        let mut sum = Matrix2::zeros();
        let mut pairs = 0.0;
        for (number, (one, one_slopes)) in seen_by.iter().enumerate() {
            for (other, other_slopes) in &seen_by[number + 1..] {
                let cross = self.block(*one, one_slopes, *other, other_slopes);
                sum += 0.5 * (cross + cross.transpose());
                pairs += 1.0;
            }
        }
        if pairs == 0.0 { own } else { bounded(sum / pairs, own) }
    }

    /// True if a camera's image has a foot point: by the image size, or by the feet of training where that is unknown.
    fn is_in_view(&self, camera: usize, foot: [f64; 2]) -> bool {
        let [u_range, v_range] = match self.image_sizes[camera] {
            Some(size) => [[0.0, f64::from(size.width_px())], [0.0, f64::from(size.height_px())]],
            None => self.views_px[camera].map(|[least, greatest]| {
                let margin = VIEW_MARGIN * (greatest - least);
                [least - margin, greatest + margin]
            }),
        };
        let is_within = |value: f64, [least, greatest]: [f64; 2]| (least..=greatest).contains(&value);
        is_within(foot[0], u_range) && is_within(foot[1], v_range)
    }

    /// `J_a P_ab J_b'` of the parameters' covariance P, m2.
    fn block(
        &self,
        one: usize,
        one_slopes: &[[f64; PARAMETERS]; 2],
        other: usize,
        other_slopes: &[[f64; PARAMETERS]; 2],
    ) -> Matrix2<f64> {
        Matrix2::from_fn(|row, column| {
            let mut sum = 0.0;
            for (i, slope) in one_slopes[row].iter().enumerate() {
                for (j, other_slope) in other_slopes[column].iter().enumerate() {
                    sum +=
                        slope * self.covariance[(PARAMETERS * one + i, PARAMETERS * other + j)] * other_slope;
                }
            }
            sum
        })
    }
}

/// The nearest covariance that is a part of the whole: in the axes in which the whole is the identity, its
/// eigenvalues are limited to 0 and 1.
fn bounded(part: Matrix2<f64>, whole: Matrix2<f64>) -> Matrix2<f64> {
    let Some(factor) = whole.cholesky() else { return whole };
    let lower = factor.l();
    let Some(inverse) = lower.try_inverse() else { return whole };
    let mut eigen = (inverse * part * inverse.transpose()).symmetric_eigen();
    eigen.eigenvalues.apply(|value| *value = value.clamp(0.0, 1.0));
    lower * eigen.recompose() * lower.transpose()
}
