//! What a practitioner would use in place of this project, for comparison.

pub mod dnn;
pub mod homography;
