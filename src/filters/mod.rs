//! Kalman filters and smoothers.
