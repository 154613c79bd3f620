//! Simulates a world: all targets before one camera.

use super::noise::stream;
use super::options::{Options, Route};
use super::path::Polyline;
use super::row::SimulatedRow;
use super::target::SimulatedTarget;
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
    /// The lines that the targets follow, up to their lateral deviation.
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

/// Simulates the world of those options.
#[must_use]
pub fn simulate(options: &Options) -> World {
    let scene = options.scene;
    let mut random = stream(options.camera_seed, 0);
    let camera = scene.camera(options.border_cuts, options.lens_distortion, &mut random);
    let mut paths = scene.paths(camera.pan_deg);
    if options.route == Route::NewLine {
        paths = paths.iter().map(|path| path.parallel(scene.new_line_offset_m())).collect();
    }
    let plane = LocalPlane::new(scene.origin());
    let targets = options.targets.max(1);
    let mut rows = Vec::with_capacity(options.samples);
    let mut truth_point = None;
    for index in 0..targets {
        let share = options.samples / targets + usize::from(index < options.samples % targets);
        let mut target = SimulatedTarget::new(options, camera, plane, index);
        let first = rows.len();
        target.run(&paths, share, &mut rows);
        if options.route == Route::Standing && index == 0 {
            truth_point = rows.get(first).map(|row: &SimulatedRow| row.truth);
        }
    }
    rows.sort_by(|one, other| (one.time, &one.target_id).cmp(&(other.time, &other.target_id)));
    let positions = |path: &Polyline| path.points.iter().map(|&point| plane.to_position(point)).collect();
    World {
        image_size: camera.image_size,
        gnss_sigma_m: options.gnss_sigma_m,
        rows,
        truth_lines: paths.iter().map(positions).collect(),
        truth_point,
    }
}

/// A training world and a test world: the same camera, other traverses and noise, a week later.
#[must_use]
pub fn simulate_split(options: &Options, test_rows: usize) -> (World, World) {
    (simulate(options), simulate(&options.test(test_rows)))
}

#[cfg(test)]
mod tests;
