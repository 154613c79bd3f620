//! Recipe `gaussian_process`: a projective mean with a Gaussian-process residual, under coloured noise
//! per receiver, with an error that counts receivers, not rows.
//!
//! What never happens here: I/O, clocks, randomness (the few random starts have a seed of their own), a
//! look at truth.

mod box_plausibility;
mod candidate;
mod edge_noise;
mod f_distribution;
mod fit;
mod groups;
mod hyperparameters;
mod kernel;
mod leave_out;
mod noise;
mod order_statistics;
mod posterior;
mod predictor;
pub(crate) mod projective_mean;
mod sessions;
mod training_rows;
mod upright_camera;

pub(crate) use box_plausibility::RecentBoxes;
pub(crate) use fit::{FitReport, FitSettings, fit};
pub(crate) use noise::Epoch;
pub(crate) use predictor::{Prediction, Predictor};
pub(crate) use training_rows::TrainingRows;
pub(crate) use upright_camera::UprightCamera;
