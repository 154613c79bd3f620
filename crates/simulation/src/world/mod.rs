//! Simulates a world: all targets before one camera.

use super::camera::PinholeCamera;
use super::noise::stream;
use super::options::{Options, Route};
use super::path::Polyline;
use super::row::SimulatedRow;
use super::target::SimulatedTarget;
use super::tracker;
use crate::domain::{ImageSize, Sample};
use crate::geo::{LocalPlane, Position};

/// Rows with their truth, ordered by time, then target.
#[derive(Debug, Clone, PartialEq)]
pub struct World {
    /// Size of the camera's image.
    pub image_size: ImageSize,
    /// Standard deviation per axis of every receiver, m.
    pub gnss_sigma_m: f64,
    /// Fewer than requested only if the camera, once rotated, no longer sees the targets.
    pub rows: Vec<SimulatedRow>,
    /// The lines that the targets follow, up to their lateral deviation; none under [`Route::Area`].
    pub truth_lines: Vec<Vec<Position>>,
    /// True position of the first target under [`Route::Standing`].
    pub truth_point: Option<Position>,
}

impl World {
    /// The rows with both box and fix.
    #[must_use]
    pub fn training_samples(&self) -> Vec<Sample> {
        let sample = |row: &SimulatedRow| {
            Some(Sample {
                time: row.time,
                target_id: row.target_id.clone(),
                bounding_box: row.bounding_box?,
                fix: row.fix?,
                class: Some(row.class.clone()),
                score: None,
                truth: Some(row.truth),
            })
        };
        self.rows.iter().filter_map(sample).collect()
    }
}

/// Number of the tracker's stream of a seed, beyond those of any number of targets.
const TRACKER_STREAM: u64 = 1 << 40;

/// Simulates the world of those options.
#[must_use]
pub fn simulate(options: &Options) -> World {
    let scene = options.scene;
    let mut random = stream(options.camera_seed, 0);
    let camera = options.camera(&mut random);
    let mut paths = scene.paths(options.airport_form, camera.pan_deg);
    if options.route == Route::NewLine {
        let offset_m = options.new_line_offset_m.unwrap_or(scene.new_line_offset_m());
        paths = paths.iter().map(|path| path.parallel(offset_m)).collect();
    }
    let plane = LocalPlane::new(scene.origin());
    let sessions: Vec<Vec<SimulatedRow>> = (0..options.sessions.max(1))
        .map(|session| session_rows(&options.session(session), camera, plane, &paths))
        .collect();
    let first = || sessions[0].iter().find(|row| row.target == 0).map(|row| row.truth);
    let truth_point = if options.route == Route::Standing { first() } else { None };
    let positions = |path: &Polyline| path.points.iter().map(|&point| plane.to_position(point)).collect();
    let truth_lines =
        if options.route == Route::Area { Vec::new() } else { paths.iter().map(positions).collect() };
    World {
        image_size: camera.image_size,
        gnss_sigma_m: options.gnss_sigma_m,
        rows: sessions.into_iter().flatten().collect(),
        truth_lines,
        truth_point,
    }
}

/// The rows of one session, ordered by time, then target.
fn session_rows(
    options: &Options,
    camera: PinholeCamera,
    plane: LocalPlane,
    paths: &[Polyline],
) -> Vec<SimulatedRow> {
    let targets = options.targets.max(1);
    let mut rows = Vec::with_capacity(options.samples);
    for index in 0..targets {
        let share = options.samples / targets + usize::from(index < options.samples % targets);
        SimulatedTarget::new(options, camera, plane, index).run(paths, share, &mut rows);
    }
    rows.sort_by(|one, other| (one.time, &one.target_id).cmp(&(other.time, &other.target_id)));
    if let Some(lifetime_s) = options.tracker_id_lifetime_s {
        tracker::assign_ids(&mut rows, lifetime_s, stream(options.seed, TRACKER_STREAM));
    }
    rows
}

/// A training world and a test world: the same camera, other traverses and noise, a week later.
#[must_use]
pub fn simulate_split(options: &Options, test_rows: usize) -> (World, World) {
    (simulate(options), simulate(&options.test(test_rows)))
}

#[cfg(test)]
mod tests;
