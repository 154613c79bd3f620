//! stub
#![allow(missing_docs, unused)]
use crate::domain::*;
use crate::geo::*;
use bytes::Bytes;
use std::ops::ControlFlow;
mod file;
#[derive(Debug, Clone)]
pub struct FitOptions {
    pub recipe: Recipe,
    pub seed: u64,
    pub epochs: Option<u32>,
    pub image_size: Option<ImageSize>,
    pub gnss_error: GnssError,
}
pub enum FitEvent<'a> {
    Progress(&'a RunProgress),
    Epoch(&'a EpochReport),
    Note(&'a str),
}
#[derive(Debug, thiserror::Error)]
pub enum FitError {
    #[error("c")]
    Cancelled,
    #[error("{0}")]
    Unusable(Error),
    #[error("{0}")]
    Fault(Box<dyn std::error::Error + Send + Sync>),
}
pub fn fit(
    samples: &[Sample],
    options: &FitOptions,
    observer: &mut dyn FnMut(FitEvent<'_>) -> ControlFlow<()>,
) -> std::result::Result<Artifact, FitError> {
    Err(FitError::Cancelled)
}
#[derive(Clone, Debug)]
pub struct Artifact {
    pub metadata: ModelMetadata,
    pub weights: Bytes,
}
impl Artifact {
    pub fn load(&self) -> Result<Regressor> {
        Err(Error::invalid("x", "x"))
    }
}
pub struct Regressor(LocalPlane);
impl Regressor {
    pub fn plane(&self) -> &LocalPlane {
        &self.0
    }
    pub fn e_gnss_m2(&self) -> f64 {
        1.0
    }
    pub fn regress(&self, b: &BoundingBox, f: Option<EastNorth>) -> Regression {
        Regression {
            regressed: EastNorth::default(),
            reconstruction_error: 0.,
            e_regression_m2: 1.,
            outside_training: false,
            r95_scale: 2.4477,
        }
    }
}
pub struct Regression {
    pub regressed: EastNorth,
    pub reconstruction_error: f64,
    pub e_regression_m2: f64,
    pub outside_training: bool,
    pub r95_scale: f64,
}
pub const FEWEST_SAMPLES: u64 = 20;
pub const SMALLEST_SPREAD_M: f64 = 1.0;
