//! Models of a camera: fitting them to samples, storing them, and regressing positions from boxes.
//!
//! [`fit`] turns samples into an [`Artifact`]; [`Artifact::load`] turns that into a [`Regressor`], which
//! regresses box by box from flat weights. [`fit_site_models`] trains the cameras of a site together.
//!
//! The modules in the order of their layers; each imports only from those before it:
//!
//! | module | contents |
//! |---|---|
//! | [`filters`] | Kalman filters and smoothers over fixes alone |
//! | `artifact` | metadata, tensors and the exchange file; the parts of a model, checked |
//! | [`network`] | shape, forward pass, loss and gradient kernels, optimiser, training loop |
//! | `samples` | training rows in a plane, traverses, held-out targets and blocks of time; boxes without a fix; noise of the fixes and its whitening filter |
//! | `progress` | observer and progress of a fit |
//! | `encoder` | what recipes share: the features of a box, the auto-encoder, the projective map and its robust fit |
//! | `recipes` | the table of recipes; a folder per recipe with its fit, its encoder and the encoder as expressions of a graph |
//! | `site` | the cameras of a site trained together: one least-squares problem, the error that they have in common |
//! | `uncertainty` | coverage, local box model, error model; their calibration by variance components |
//! | `regressor` | a loaded model: encoder and error model |
//! | `probe` | loading with checks of the answers |
//! | `onnx` | a model as an ONNX graph for other runtimes, scalers and error model inside |
//! | `view_area` | the area on the ground that the training boxes cover |
//! | `fitting` | candidates, cross-validation, final fit, widening by left-out targets, noise model of tracks, the report in words |
//!
//! `fit` returns the complete artifact; nothing is added to it afterwards. This is the only crate that uses candle,
//! and only to train. It does no input or output, reads no clock and starts no thread; what it draws at random comes
//! from the seed in [`FitOptions`]. The same samples, options and seed give the same model, bit for bit, on one machine.

#![warn(missing_docs)]

mod artifact;
mod encoder;
pub mod filters;
mod fitting;
pub mod network;
mod onnx;
mod probe;
mod progress;
mod recipes;
mod regressor;
mod samples;
mod site;
mod uncertainty;
mod view_area;

pub use crate::statistics::R95_PER_SIGMA;
pub use artifact::{Artifact, FORMAT, LARGEST_WEIGHTS_BYTES, TrackNoiseModel};
pub use encoder::projection::Projection;
pub use encoder::projection_fit::fit_foot_points;
pub use fitting::{
    FitInput, FitOptions, FitOverrides, SiteCamera, SiteCameraModel, SiteModels, TimedResidual,
    estimate_gnss_noise, fit, fit_site_models, fit_with,
};
pub use progress::{FitError, FitEvent};
pub use recipes::gaussian_process::{GroundCamera, GroundPoint, HiddenFoot, KNOWN_POINTS, RecentBoxes};
pub use regressor::{JointError, Regression, Regressor};
pub use samples::mirroring::{FootPosition, is_mirrored, median_position};
pub use samples::rows::{FEWEST_SAMPLES, SMALLEST_SPREAD_M};
pub use samples::sequences::fix_sequences;
pub use site::{
    RECEIVER_CORRELATION, SiteFitError, SiteFitInput, SiteFix, SiteKnownPoint, SiteMaps, SitePair,
    SitePosition, box_at, fit_site,
};
pub use view_area::ViewArea;

#[cfg(test)]
mod tests;

use sightfix_domain::{domain, geo, statistics};
#[cfg(test)]
use sightfix_simulation as simulation;
