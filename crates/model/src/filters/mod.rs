//! Filters and smoothers over fixes alone: the IMM-UKF baseline, and the fixed-interval smoother that
//! prepares training labels.
//!
//! All positions are in metres of a local plane.

mod imm_ukf;
mod smoother;

use crate::geo::EastNorth;

pub use imm_ukf::{ImmUkf, ImmUkfEstimate, ImmUkfOptions};
pub use smoother::{SmoothedPosition, noise_of_fixes, smooth_traverse, tune_acceleration};

/// One traverse of the scene by one target, without a gap: times in s, ascending, and a fix for each.
pub type Traverse = (Vec<f64>, Vec<EastNorth>);
