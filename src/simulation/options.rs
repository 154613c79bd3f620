//! The options that determine a simulated world.

use jiff::{SignedDuration, Timestamp};

use super::scene::Scene;

/// Default time of the first row: 2026-01-05T08:00:00Z, in seconds since 1970.
const START_S: i64 = 1_767_600_000;

/// Where the targets move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Route {
    /// Along the scene's lines.
    Lines,
    /// Along lines parallel to them, which a world of [`Route::Lines`] never covers.
    NewLine,
    /// Each target stays at one point of a line.
    Standing,
}

/// Parameters of a world. Shares are of rows, 0 to 0.95.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The scene.
    pub scene: Scene,
    /// Seed of everything but the camera.
    pub seed: u64,
    /// Seed of the camera's height, focal length and orientation.
    pub camera_seed: u64,
    /// Number of rows over all targets.
    pub samples: usize,
    /// Where the targets move.
    pub route: Route,
    /// Number of targets, each with its own receiver and size; their rows are interleaved by time.
    pub targets: usize,
    /// Standard deviation per axis of a receiver's error, m.
    pub gnss_sigma_m: f64,
    /// Standard deviation of each edge of a bounding box, px.
    pub box_noise_px: f64,
    /// Radial displacement at the image's corner divided by its distance from the centre; negative for
    /// barrel distortion.
    pub lens_distortion: f64,
    /// Whether rows whose box is truncated by the image border are kept.
    pub border_cuts: bool,
    /// Share of rows in which the lower part of the target, or all of it, is occluded.
    pub occlusion: f64,
    /// Share of rows whose fix or box is an outlier.
    pub outliers: f64,
    /// Share of rows without a fix, in episodes of 20 s on average.
    pub gnss_gaps: f64,
    /// From that instant on the camera is rotated by that many degrees to the right.
    pub pan_deg_from: Option<(Timestamp, f64)>,
    /// Time of the first row, whole seconds.
    pub start: Timestamp,
}

impl Options {
    /// The scene with the paper's parameters: 10,000 rows of one target, 1 px of box noise.
    #[must_use]
    pub fn new(scene: Scene) -> Self {
        Self {
            scene,
            seed: 1,
            camera_seed: 1,
            samples: 10_000,
            route: Route::Lines,
            targets: 1,
            gnss_sigma_m: match scene {
                Scene::Airport => 29.5,
                Scene::Square => 2.2,
            },
            box_noise_px: 1.0,
            lens_distortion: -0.02,
            border_cuts: matches!(scene, Scene::Airport),
            occlusion: 0.0,
            outliers: 0.0,
            gnss_gaps: 0.0,
            pan_deg_from: None,
            start: Timestamp::from_second(START_S).unwrap_or(Timestamp::UNIX_EPOCH),
        }
    }

    /// A small square with two pedestrians, to train on within seconds.
    #[must_use]
    pub fn demo() -> Self {
        Self { samples: 600, targets: 2, ..Self::new(Scene::Square) }
    }

    /// The test world of a model trained on this one: the same camera, other traverses and noise, a
    /// week after the start.
    #[must_use]
    pub fn test(&self, samples: usize) -> Self {
        Self {
            // Any odd multiplier: distinct seeds get distinct test seeds.
            seed: self.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x5bd1),
            samples,
            start: self.start.saturating_add(SignedDuration::from_hours(168)).unwrap_or(self.start),
            ..self.clone()
        }
    }
}

impl Default for Options {
    fn default() -> Self {
        Self::new(Scene::Airport)
    }
}
