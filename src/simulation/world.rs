//! Makes the rows of a world: targets move, the camera boxes them, receivers err.

use jiff::{SignedDuration, Timestamp};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::camera::Camera;
use super::noise::{Episodes, Receiver, standard_normal, stream};
use super::path::{Path, Pose};
use super::scene::Scene;
use crate::domain::{BoundingBox, Fix, ImageSize, Sample, TargetClass, TargetId};
use crate::geo::{LocalPlane, Position};

/// 2026-01-05T08:00:00Z.
const START_S: i64 = 1_767_600_000;
/// A box of which less than this share of the width or height is in the image is not detected.
const LEAST_VISIBLE: f64 = 0.25;

/// Where the targets go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Route {
    /// Along the scene's lines.
    Lines,
    /// Along lines moved aside, which a world of [`Route::Lines`] never shows.
    NewLine,
    /// Nowhere: each stands at a point of the line.
    Standing,
}

/// All that a world comes from. The shares are of rows, 0 to 0.95.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The place.
    pub scene: Scene,
    /// Seed of all that happens.
    pub seed: u64,
    /// Seed of the camera's place and aim.
    pub camera_seed: u64,
    /// Rows over all targets.
    pub samples: usize,
    /// Where the targets go.
    pub route: Route,
    /// Targets, each with its own receiver and size, their rows interleaved.
    pub targets: usize,
    /// Standard deviation per axis of a receiver's error, m.
    pub gnss_sigma_m: f64,
    /// Standard deviation of each edge of a box, px.
    pub box_noise_px: f64,
    /// Radial displacement at the image's corner as a share of the distance from its centre;
    /// negative is a barrel.
    pub lens_distortion: f64,
    /// Keep rows whose box the border cuts; else they are left out.
    pub border_cuts: bool,
    /// Share of rows in which something hides the target's lower part, or all of it.
    pub occlusion: f64,
    /// Share of rows whose fix or box is far off.
    pub outliers: f64,
    /// Share of rows without a fix, in stretches of about 20 s.
    pub gnss_gaps: f64,
    /// From that instant on the camera looks that many degrees to the right of where it did.
    pub pan_deg_from: Option<(Timestamp, f64)>,
    /// Time of the first row, to the second.
    pub start: Timestamp,
}

impl Options {
    /// The scene as the paper has it: 10,000 rows of one target, 1 px of box noise.
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

    /// A small square with two walkers, learnt in a second or two.
    #[must_use]
    pub fn demo() -> Self {
        Self { samples: 600, targets: 2, ..Self::new(Scene::Square) }
    }
}

