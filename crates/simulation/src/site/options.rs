//! The options that determine a simulated site.

use jiff::Timestamp;

use crate::geo::Position;

/// Default time of the first frame: 2026-01-05T08:00:00Z, in seconds since 1970.
const START_S: i64 = 1_767_600_000;

/// The targets and cameras of the site, and how well they see.
#[derive(Debug, Clone, PartialEq)]
pub struct SiteOptions {
    /// Seed of everything but the cameras and the receivers' errors.
    pub seed: u64,
    /// Seed of the cameras' heights, focal lengths and directions.
    pub camera_seed: u64,
    /// Seed of the receivers' errors.
    pub receiver_seed: u64,
    /// The foot of the first camera's mast, from which the street goes east.
    pub origin: Position,
    /// Number of cameras.
    pub cameras: usize,
    /// Number of cameras in a group: their views overlap, and a gap follows. At least 1.
    pub cameras_per_group: usize,
    /// From that many seconds after the start on, all cameras are rotated by that many degrees to the right.
    pub pan_deg_from: Option<(f64, f64)>,
    /// Number of walkers.
    pub walkers: usize,
    /// Share of the walkers who walk in groups of two to four.
    pub group_share: f64,
    /// Number of vehicles.
    pub vehicles: usize,
    /// Share of the targets that carry a receiver.
    pub receiver_share: f64,
    /// Length of the simulation, s.
    pub duration_s: f64,
    /// Time between two frames of a camera, s. All cameras take theirs at the same instants.
    pub frame_interval_s: f64,
    /// Standard deviation per axis of the receivers, m.
    pub gnss_sigma_m: f64,
    /// Standard deviation of each edge of a box, px.
    pub box_noise_px: f64,
    /// Height of the smallest box that is detected, px.
    pub smallest_box_px: f64,
    /// Share of the targets in view that a frame misses.
    pub missed_share: f64,
    /// Mean number of false detections per frame.
    pub false_per_frame: f64,
    /// Mean time after which a tracker loses a target that is in view and gives it a new id, s.
    pub tracker_id_lifetime_s: Option<f64>,
    /// Mean time after which a tracker swaps the ids of the two targets in view that are nearest to each other,
    /// s.
    pub tracker_id_swap_s: Option<f64>,
    /// Time of the first frame.
    pub start: Timestamp,
}

impl Default for SiteOptions {
    /// Three cameras, sixteen walkers and four vehicles for five minutes, at two frames a second.
    fn default() -> Self {
        Self {
            seed: 1,
            camera_seed: 1,
            receiver_seed: 1,
            origin: Position::new(24.745_3, 59.437_1).expect("constants within range"),
            cameras: 3,
            cameras_per_group: 2,
            pan_deg_from: None,
            walkers: 16,
            group_share: 0.0,
            vehicles: 4,
            receiver_share: 0.5,
            duration_s: 300.0,
            frame_interval_s: 0.5,
            gnss_sigma_m: 2.6,
            box_noise_px: 2.0,
            smallest_box_px: 25.0,
            missed_share: 0.0,
            false_per_frame: 0.0,
            tracker_id_lifetime_s: None,
            tracker_id_swap_s: None,
            start: Timestamp::from_second(START_S).expect("a constant within range"),
        }
    }
}
