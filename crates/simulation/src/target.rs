//! One target: its motion, the camera's detections of it, and its receiver.

use jiff::{SignedDuration, Timestamp};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::camera::PinholeCamera;
use super::noise::{Episodes, SimulatedReceiver, standard_normal, stream};
use super::options::{Options, Route};
use super::path::{MotionProfile, Polyline, Pose};
use super::row::SimulatedRow;
use super::shape::TargetShape;
use crate::domain::{BoundingBox, Fix, TargetClass, TargetId};
use crate::geo::{EastNorth, LocalPlane};

/// A box of which less than this share of the width or the height is inside the image is not detected.
const MIN_VISIBLE_SHARE: f64 = 0.25;

/// One target with its receiver and the noise of its detections.
pub(super) struct SimulatedTarget<'a> {
    options: &'a Options,
    camera: PinholeCamera,
    plane: LocalPlane,
    index: usize,
    id: TargetId,
    class: TargetClass,
    shape: TargetShape,
    scale: f64,
    time: Timestamp,
    motion: ChaCha8Rng,
    area: ChaCha8Rng,
    body: ChaCha8Rng,
    detector: ChaCha8Rng,
    outlier: ChaCha8Rng,
    gross_fix: ChaCha8Rng,
    receiver: SimulatedReceiver,
    /// Since the receiver's previous measurement, s.
    since_fix_s: f64,
    gaps: Episodes,
    occlusion: Episodes,
}

impl<'a> SimulatedTarget<'a> {
    pub(super) fn new(options: &'a Options, camera: PinholeCamera, plane: LocalPlane, index: usize) -> Self {
        let scene = options.scene;
        let number = index as u64;
        let draw = |kind: u64| stream(options.seed, 16 * number + kind);
        let mut motion = draw(0);
        let mut receiver_parameters = draw(1);
        let receiver_error = options.receiver_error(&mut receiver_parameters);
        let delay_s = if index == 0 { 0 } else { receiver_parameters.random_range(0..30) };
        // The first target has the scene's nominal size, so that one target is the paper's case.
        let scale = if index == 0 { 1.0 } else { 1.0 + 0.08 * standard_normal(&mut motion).clamp(-1.5, 1.5) };
        let mut bias = draw(8);
        let mut bias_m = || options.gnss_bias_sigma_m * standard_normal(&mut bias);
        let bias = EastNorth { east_m: bias_m(), north_m: bias_m() };
        let name = |text: &str| TargetId::new(text).expect("short printable names");
        Self {
            options,
            camera,
            plane,
            index,
            id: name(&format!("{}-{}", scene.class(), index + 1)),
            class: TargetClass::new(scene.class()).expect("short printable names"),
            shape: options.target_shape.unwrap_or(scene.nominal_shape()),
            scale,
            time: later(options.start, delay_s),
            motion,
            area: draw(10),
            body: draw(2),
            detector: draw(3),
            outlier: draw(4),
            gross_fix: draw(9),
            receiver: SimulatedReceiver::new(receiver_error, bias, draw(5)),
            since_fix_s: 0.0,
            gaps: Episodes::new(options.gnss_gaps, 20.0, draw(6)),
            occlusion: Episodes::new(options.occlusion, 5.0, draw(7)),
        }
    }

    /// Appends that many rows, traverse by traverse.
    pub(super) fn run(&mut self, paths: &[Polyline], count: usize, rows: &mut Vec<SimulatedRow>) {
        let end = rows.len() + count;
        // Bounded, because a camera that was rotated away never sees the target again.
        for traverse in 0..20 + 2 * count {
            if rows.len() >= end {
                return;
            }
            let path = &paths[traverse % paths.len()];
            let poses = self.poses(path, traverse, count);
            for pose in poses {
                if rows.len() < end {
                    rows.extend(self.row(pose));
                }
                self.time = later(self.time, 1);
                self.since_fix_s += 1.0;
            }
            let pause_s = self.options.scene.pause_s(&mut self.motion);
            self.time = later(self.time, pause_s);
            self.since_fix_s += pause_s as f64;
        }
    }

    fn poses(&mut self, path: &Polyline, traverse: usize, count: usize) -> Vec<Pose> {
        if self.options.route == Route::Standing {
            let along_m = path.length_m() * self.motion.random_range(0.3..0.7);
            return vec![path.pose(along_m, 0.0); count];
        }
        let scene = self.options.scene;
        let motion = scene.motion();
        let speed_m_s = self.options.mean_speed_m_s.unwrap_or(motion.speed_m_s);
        let motion = MotionProfile { speed_m_s, speed_unrest: self.options.speed_unrest, ..motion };
        if self.options.route == Route::Area {
            let path = scene.area_path(self.camera.pan_deg, &mut self.area);
            return path.traverse(&motion, false, &mut self.motion);
        }
        path.traverse(&motion, motion.both_ways && traverse % 2 == 1, &mut self.motion)
    }

