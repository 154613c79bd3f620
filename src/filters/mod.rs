//! Filters and smoothers over fixes alone: the IMM-UKF baseline, and the kinematic smoother that
//! prepares training labels.
//!
//! What never happens here: boxes, models, degrees. Everything is in metres of a local plane.

mod imm;
mod smoother;

pub use imm::{Estimate, ImmUkf, ImmUkfOptions};
pub use smoother::{FixError, Smoothed, smooth_pass, tune_acceleration};
