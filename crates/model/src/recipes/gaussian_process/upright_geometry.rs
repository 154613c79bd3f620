//! A prior of the coefficients of a camera's homography from the heights of boxes, for fits of several cameras.

use nalgebra::{SMatrix, SVector};

use super::projective_mean::{Box4, FOOT_COEFFICIENTS, ProjectiveMean};
use super::upright_camera::{Parameters, UprightCamera};
use crate::domain::ImageSize;
use crate::statistics::median;

/// A normal prior of a homography's coefficients.
#[derive(Debug, Clone)]
pub(crate) struct FootPrior {
    pub(crate) centre: SVector<f64, FOOT_COEFFICIENTS>,
    pub(crate) precision: SMatrix<f64, FOOT_COEFFICIENTS, FOOT_COEFFICIENTS>,
}

/// The cameras that the heights of boxes allow, without place and direction.
#[derive(Debug, Clone)]
pub(crate) struct UprightStarts {
    camera: UprightCamera,
    starts: Vec<Parameters>,
}

impl UprightStarts {
    /// From boxes in the order of their targets' numbers; `None` where they determine none. `target_height_m` is the
    /// median height of a target with the standard deviation of its logarithm.
    pub(crate) fn new(
        boxes: &[(u32, Box4)],
        image_size: ImageSize,
        target_height_m: (f64, f64),
    ) -> Option<Self> {
        let size_px = (f64::from(image_size.width_px()), f64::from(image_size.height_px()));
        let camera = UprightCamera::new(boxes, size_px, target_height_m)?;
        let starts = camera.starts();
        (!starts.is_empty()).then_some(Self { camera, starts })
    }
}

/// An upright camera at the parameters about which its prior is linearised.
#[derive(Debug, Clone)]
pub(crate) struct UprightGeometry {
    camera: UprightCamera,
    at: Parameters,
}

impl UprightGeometry {
    /// Selects, among the cameras that suit the boxes, the one that places feet nearest to their positions. Returns it
    /// with its homography in the scales of `mean`.
    pub(crate) fn new(
        UprightStarts { camera, starts }: &UprightStarts,
        mean: &ProjectiveMean,
        (feet, positions): (&[Box4], &[[f64; 2]]),
    ) -> Option<(Self, ProjectiveMean)> {
        let of_start = |start: &Parameters| {
            let at = camera.placed(start, mean, feet, positions);
            camera.prior_on_coefficients(&at, mean)?;
            let placed = with_foot(mean, &camera.coefficients(&at, mean)?)?;
            let miss_m = |(foot, position): (&Box4, &[f64; 2])| {
                let [east_m, north_m] = placed.project(foot);
                (east_m - position[0]).hypot(north_m - position[1])
            };
            Some((median(feet.iter().zip(positions).map(miss_m).collect()), at, placed))
        };
        let best = starts.iter().filter_map(of_start).min_by(|one, other| one.0.total_cmp(&other.0));
        let (_, at, placed) = best?;
        Some((Self { camera: camera.clone(), at }, placed))
    }

    /// Linearises at the camera that has a homography to first order; returns the prior there.
    pub(crate) fn prior_at(&mut self, mean: &ProjectiveMean) -> Option<FootPrior> {
        let foot = SVector::from_column_slice(&mean.coefficients[..FOOT_COEFFICIENTS]);
        self.at = self.camera.moved_to(&self.at, mean, &foot)?;
        let (centre, precision) = self.camera.prior_on_coefficients(&self.at, mean)?;
        Some(FootPrior { centre, precision })
    }
}

fn with_foot(mean: &ProjectiveMean, foot: &SVector<f64, FOOT_COEFFICIENTS>) -> Option<ProjectiveMean> {
    let mut placed = mean.clone();
    placed.coefficients[..FOOT_COEFFICIENTS].copy_from_slice(foot.as_slice());
    placed.coefficients.iter().all(|value| value.is_finite()).then_some(placed)
}
