//! Inference with tensors: boxes to positions by the active model, for clients of the Open Inference Protocol.

use std::sync::Arc;

use super::App;
use super::active_cameras::ActiveCameras;
use super::registry::ActiveCamera;
use crate::config::Limits;
use crate::domain::{BoundingBox, CameraId, Error, ErrorKind, Result};

/// The input: one row per box.
pub const BOXES: &str = "boxes";
/// Columns of the input: left, top, width, height, px.
pub const BOX_COLUMNS: usize = 4;

/// An output, with the number of its columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputTensor {
    /// Longitude and latitude in degrees.
    Positions,
    /// Variance along east, variance along north, covariance of both, m2, of the normal distribution about the
    /// position that has the stated 95 % radius.
    Covariances,
    /// Radius about the position that holds the true one with 95 % probability, m.
    Radii,
    /// 1 where the box is unlike those of the training samples, else 0.
    OutsideTraining,
}

impl OutputTensor {
    /// All of them, in the order of an answer.
    pub const ALL: [Self; 4] = [Self::Positions, Self::Covariances, Self::Radii, Self::OutsideTraining];

    /// Its name in the protocol.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Positions => "position_deg",
            Self::Covariances => "covariance_m2",
            Self::Radii => "r95_m",
            Self::OutsideTraining => "outside_training",
        }
    }

    /// Numbers per box.
    #[must_use]
    pub const fn columns(self) -> usize {
        match self {
            Self::Positions => 2,
            Self::Covariances => 3,
            Self::Radii | Self::OutsideTraining => 1,
        }
    }

    /// The outputs of these names, all if none is named.
    ///
    /// # Errors
    /// `InvalidArgument` naming the output that there is not.
    pub fn named<'a>(names: impl Iterator<Item = &'a str>) -> Result<Vec<Self>> {
        let of_name = |(index, name): (usize, &str)| {
            Self::ALL.into_iter().find(|output| output.name() == name).ok_or_else(|| {
                let known = Self::ALL.map(Self::name).join(", ");
                Error::invalid(format!("outputs[{index}].name"), format!("must be one of {known}"))
            })
        };
        let outputs = names.enumerate().map(of_name).collect::<Result<Vec<_>>>()?;
        Ok(if outputs.is_empty() { Self::ALL.to_vec() } else { outputs })
    }
}

/// The version that answers, and what it said of each box.
#[derive(Debug, Clone, PartialEq)]
pub struct Inferred {
    /// Number of the model version.
    pub version: u32,
    /// Outputs row by row, in the order in which they were asked for.
    pub outputs: Vec<(OutputTensor, Vec<f64>)>,
}

/// Inference with tensors, by active models.
#[derive(Clone, Copy)]
pub struct Inference<'a> {
    cameras: ActiveCameras<'a>,
    limits: &'a Limits,
}

impl App {
    /// Inference with tensors, by active models.
    #[must_use]
    pub fn inference(&self) -> Inference<'_> {
        Inference { cameras: self.active_cameras(), limits: &self.limits }
    }
}

impl Inference<'_> {
    /// The camera whose active model answers, and that model's version.
    ///
    /// # Errors
    /// `CameraNotFound`; `NoModel`; `ModelNotFound` for a version that is not the active one.
    pub async fn served_model(
        &self,
        id: &CameraId,
        version: Option<&str>,
    ) -> Result<(Arc<ActiveCamera>, u32)> {
        let camera = self.cameras.get(id).await?;
        let Some((_, active)) = camera.model() else {
            let message = format!(
                "camera {id} has no model that answers; train it, or activate a version that can be used"
            );
            return Err(Error::refused(ErrorKind::NoModel, message));
        };
        match version {
            Some(version) if version.parse() != Ok(active) => Err(Error::refused(
                ErrorKind::ModelNotFound,
                format!("version {active} of camera {id} answers; no other one does until it is activated"),
            )),
            _ => Ok((camera, active)),
        }
    }

    /// Positions of boxes, each given as left, top, width, height, px.
    ///
    /// # Errors
    /// As [`Inference::served_model`]; `InvalidArgument` naming the row that is no box of the camera's image;
    /// `TooLarge` beyond the limit of observations.
    pub async fn infer(
        &self,
        id: &CameraId,
        version: Option<&str>,
        boxes: &[[f64; BOX_COLUMNS]],
        outputs: &[OutputTensor],
    ) -> Result<Inferred> {
        self.limits.check_batch(boxes.len()).map_err(|error| error.at(BOXES))?;
        let (camera, version) = self.served_model(id, version).await?;
        let Some((regressor, _)) = camera.model() else { return Err(Error::fault("the model has gone")) };
        let boxes = boxes.iter().enumerate().map(|(row, &[left, top, width, height])| {
            BoundingBox::new(left, top, width, height)
                .and_then(|bounding_box| match camera.image_size {
                    Some(size) => bounding_box.within(size),
                    None => Ok(bounding_box),
                })
                .map_err(|error| error.under(&format!("{BOXES}[{row}]")))
        });
        let boxes = boxes.collect::<Result<Vec<_>>>()?;
        let mut answers: Vec<(OutputTensor, Vec<f64>)> = outputs
            .iter()
            .map(|output| (*output, Vec::with_capacity(boxes.len() * output.columns())))
            .collect();
        for bounding_box in &boxes {
            let regression = regressor.regress(bounding_box, None);
            for (output, numbers) in &mut answers {
                match output {
                    OutputTensor::Positions => {
                        let position = regressor.plane().to_position(regression.regressed);
                        numbers.extend([position.longitude_deg(), position.latitude_deg()]);
                    }
                    OutputTensor::Covariances => {
                        let covariance = regression.normal_covariance();
                        numbers.extend([covariance.east_m2, covariance.north_m2, covariance.east_north_m2]);
                    }
                    OutputTensor::Radii => numbers.push(regression.r95_m()),
                    OutputTensor::OutsideTraining => {
                        numbers.push(f64::from(u8::from(regression.outside_training)));
                    }
                }
            }
        }
        Ok(Inferred { version, outputs: answers })
    }
}
