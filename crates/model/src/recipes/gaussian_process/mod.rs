//! Recipe `gaussian_process`: a projective mean with a Gaussian-process residual under coloured noise per
//! receiver, whose stated error counts receivers, not rows.
//!
//! `docs/explanation/method.md` has the formulas, priors and references. The files in the order of a fit: `map_rows`,
//! `projective_mean`, `noise`, `kernel`, `known_rows`, `posterior`, `hyperparameters`, `upright_camera`, `groups`,
//! `candidate`, `leave_out`, `sessions`, `fit`, `companion`; `ground_camera` for association without a model; of an answer: `predictor`, `box_plausibility`, `hidden_foot`;
//! `recipe` and `stored` connect both to the rest of the module; `foot_map` takes the map of another fit, and `upright_geometry` gives it a prior. Random starts have a seed of their own.

mod box_plausibility;
mod candidate;
mod companion;
mod edge_noise;
mod f_distribution;
mod fit;
mod foot_map;
mod ground_camera;
mod groups;
mod hidden_foot;
mod hyperparameters;
mod kernel;
mod known_rows;
mod leave_out;
mod map_rows;
mod noise;
mod onnx;
mod posterior;
mod predictor;
pub(crate) mod projective_mean;
mod recipe;
mod sessions;
mod stored;
mod upright_camera;
mod upright_geometry;

pub use box_plausibility::RecentBoxes;
pub(crate) use companion::EPOCHS;
pub(crate) use fit::SHARED_BIAS_SHARE;
pub(crate) use foot_map::{FittedFootMap, FootCovariance, widen_map};
pub use ground_camera::{GroundCamera, GroundPoint};
pub use hidden_foot::HiddenFoot;
pub(crate) use hyperparameters::SESSION_SHARE;
pub use known_rows::KNOWN_POINTS;
pub(crate) use known_rows::POINTER_SIGMA_PX;
pub(crate) use leave_out::{SequenceMean, widening};
pub(crate) use noise::{Epoch, ReceiverNoise, ReceiverWhitener};
pub(super) use recipe::DEFINITION;
pub(crate) use recipe::{receiver_correlation, target_height_m};
pub(crate) use sessions::weighted_mean;
pub(crate) use upright_geometry::{FootPrior, UprightGeometry, UprightStarts};

#[cfg(test)]
mod tests;
