//! Methods of other authors and of common practice, for comparison.

pub mod dnn;
pub mod homography;
pub mod imm_ukf;
