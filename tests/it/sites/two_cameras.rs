//! Two cameras at both ends of a square that see its middle together, and people who walk across.

use std::f64::consts::TAU;
use std::fmt::Write as _;

use jiff::{SignedDuration, Timestamp};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use sightfix::geo::{EastNorth, LocalPlane, Position};

use crate::harness::TestServer;

pub(super) const CAMERAS: [&str; 2] = ["west", "east"];
/// Distance of the cameras, m.
const BASE_M: f64 = 80.0;
/// Distances at which a camera sees people, m.
const RANGE_M: [f64; 2] = [9.0, 47.0];
const HEIGHT_M: f64 = 7.0;
const TILT_DEG: f64 = 13.0;
const FOCAL_PX: f64 = 1_080.0;
const IMAGE_PX: [f64; 2] = [1_280.0, 720.0];
const PERSON_M: f64 = 1.72;
/// Standard deviation of a box's edges, px, and of a fix per axis, m.
const BOX_NOISE_PX: f64 = 0.7;
const FIX_NOISE_M: f64 = 0.6;

/// The plane of the square; the western camera is at its origin.
pub(super) fn plane() -> LocalPlane {
    LocalPlane::new(Position::new(24.745_3, 59.437_1).expect("valid"))
}

pub(super) struct Noise(ChaCha8Rng);

impl Noise {
    pub(super) fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// About normal, of that standard deviation.
    fn draw(&mut self, sigma: f64) -> f64 {
        let sum: f64 = (0..12).map(|_| self.0.random::<f64>()).sum();
        sigma * (sum - 6.0)
    }
}

/// Left, top, width and height of a person's box as a camera (0 in the west, 1 in the east) sees it, px; `None` out
/// of view.
pub(super) fn sides_px(camera: usize, at: EastNorth, noise: &mut Noise) -> Option<[f64; 4]> {
    let facing = if camera == 0 { 1.0 } else { -1.0 };
    let ahead_m = if camera == 0 { at.east_m } else { BASE_M - at.east_m };
    let right_m = -facing * at.north_m;
    if !(RANGE_M[0]..RANGE_M[1]).contains(&ahead_m) {
        return None;
    }
    let (sin_tilt, cos_tilt) = TILT_DEG.to_radians().sin_cos();
    let pixel = |up_m: f64| {
        let down_m = HEIGHT_M - up_m;
        let depth_m = ahead_m * cos_tilt + down_m * sin_tilt;
        let below_m = down_m * cos_tilt - ahead_m * sin_tilt;
        (0.5 * IMAGE_PX[0] + FOCAL_PX * right_m / depth_m, 0.5 * IMAGE_PX[1] + FOCAL_PX * below_m / depth_m)
    };
    let (foot, head) = (pixel(0.0), pixel(PERSON_M));
    let height_px = foot.1 - head.1;
    let mut noisy = |px: f64| px + noise.draw(BOX_NOISE_PX);
    let [left, right] = [noisy(foot.0 - 0.16 * height_px), noisy(foot.0 + 0.16 * height_px)];
    let [top, bottom] = [noisy(head.1), noisy(foot.1)];
    let is_inside = left > 2.0 && right < IMAGE_PX[0] - 2.0 && top > 2.0 && bottom < IMAGE_PX[1] - 2.0;
    is_inside.then_some([left, top, right - left, bottom - top])
}

pub(super) fn box_json([left, top, width, height]: [f64; 4]) -> Value {
    json!({"left_px": left, "top_px": top, "width_px": width, "height_px": height})
}

/// Samples of four people who stroll about in the view of a camera, one a second.
fn training_csv(camera: usize) -> String {
    let mut noise = Noise::new(17 + camera as u64);
    let mut csv = "time,target_id,left,top,width,height,longitude,latitude\n".to_owned();
    let start: Timestamp = "2026-01-05T08:00:00Z".parse().expect("an instant");
    for walker in 0..4_i64 {
        for second in 0..200_i64 {
            let swing =
                |period_s: f64, phase: f64| (TAU * second as f64 / period_s + phase * walker as f64).sin();
            let ahead_m = 29.0 + 17.0 * swing(110.0, 1.7);
            let east_m = if camera == 0 { ahead_m } else { BASE_M - ahead_m };
            let at = EastNorth { east_m, north_m: 0.42 * ahead_m * swing(83.0, 1.0) };
            let Some([left, top, width, height]) = sides_px(camera, at, &mut noise) else { continue };
            let time = start + SignedDuration::from_secs(1_000 * walker + second);
            let measured = EastNorth {
                east_m: at.east_m + noise.draw(FIX_NOISE_M),
                north_m: at.north_m + noise.draw(FIX_NOISE_M),
            };
            let fix = plane().to_position(measured);
            writeln!(
                csv,
                "{time},w{walker},{left:.2},{top:.2},{width:.2},{height:.2},{},{}",
                fix.longitude_deg(),
                fix.latitude_deg()
            )
            .expect("memory can be written");
        }
    }
    csv
}

/// Creates the site `square` with both cameras, and trains these if wanted.
pub(super) async fn create(server: &TestServer, is_trained: bool) {
    server.post("/v1/sites", &json!({"id": "square"})).await.expect(201);
    for (index, camera) in CAMERAS.into_iter().enumerate() {
        let profile = json!({
            "id": camera, "site": "square", "image_size": {"width_px": IMAGE_PX[0] as u32, "height_px": IMAGE_PX[1] as u32},
            "gnss_error": {"sigma_m": FIX_NOISE_M},
        });
        server.post("/v1/cameras", &profile).await.expect(201);
        if is_trained {
            let kind = [("content-type", "text/csv")];
            let path = format!("/v1/cameras/{camera}/samples");
            server.send("POST", &path, &kind, training_csv(index)).await.expect(200);
            let run = server.train(camera, &json!({"recipe": "gaussian_process"})).await;
            assert_eq!(run["state"], "succeeded", "{run}");
        }
    }
}

/// People who cross the square from west to east at 1.4 m/s.
pub(super) struct Crossing {
    pub(super) start: Timestamp,
    pub(super) walkers: usize,
}

/// A box of a frame: who it is, the id of the camera's own tracker, and the box.
pub(super) struct Seen {
    pub(super) walker: usize,
    pub(super) tracker_id: String,
    pub(super) sides_px: [f64; 4],
}

impl Crossing {
    pub(super) const FRAMES: usize = 220;
    const FRAME_MS: i64 = 200;

    pub(super) fn time(&self, frame: usize) -> Timestamp {
        self.start + SignedDuration::from_millis(Self::FRAME_MS * frame as i64)
    }

    /// Where a walker is; they walk one behind the other, in lanes.
    pub(super) fn position(&self, walker: usize, frame: usize) -> EastNorth {
        let walked_m = 1.4 * 0.001 * (Self::FRAME_MS * frame as i64) as f64;
        EastNorth { east_m: 10.5 + walked_m - 2.0 * walker as f64, north_m: 3.0 * walker as f64 - 3.0 }
    }

    /// The detections of a camera. Both trackers count from 1, in opposite orders: their ids have nothing in common.
    pub(super) fn seen(&self, camera: usize, frame: usize, noise: &mut Noise) -> Vec<Seen> {
        let seen = |walker: usize| {
            let number = if camera == 0 { walker + 1 } else { self.walkers - walker };
            let sides_px = sides_px(camera, self.position(walker, frame), noise)?;
            Some(Seen { walker, tracker_id: number.to_string(), sides_px })
        };
        (0..self.walkers).filter_map(seen).collect()
    }
}
