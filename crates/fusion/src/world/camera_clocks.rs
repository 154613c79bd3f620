//! The offsets of the cameras' clocks from each other, from targets that two cameras see at once.
//!
//! A camera whose times are late by `o` shows a target where it was `o` ago. For two cameras and a target with the velocity v
//!
//! ```text
//! z_a - z_b - v (t_a - t_b) = -(o_a - o_b) v + m(x) + w
//! ```
//!
//! with the difference m of their maps at the target's position x and the noise w (`map_difference.rs`). What one target shows
//! within some seconds is one observation: v is the line through the positions by both cameras, for the velocity of the track
//! follows each camera's map. Because m depends on x, a difference of the maps that people meet on opposite sides of a street is
//! not taken for one of the clocks. The offsets of all cameras are the least-squares solution of their pairs; most clocks are
//! taken to be right, so the median is 0.

use std::collections::BTreeMap;

use jiff::Timestamp;
use nalgebra::{DMatrix, DVector};

use super::comparisons::{CameraPair, Comparisons, Overlap};
use super::map_difference::Effects;
use crate::clock_estimate::{ClockEstimate, earlier};
use crate::domain::CameraId;

/// Estimates of the clocks of a site's cameras.
#[derive(Debug, Clone, Default)]
pub(super) struct CameraClocks(BTreeMap<CameraId, ClockEstimate>);

impl CameraClocks {
    /// The estimates so far.
    pub(super) const fn clocks(&self) -> &BTreeMap<CameraId, ClockEstimate> {
        &self.0
    }

    /// A camera's time by the clock of most cameras.
    pub(super) fn corrected(&self, camera: &CameraId, time: Timestamp) -> Timestamp {
        earlier(time, self.corrected_s(camera))
    }

    /// What is taken off a camera's times, s.
    pub(super) fn corrected_s(&self, camera: &CameraId) -> f64 {
        let clock = self.0.get(camera).filter(|clock| clock.is_wrong());
        clock.map_or(0.0, |clock| clock.offset_s)
    }

    /// Estimates the clocks of all cameras again that have observations enough.
    pub(super) fn estimate(&mut self, comparisons: &Comparisons) {
        self.0.extend(solved(comparisons.overlaps()));
    }
}

/// Slope of what is apart over the velocity and its standard deviation, s; `None` where the velocities hardly differ.
fn slope(overlap: &Overlap) -> Option<(f64, f64)> {
    let difference = overlap.short.as_ref()?;
    let Effects { coefficients, covariance } = difference.effects(&[difference.velocity.clone()?])?;
    Some((coefficients[0], covariance[(0, 0)].sqrt()))
}

/// The clocks of all cameras that pairs tell of.
fn solved(overlaps: &BTreeMap<CameraPair, Overlap>) -> BTreeMap<CameraId, ClockEstimate> {
    let slopes: Vec<(&CameraPair, (f64, f64))> =
        overlaps.iter().filter_map(|(pair, own)| Some((pair, slope(own)?))).collect();
    let mut cameras: Vec<&CameraId> = slopes.iter().flat_map(|((one, other), _)| [one, other]).collect();
    cameras.sort();
    cameras.dedup();
    let count = cameras.len();
    if count == 0 {
        return BTreeMap::new();
    }
    let at = |camera: &CameraId| cameras.binary_search(&camera).ok();
    // A weak prior: only differences are observed.
    let mut precision = DMatrix::<f64>::identity(count, count) * 1e-2;
    let mut right = DVector::<f64>::zeros(count);
    for ((one, other), (slope_s, sigma_s)) in &slopes {
        let (Some(one), Some(other)) = (at(one), at(other)) else { continue };
        let weight = sigma_s.max(1e-3).powi(-2);
        for (camera, sign) in [(one, 1.0), (other, -1.0)] {
            precision[(camera, camera)] += weight;
            // The slope is the negative difference of the offsets.
            right[camera] -= sign * weight * slope_s;
        }
        precision[(one, other)] -= weight;
        precision[(other, one)] -= weight;
    }
    let Some(covariance) = precision.try_inverse() else { return BTreeMap::new() };
    let offsets_s = &covariance * right;
    // Pairs that contradict each other know less than they state.
    let missed = slopes.iter().filter_map(|((one, other), (slope_s, sigma_s))| {
        let difference_s = offsets_s[at(one)?] - offsets_s[at(other)?];
        Some(((slope_s + difference_s) / sigma_s.max(1e-3)).powi(2))
    });
    let beyond_tree = (slopes.len() + 1).saturating_sub(count).max(1) as f64;
    let inflation = (missed.sum::<f64>() / beyond_tree).max(1.0);
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by(|one, other| offsets_s[*one].total_cmp(&offsets_s[*other]));
    let median = order[(count - 1) / 2];
    let clock = |camera: usize| {
        let offset_s = offsets_s[camera] - offsets_s[median];
        let variance_s2 =
            covariance[(camera, camera)] + covariance[(median, median)] - 2.0 * covariance[(camera, median)];
        ClockEstimate { offset_s, sigma_s: (inflation * variance_s2.max(0.0)).sqrt(), drift: None }
    };
    cameras.iter().map(|camera| (*camera).clone()).zip((0..count).map(clock)).collect()
}