impl Options {
    /// What to try on a model of this world: the same camera, other passes and other noise, a week
    /// after the start.
    #[must_use]
    pub fn test(&self, samples: usize) -> Self {
        Self {
            // Any odd constant: what matters is that no two seeds share their test noise.
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

/// One target at one second.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedRow {
    /// When.
    pub time: Timestamp,
    /// Who.
    pub target_id: TargetId,
    /// What it is.
    pub class: TargetClass,
    /// What the detector drew; `None` where something hides the target.
    pub bounding_box: Option<BoundingBox>,
    /// What the receiver said; `None` in a gap.
    pub fix: Option<Fix>,
    /// Where the antenna was.
    pub truth: Position,
}

/// Rows with their truth, in the order of time, then target.
#[derive(Debug, Clone, PartialEq)]
pub struct World {
    /// Of the camera.
    pub image_size: ImageSize,
    /// Standard deviation per axis of every receiver, m.
    pub gnss_sigma_m: f64,
    /// Fewer than asked for only if the camera, once knocked, sees no target.
    pub rows: Vec<SimulatedRow>,
    /// The lines that the targets follow, but for their wander.
    pub truth_lines: Vec<Vec<Position>>,
    /// Where the first target stands, under [`Route::Standing`].
    pub truth_point: Option<Position>,
}

impl World {
    /// The rows that have a box and a fix.
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

/// The world of those options.
#[must_use]
pub fn simulate(options: &Options) -> World {
    let scene = options.scene;
    let mut random = stream(options.camera_seed, 0);
    let camera = scene.camera(options.border_cuts, options.lens_distortion, &mut random);
    let mut paths = scene.paths(camera.pan_deg);
    if options.route == Route::NewLine {
        paths = paths.iter().map(|path| path.aside(scene.new_line_aside_m())).collect();
    }
    let plane = LocalPlane::new(scene.origin());
    let targets = options.targets.max(1);
    let mut rows = Vec::with_capacity(options.samples);
    let mut truth_point = None;
    for index in 0..targets {
        let share = options.samples / targets + usize::from(index < options.samples % targets);
        let mut target = Target::new(options, camera, plane, index);
        let first = rows.len();
        target.run(&paths, share, &mut rows);
        if options.route == Route::Standing && index == 0 {
            truth_point = rows.get(first).map(|row: &SimulatedRow| row.truth);
        }
    }
    rows.sort_by(|one, other| (one.time, &one.target_id).cmp(&(other.time, &other.target_id)));
    let positions = |path: &Path| path.points.iter().map(|&point| plane.to_position(point)).collect();
    World {
        image_size: camera.image_size,
        gnss_sigma_m: options.gnss_sigma_m,
        rows,
        truth_lines: paths.iter().map(positions).collect(),
        truth_point,
    }
}

/// A world to learn from and one to be tried on: the same camera, other passes and other noise, a
/// week later.
#[must_use]
pub fn simulate_split(options: &Options, test_rows: usize) -> (World, World) {
    (simulate(options), simulate(&options.test(test_rows)))
}

/// One target with its receiver, and what its detector suffers.
struct Target<'a> {
    options: &'a Options,
    camera: Camera,
    plane: LocalPlane,
    id: TargetId,
    class: TargetClass,
    scale: f64,
    time: Timestamp,
    motion: ChaCha8Rng,
    body: ChaCha8Rng,
    detector: ChaCha8Rng,
    outlier: ChaCha8Rng,
    receiver: Receiver,
    /// Seconds since the receiver was asked last.
    silent_s: f64,
    gaps: Episodes,
    occlusion: Episodes,
}

impl<'a> Target<'a> {
    fn new(options: &'a Options, camera: Camera, plane: LocalPlane, index: usize) -> Self {
        let scene = options.scene;
        let number = index as u64;
        let draw = |kind: u64| stream(options.seed, 16 * number + kind);
        let mut motion = draw(0);
        let mut chance = draw(1);
        let receiver_error = scene.receiver_error(options.gnss_sigma_m, &mut chance);
        let delay_s = if index == 0 { 0 } else { chance.random_range(0..30) };
        // The first target has the scene's usual size, so that one target is the paper's case.
        let scale = if index == 0 { 1.0 } else { 1.0 + 0.08 * standard_normal(&mut motion).clamp(-1.5, 1.5) };
        let name = |text: &str| TargetId::new(text).expect("short printable names");
        Self {
            options,
            camera,
            plane,
            id: name(&format!("{}-{}", scene.class(), index + 1)),
            class: TargetClass::new(scene.class()).expect("short printable names"),
            scale,
            time: later(options.start, delay_s),
            motion,
            body: draw(2),
            detector: draw(3),
            outlier: draw(4),
            receiver: Receiver::new(receiver_error, draw(5)),
            silent_s: 0.0,
            gaps: Episodes::new(options.gnss_gaps, 20.0, draw(6)),
            occlusion: Episodes::new(options.occlusion, 5.0, draw(7)),
        }
    }

    /// Adds that many rows, pass by pass.
    fn run(&mut self, paths: &[Path], count: usize, rows: &mut Vec<SimulatedRow>) {
        let full = rows.len() + count;
        // A camera that was turned away sees nothing for ever; then the world ends early.
        for pass in 0..20 + 2 * count {
            if rows.len() >= full {
                return;
            }
            let path = &paths[pass % paths.len()];
            let poses = self.poses(path, pass, count);
            for pose in poses {
                if rows.len() < full {
                    rows.extend(self.row(pose));
                }
                self.time = later(self.time, 1);
                self.silent_s += 1.0;
            }
            let pause_s = self.options.scene.pause_s(&mut self.motion);
            self.time = later(self.time, pause_s);
            self.silent_s += pause_s as f64;
        }
    }

    fn poses(&mut self, path: &Path, pass: usize, count: usize) -> Vec<Pose> {
        if self.options.route == Route::Standing {
            let along_m = path.length_m() * self.motion.random_range(0.3..0.7);
            return vec![path.pose(along_m, 0.0); count];
        }
        let gait = self.options.scene.gait();
        path.pass(&gait, gait.both_ways && pass % 2 == 1, &mut self.motion)
    }

    /// The row of this second, if the target is in sight.
    fn row(&mut self, pose: Pose) -> Option<SimulatedRow> {
        let bounding_box = self.detect(pose)?;
        let (hidden, how) = self.occlusion.next_row();
        let mut bounding_box = if hidden { occlude(bounding_box, how) } else { Some(bounding_box) };
        let (silent, _) = self.gaps.next_row();
        let mut place = self.receiver.measure(pose.place, self.silent_s);
        self.silent_s = 0.0;
        if self.outlier.random::<f64>() < self.options.outliers {
            if self.outlier.random::<bool>() {
                let far_m = 8.0 * self.options.gnss_sigma_m;
                let angle = std::f64::consts::TAU * self.outlier.random::<f64>();
                place.east_m += far_m * angle.cos();
                place.north_m += far_m * angle.sin();
            } else {
                bounding_box = bounding_box.and_then(|drawn| self.elsewhere(drawn));
            }
        }
        let fix = Fix { position: self.plane.to_position(place), sigma_m: None };
        Some(SimulatedRow {
            time: self.time,
            target_id: self.id.clone(),
            class: self.class.clone(),
            bounding_box,
            fix: (!silent).then_some(fix),
            truth: self.plane.to_position(pose.place),
        })
    }

    /// The detector's box of the target in full view, cut by the border; `None` out of sight.
    fn detect(&mut self, pose: Pose) -> Option<BoundingBox> {
        let mut camera = self.camera;
        if let Some((from, turn_deg)) = self.options.pan_deg_from
            && self.time >= from
        {
            camera.pan_deg += turn_deg;
        }
        let body = self.options.scene.body(pose, self.scale, &mut self.body);
        let mut edges = camera.extents(&body)?;
        for edge in &mut edges {
            *edge += self.options.box_noise_px * standard_normal(&mut self.detector);
        }
        let (width_px, height_px) = camera.size_px();
        let cut = [edges[0].max(0.0), edges[1].max(0.0), edges[2].min(width_px), edges[3].min(height_px)];
        let in_sight = cut[2] - cut[0] > LEAST_VISIBLE * (edges[2] - edges[0])
            && cut[3] - cut[1] > LEAST_VISIBLE * (edges[3] - edges[1]);
        let [left, top, right, bottom] = cut;
        let drawn = BoundingBox::new(left, top, right - left, bottom - top).ok().filter(|_| in_sight)?;
        (self.options.border_cuts || !drawn.touches_border(Some(camera.image_size))).then_some(drawn)
    }

    /// A box of that size somewhere else in the image: the detector took something else for it.
    fn elsewhere(&mut self, drawn: BoundingBox) -> Option<BoundingBox> {
        let (width_px, height_px) = self.camera.size_px();
        let left_px = (width_px - drawn.width_px()).max(0.0) * self.outlier.random::<f64>();
        let top_px = (height_px - drawn.height_px()).max(0.0) * self.outlier.random::<f64>();
        BoundingBox::new(left_px, top_px, drawn.width_px(), drawn.height_px()).ok()
    }
}

/// A third of hidden boxes vanish, the others lose 15 to 60 % of their height from below.
fn occlude(drawn: BoundingBox, how: f64) -> Option<BoundingBox> {
    if how > 2.0 / 3.0 {
        return None;
    }
    let kept = 0.4 + 0.45 * 1.5 * how;
    BoundingBox::new(drawn.left_px(), drawn.top_px(), drawn.width_px(), kept * drawn.height_px()).ok()
}

fn later(time: Timestamp, seconds: i64) -> Timestamp {
    time.saturating_add(SignedDuration::from_secs(seconds)).unwrap_or(time)
}

#[cfg(test)]
mod tests;