    /// The row of this second, if the target is in the field of view.
    fn row(&mut self, pose: Pose) -> Option<SimulatedRow> {
        let bounding_box = self.detect(pose)?;
        let (is_occluded, degree) = self.occlusion.next_row();
        let mut bounding_box = if is_occluded { occlude(bounding_box, degree) } else { Some(bounding_box) };
        let (is_gap, _) = self.gaps.next_row();
        let mut measured = self.receiver.measure(pose.position, self.since_fix_s);
        self.since_fix_s = 0.0;
        if self.outlier.random::<f64>() < self.options.outliers {
            if self.outlier.random::<bool>() {
                measured = displaced(measured, 8.0 * self.options.gnss_sigma_m, &mut self.outlier);
            } else {
                bounding_box = bounding_box.and_then(|bounding_box| self.false_detection(bounding_box));
            }
        }
        if self.gross_fix.random::<f64>() < self.options.gross_fixes {
            measured = displaced(measured, self.options.gross_fix_error_m, &mut self.gross_fix);
        }
        let fix = Fix { position: self.plane.to_position(measured), sigma_m: None };
        Some(SimulatedRow {
            time: self.time,
            target: self.index,
            target_id: self.id.clone(),
            class: self.class.clone(),
            bounding_box,
            fix: (!is_gap).then_some(fix),
            truth: self.plane.to_position(pose.position),
        })
    }

    /// The detector's box of the unoccluded target, truncated by the image border; `None` outside of the
    /// field of view.
    fn detect(&mut self, pose: Pose) -> Option<BoundingBox> {
        let mut camera = self.camera;
        if let Some((from, pan_deg)) = self.options.pan_deg_from
            && self.time >= from
        {
            camera.pan_deg += pan_deg;
        }
        let mut body = self.options.scene.body(pose, &self.shape, self.scale, &mut self.body);
        let ground_m = self.options.airport_form.ground_m(self.camera.right_m(pose.position));
        for point in &mut body {
            point.up_m += ground_m;
        }
        let mut edges = camera.extents(&body)?;
        for edge in &mut edges {
            *edge += self.options.box_noise_px * standard_normal(&mut self.detector);
        }
        let (width_px, height_px) = camera.size_px();
        let truncated =
            [edges[0].max(0.0), edges[1].max(0.0), edges[2].min(width_px), edges[3].min(height_px)];
        let is_visible = truncated[2] - truncated[0] > MIN_VISIBLE_SHARE * (edges[2] - edges[0])
            && truncated[3] - truncated[1] > MIN_VISIBLE_SHARE * (edges[3] - edges[1]);
        let [left, top, right, bottom] = truncated;
        let bounding_box =
            BoundingBox::new(left, top, right - left, bottom - top).ok().filter(|_| is_visible)?;
        let keeps_cut_boxes = self.options.border_cuts && !self.options.without_cut_boxes;
        let is_kept = keeps_cut_boxes || !bounding_box.touches_border(Some(camera.image_size));
        is_kept.then_some(bounding_box)
    }

    /// A box of the same size anywhere in the image.
    fn false_detection(&mut self, bounding_box: BoundingBox) -> Option<BoundingBox> {
        let (width_px, height_px) = self.camera.size_px();
        let left_px = (width_px - bounding_box.width_px()).max(0.0) * self.outlier.random::<f64>();
        let top_px = (height_px - bounding_box.height_px()).max(0.0) * self.outlier.random::<f64>();
        BoundingBox::new(left_px, top_px, bounding_box.width_px(), bounding_box.height_px()).ok()
    }
}

/// The point that far away in a random direction.
fn displaced(point: EastNorth, distance_m: f64, random: &mut ChaCha8Rng) -> EastNorth {
    let angle = std::f64::consts::TAU * random.random::<f64>();
    EastNorth {
        east_m: point.east_m + distance_m * angle.cos(),
        north_m: point.north_m + distance_m * angle.sin(),
    }
}

/// A third of occluded targets are not detected; the other boxes lose 15 to 60 % of their height at the
/// lower edge. `degree` is uniform in 0..1.
fn occlude(bounding_box: BoundingBox, degree: f64) -> Option<BoundingBox> {
    if degree > 2.0 / 3.0 {
        return None;
    }
    let visible = 0.4 + 0.45 * 1.5 * degree;
    BoundingBox::new(
        bounding_box.left_px(),
        bounding_box.top_px(),
        bounding_box.width_px(),
        visible * bounding_box.height_px(),
    )
    .ok()
}

fn later(time: Timestamp, seconds: i64) -> Timestamp {
    time.saturating_add(SignedDuration::from_secs(seconds)).unwrap_or(time)
}
