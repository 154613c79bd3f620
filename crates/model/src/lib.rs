//! Models of a camera: fitting them to samples, storing them, and regressing positions from boxes.
//!
//! [`fit`] turns samples into an [`Artifact`]; [`Artifact::load`] turns that into a [`Regressor`], which
//! regresses box by box from flat weights. The folders in the order of their layers: `artifact`, `network`,
//! `samples`, `progress`, `encoder`, `site`, `uncertainty`, `regressor`, `probe`, `onnx`, `view_area`, `fitting`. This is the only module that
//! uses candle; it has no I/O, clocks or threads.

mod artifact;
mod encoder;
mod fitting;
pub mod network;
mod onnx;
mod probe;
mod progress;
mod regressor;
mod samples;
mod site;
mod uncertainty;
mod view_area;

pub use crate::statistics::R95_PER_SIGMA;
pub use artifact::{Artifact, FORMAT, LARGEST_WEIGHTS_BYTES, TrackNoiseModel};
pub use encoder::gaussian_process::{GroundCamera, GroundPoint, RecentBoxes};
pub use encoder::projection::Projection;
pub use encoder::projection_fit::fit_foot_points;
pub use fitting::{
    FitInput, FitOptions, FitOverrides, SiteCamera, SiteCameraModel, SiteModels, TimedResidual,
    estimate_gnss_noise, fit, fit_site_models, fit_with,
};
pub use progress::{FitError, FitEvent};
pub use regressor::{JointError, Regression, Regressor};
pub use samples::rows::{FEWEST_SAMPLES, SMALLEST_SPREAD_M};
pub use samples::sequences::fix_sequences;
pub use site::{
    RECEIVER_CORRELATION, SiteFitError, SiteFitInput, SiteFix, SiteMaps, SitePair, SitePosition, box_at,
    fit_site,
};
pub use view_area::ViewArea;

#[cfg(test)]
mod tests;
