//! The maps of a site as tensors of each camera's model, and back: with them a model knows which part of its error the
//! other cameras share.

use nalgebra::DMatrix;

use super::ground_map::{GroundMap, PARAMETERS};
use super::maps::{SiteMaps, SitePosition};
use crate::artifact::ModelParts;
use crate::domain::{BoundingBox, Error, GaussMarkovNoise, ImageSize, Result, RunId};
use crate::recipes::gaussian_process::projective_mean::{COEFFICIENTS, ProjectiveMean};
use crate::site::input::RECEIVER_CORRELATION;

/// Scales 8, centre 2, spread, coefficients 8.
const MAP_NUMBERS: usize = 11 + PARAMETERS;
/// Image width and height (0 where unknown), least and greatest u, least and greatest v, px.
const VIEW_NUMBERS: usize = 6;
const MAPS: &str = "site.maps";
const VIEWS: &str = "site.views";
const COVARIANCE: &str = "site.covariance";
const CAMERA: &str = "site.camera";
const FOOT_SIGMA: &str = "site.foot_sigma_px";
const FOOT_LASTING_SHARE: &str = "site.foot_lasting_share";

/// A camera's place among those that were trained together.
#[derive(Debug, Clone)]
pub(crate) struct JointMap {
    run: RunId,
    camera: usize,
    maps: SiteMaps,
}

impl JointMap {
    /// The run that trained the cameras together.
    pub(crate) const fn run(&self) -> RunId {
        self.run
    }

    /// A box's position by the joint fit, with the parts of its error.
    pub(crate) fn locate(&self, bounding_box: &BoundingBox) -> SitePosition {
        self.maps.locate(self.camera, bounding_box)
    }

    /// Takes the maps out of a model's parts; `None` for a camera that was trained by itself.
    ///
    /// # Errors
    /// Names the tensor or metadata field that is missing or cannot be used.
    pub(crate) fn take(parts: &mut ModelParts) -> Result<Option<Self>> {
        let Some(joint) = parts.joint_training.take() else { return Ok(None) };
        let run = joint.run_id.parse().map_err(|error: Error| error.under("metadata.joint_training"))?;
        let cameras = joint.cameras.len();
        let camera = parts.parameter(CAMERA)?;
        let maps = SiteMaps::take(parts, cameras)?;
        if !(0.0..cameras as f64).contains(&camera) {
            let message = format!("must be below the number of cameras, {cameras}");
            return Err(Error::invalid(format!("metadata.parameters.{CAMERA}"), message));
        }
        Ok(Some(Self { run, camera: camera as usize, maps }))
    }
}

impl SiteMaps {
    /// Adds all maps to the model of one camera.
    pub(crate) fn put(&self, camera: usize, parts: &mut ModelParts) {
        parts.set(CAMERA, camera as f64);
        parts.set(FOOT_SIGMA, self.foot_sigma_px);
        parts.set(FOOT_LASTING_SHARE, self.foot_lasting_share);
        let numbers = |GroundMap(mean): &GroundMap| {
            let ProjectiveMean { scales_px, centre_m, spread_m, coefficients } = mean;
            let mut numbers = scales_px.concat();
            numbers.extend(centre_m);
            numbers.push(*spread_m);
            numbers.extend(&coefficients[..PARAMETERS]);
            numbers
        };
        let maps = self.maps.iter().flat_map(numbers).collect();
        let view = |(size, [u, v]): (&Option<ImageSize>, &[[f64; 2]; 2])| {
            let sides = size.map_or([0.0; 2], |size| [size.width_px(), size.height_px()].map(f64::from));
            [sides[0], sides[1], u[0], u[1], v[0], v[1]]
        };
        let views = self.image_sizes.iter().zip(&self.views_px).flat_map(view).collect();
        let tensors = &mut parts.tensors;
        tensors.put_f64(MAPS, &[self.maps.len(), MAP_NUMBERS], maps);
        tensors.put_f64(VIEWS, &[self.maps.len(), VIEW_NUMBERS], views);
        let lower = lower_triangle(self.covariance.nrows());
        let covariance: Vec<f32> = lower.map(|at| self.covariance[at] as f32).collect();
        tensors.put_f32(COVARIANCE, &[covariance.len()], covariance);
    }

    fn take(parts: &mut ModelParts, cameras: usize) -> Result<Self> {
        let foot_sigma_px = parts.positive_parameter(FOOT_SIGMA)?;
        let foot_lasting_share = parts.parameter(FOOT_LASTING_SHARE)?.clamp(0.0, 1.0);
        let tensors = &mut parts.tensors;
        let maps = tensors.take_f64(MAPS, &[cameras, MAP_NUMBERS])?;
        let maps: Vec<GroundMap> =
            maps.as_chunks::<MAP_NUMBERS>().0.iter().map(ground_map).collect::<Result<_>>()?;
        let views = tensors.take_f64(VIEWS, &[cameras, VIEW_NUMBERS])?;
        let views = views.as_chunks::<VIEW_NUMBERS>().0;
        let size = PARAMETERS * cameras;
        let stored = tensors.take_f32(COVARIANCE, &[size * (size + 1) / 2])?;
        let mut covariance = DMatrix::zeros(size, size);
        for ((row, column), value) in lower_triangle(size).zip(stored) {
            covariance[(row, column)] = f64::from(value);
            covariance[(column, row)] = f64::from(value);
        }
        Ok(Self {
            maps,
            covariance,
            foot_sigma_px,
            foot_lasting_share,
            noise: GaussMarkovNoise::new(1.0, RECEIVER_CORRELATION),
            image_sizes: views.iter().map(image_size).collect::<Result<_>>()?,
            views_px: views.iter().map(|view| [[view[2], view[3]], [view[4], view[5]]]).collect(),
        })
    }
}

/// Indexes of a symmetric matrix's lower triangle, row by row.
fn lower_triangle(size: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..size).flat_map(|row| (0..=row).map(move |column| (row, column)))
}

fn ground_map(numbers: &[f64; MAP_NUMBERS]) -> Result<GroundMap> {
    let scales_px: [[f64; 2]; 4] = std::array::from_fn(|side| [numbers[2 * side], numbers[2 * side + 1]]);
    if scales_px.iter().any(|[_, unit_px]| *unit_px <= 0.0) || numbers[10] <= 0.0 {
        return Err(Error::invalid("weights", format!("{MAPS} must have units above 0")));
    }
    let mut coefficients = [0.0; COEFFICIENTS];
    coefficients[..PARAMETERS].copy_from_slice(&numbers[11..]);
    Ok(GroundMap(ProjectiveMean {
        scales_px,
        centre_m: [numbers[8], numbers[9]],
        spread_m: numbers[10],
        coefficients,
    }))
}

fn image_size(view: &[f64; VIEW_NUMBERS]) -> Result<Option<ImageSize>> {
    let [width_px, height_px, ..] = *view;
    let is_known = width_px != 0.0 || height_px != 0.0;
    let size = is_known.then(|| ImageSize::new(width_px as u32, height_px as u32)).transpose();
    size.map_err(|error| Error::invalid("weights", format!("{VIEWS}: {error}")))
}
