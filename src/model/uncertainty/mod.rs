//! The error variance of a regressed position.

pub(crate) mod calibration;
pub(crate) mod coverage;
pub(crate) mod local_boxes;
