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
mod posterior;
mod predictor;
mod projective_mean;
mod recipe;
mod sessions;
mod stored;
mod map_rows;
mod upright_camera;

pub(crate) use box_plausibility::RecentBoxes;
pub(crate) use recipe::{Estimate, GaussianProcessEncoder, Settings, fit, target_height_m};
