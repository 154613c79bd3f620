//! The error variance of a regressed position: its model, and its calibration on held-out residuals.

pub(crate) mod calibration;
mod centre_statistics;
pub(crate) mod coverage;
pub(crate) mod error_model;
mod excess_calibration;
mod jacobian;
pub(crate) mod local_boxes;
pub(crate) mod scene;
pub(crate) mod variance_components;
