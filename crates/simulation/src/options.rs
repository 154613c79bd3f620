//! The options that determine a simulated world.

use jiff::{SignedDuration, Timestamp};
use rand::Rng;

use super::airport_form::AirportForm;
use super::camera::PinholeCamera;
use super::scene::Scene;
use super::shape::TargetShape;
use crate::domain::{GaussMarkovNoise, NoiseCorrelation};

/// Default time of the first row: 2026-01-05T08:00:00Z, in seconds since 1970.
const START_S: i64 = 1_767_600_000;

/// White part of a phone's error per axis, m, as measured; the rest is a Gauss-Markov bias.
const PHONE_WHITE_M: f64 = 0.13;

/// Where the targets move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Route {
    /// Along the scene's lines.
    Lines,
    /// Along lines parallel to them, which a world of [`Route::Lines`] never covers.
    NewLine,
    /// Between random points of the area in view, other ones for every traverse.
    Area,
    /// Each target stays at one point of a line.
    Standing,
}

/// Parameters of a world. Shares are of rows, 0 to 0.95.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The scene.
    pub scene: Scene,
    /// Camera, ground and lines of an airport.
    pub airport_form: AirportForm,
    /// Seed of everything but the camera.
    pub seed: u64,
    /// Seed of the camera's height, focal length and orientation.
    pub camera_seed: u64,
    /// Number of rows over all targets.
    pub samples: usize,
    /// Where the targets move.
    pub route: Route,
    /// Offset of [`Route::NewLine`] to the left of the lines, m; `None` for that of the scene.
    pub new_line_offset_m: Option<f64>,
    /// Mean speed of the targets, m/s; `None` for that of the scene.
    pub mean_speed_m_s: Option<f64>,
    /// Standard deviation of a target's speed from one second to the next, relative to its mean.
    pub speed_unrest: f64,
    /// Number of targets, each with its own receiver and size; their rows are interleaved by time.
    pub targets: usize,
    /// Number of sessions into which the rows are divided, each a day after the previous one, with other
    /// traverses, noise and receiver biases.
    pub sessions: usize,
    /// Extents and antenna of the targets; `None` for those of the scene.
    pub target_shape: Option<TargetShape>,
    /// Standard deviation per axis of a receiver's error, m.
    pub gnss_sigma_m: f64,
    /// Time constant of that error beside a white part of 0.13 m, s; `None` for that of the scene, which is white at the
    /// airport.
    pub gnss_time_constant_s: Option<f64>,
    /// Standard deviation per axis of an additional error that each receiver keeps for a whole session, m.
    pub gnss_bias_sigma_m: f64,
    /// Standard deviation of each edge of a bounding box, px.
    pub box_noise_px: f64,
    /// Radial displacement at the image's corner divided by its distance from the centre; negative for
    /// barrel distortion.
    pub lens_distortion: f64,
    /// True if rows whose box is truncated by the image border are kept.
    pub border_cuts: bool,
    /// True if rows with such a box are left out, although the camera truncates boxes.
    pub without_cut_boxes: bool,
    /// Share of rows in which the lower part of the target, or all of it, is occluded.
    pub occlusion: f64,
    /// Share of rows whose fix or box is an outlier.
    pub outliers: f64,
    /// Share of rows whose fix is wrong by `gross_fix_error_m` in a random direction.
    pub gross_fixes: f64,
    /// Size of those errors, m.
    pub gross_fix_error_m: f64,
    /// Share of rows without a fix, in episodes of 20 s on average.
    pub gnss_gaps: f64,
    /// The target ids are those of a tracker that loses a target after this time on average, s, and gives
    /// ids of lost targets to others; `None` for ids that never change.
    pub tracker_id_lifetime_s: Option<f64>,
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
            airport_form: AirportForm::Plain,
            seed: 1,
            camera_seed: 1,
            samples: 10_000,
            route: Route::Lines,
            new_line_offset_m: None,
            mean_speed_m_s: None,
            speed_unrest: 0.05,
            targets: 1,
            sessions: 1,
            target_shape: None,
            gnss_sigma_m: match scene {
                Scene::Airport => 29.5,
                Scene::Square => 2.2,
            },
            gnss_time_constant_s: None,
            gnss_bias_sigma_m: 0.0,
            box_noise_px: 1.0,
            lens_distortion: -0.02,
            border_cuts: matches!(scene, Scene::Airport),
            without_cut_boxes: false,
            occlusion: 0.0,
            outliers: 0.0,
            gross_fixes: 0.0,
            gross_fix_error_m: 1_000.0,
            gnss_gaps: 0.0,
            tracker_id_lifetime_s: None,
            pan_deg_from: None,
            start: Timestamp::from_second(START_S).unwrap_or(Timestamp::UNIX_EPOCH),
        }
    }

    /// A small square with two pedestrians, to train on within seconds.
    #[must_use]
    pub fn demo() -> Self {
        Self { samples: 600, targets: 2, ..Self::new(Scene::Square) }
    }

    /// The test world of a model trained on this one: the same camera, other traverses and noise, one
    /// session a week after the start, with the boxes that training leaves out.
    #[must_use]
    pub fn test(&self, samples: usize) -> Self {
        Self {
            // Any odd multiplier: distinct seeds get distinct test seeds.
            seed: self.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x5bd1),
            samples,
            sessions: 1,
            without_cut_boxes: false,
            start: self.later(7),
            ..self.clone()
        }
    }

    /// The options of one session (from 0), which has its share of the rows.
    pub(super) fn session(&self, index: usize) -> Self {
        let sessions = self.sessions.max(1);
        Self {
            // The first session is the world of one session.
            seed: self.seed.wrapping_add((index as u64).wrapping_mul(0xd134_2543_de82_ef95)),
            samples: self.samples / sessions + usize::from(index < self.samples % sessions),
            sessions: 1,
            start: self.later(index as i64),
            ..self.clone()
        }
    }

    /// Draws the camera.
    pub(super) fn camera(&self, random: &mut impl Rng) -> PinholeCamera {
        let drawn = self.scene.camera(self.border_cuts, random);
        self.airport_form.camera(PinholeCamera { lens_distortion: self.lens_distortion, ..drawn })
    }

    /// The error model of a receiver.
    pub(super) fn receiver_error(&self, random: &mut impl Rng) -> GaussMarkovNoise {
        let sigma_m = self.gnss_sigma_m;
        let own_s = self.scene.gnss_time_constant_s(random);
        let Some(time_constant_s) = self.gnss_time_constant_s.or(own_s) else {
            return GaussMarkovNoise::white(sigma_m * sigma_m);
        };
        let white_share = (PHONE_WHITE_M / sigma_m).min(1.0).powi(2);
        GaussMarkovNoise::new(sigma_m, NoiseCorrelation { white_share, time_constant_s })
    }

    fn later(&self, days: i64) -> Timestamp {
        self.start.saturating_add(SignedDuration::from_hours(24 * days)).unwrap_or(self.start)
    }
}

impl Default for Options {
    fn default() -> Self {
        Self::new(Scene::Airport)
    }
}
