//! Walkers before a fixed camera, of whom some carry phones; the tracker's ids break and swap.

use std::fmt::Write as _;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Image size of the camera.
pub(super) const IMAGE: &str = "1920x1080";
const SIZE_PX: [f64; 2] = [1920.0, 1080.0];
const FRAMES_PER_S: usize = 2;
/// Start of the recording.
const START_S: i64 = 1_704_067_200;
/// Where the camera stands.
const ORIGIN_DEG: [f64; 2] = [11.0, 48.0];

/// The parameters of the simulation.
#[derive(Clone, Copy)]
pub(super) struct Crowd {
    pub(super) seed: u64,
    pub(super) walkers: usize,
    /// The first walkers carry phones.
    pub(super) phones: usize,
    pub(super) seconds: usize,
    /// Mean time until a tracker gives a target another id, s.
    pub(super) lifetime_s: f64,
    /// Mean time between two swaps of ids of neighbours, s.
    pub(super) swap_s: f64,
}

/// A recording with its truth.
pub(super) struct Recorded {
    pub(super) detections: String,
    pub(super) fixes: String,
    /// Walker of each row of detections.
    pub(super) walkers: Vec<usize>,
}

/// An upright pinhole camera.
struct Camera {
    focal_px: f64,
    height_m: f64,
    pitch: f64,
    yaw: f64,
}

impl Camera {
    fn drawn(random: &mut ChaCha8Rng) -> Self {
        Self {
            focal_px: SIZE_PX[0] * random.random_range(0.65..0.95),
            height_m: random.random_range(5.0..8.0),
            pitch: random.random_range(0.22..0.32),
            yaw: random.random_range(0.0..std::f64::consts::TAU),
        }
    }

    /// Pixel of a point to the right, ahead and above the ground, m.
    fn pixel(&self, [right, ahead, up]: [f64; 3]) -> [f64; 2] {
        let (sin, cos) = self.pitch.sin_cos();
        let down = self.height_m - up;
        let depth = ahead * cos + down * sin;
        let along = down * cos - ahead * sin;
        [0.5 * SIZE_PX[0] + self.focal_px * right / depth, 0.5 * SIZE_PX[1] + self.focal_px * along / depth]
    }

    fn position_deg(&self, [right, ahead]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.yaw.sin_cos();
        let (east_m, north_m) = (cos * right + sin * ahead, cos * ahead - sin * right);
        [
            ORIGIN_DEG[0] + east_m / (111_320.0 * ORIGIN_DEG[1].to_radians().cos()),
            ORIGIN_DEG[1] + north_m / 111_200.0,
        ]
    }
}

struct Walker {
    at: [f64; 2],
    goal: [f64; 2],
    speed_m_s: f64,
    pause_s: f64,
    height_m: f64,
    id: usize,
    bias_m: [f64; 2],
}

fn normal(random: &mut ChaCha8Rng) -> f64 {
    random.sample(StandardNormal)
}

/// A point of the square before the camera: most of it is in view.
fn goal(random: &mut ChaCha8Rng) -> [f64; 2] {
    let ahead = random.random_range(9.0..32.0);
    [0.62 * ahead * random.random_range(-1.0..1.0), ahead]
}

impl Walker {
    fn drawn(id: usize, random: &mut ChaCha8Rng) -> Self {
        Self {
            at: goal(random),
            goal: goal(random),
            speed_m_s: 1.2 + 0.2 * normal(random),
            pause_s: 0.0,
            height_m: 1.70 * (0.05 * normal(random)).exp(),
            id,
            bias_m: [2.5 * normal(random), 2.5 * normal(random)],
        }
    }

    fn step(&mut self, elapsed_s: f64, random: &mut ChaCha8Rng) {
        // The receiver's bias: a Gauss-Markov process of 2.5 m and 30 s.
        let decay = (-elapsed_s / 30.0_f64).exp();
        for bias_m in &mut self.bias_m {
            *bias_m = decay * *bias_m + 2.5 * (1.0 - decay * decay).sqrt() * normal(random);
        }
        if self.pause_s > 0.0 {
            self.pause_s -= elapsed_s;
            return;
        }
        let [right, ahead] = [self.goal[0] - self.at[0], self.goal[1] - self.at[1]];
        let distance_m = right.hypot(ahead);
        let step_m = self.speed_m_s.max(0.5) * elapsed_s;
        if distance_m <= step_m {
            self.goal = goal(random);
            self.pause_s = if random.random::<f64>() < 0.3 { random.random_range(2.0..10.0) } else { 0.0 };
        } else {
            self.at = [self.at[0] + right / distance_m * step_m, self.at[1] + ahead / distance_m * step_m];
        }
    }
}

fn time(seconds: f64) -> String {
    let at = jiff::Timestamp::from_millisecond(START_S * 1000 + (seconds * 1000.0) as i64).expect("in range");
    format!("{at:.3}")
}

impl Crowd {
    pub(super) fn recorded(self) -> Recorded {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        let camera = Camera::drawn(&mut random);
        let mut walkers: Vec<Walker> = (0..self.walkers).map(|id| Walker::drawn(id, &mut random)).collect();
        let mut ids = self.walkers;
        let mut recorded = Recorded {
            detections: "time,target_id,left,top,width,height,class\n".to_owned(),
            fixes: "time,receiver_id,longitude,latitude\n".to_owned(),
            walkers: Vec::new(),
        };
        let step_s = 1.0 / FRAMES_PER_S as f64;
        for frame in 0..self.seconds * FRAMES_PER_S {
            let seconds = frame as f64 * step_s;
            for walker in &mut walkers {
                walker.step(step_s, &mut random);
                if random.random::<f64>() < step_s / self.lifetime_s {
                    walker.id = ids;
                    ids += 1;
                }
            }
            if random.random::<f64>() < step_s / self.swap_s {
                swap_neighbours(&mut walkers, &mut random);
            }
            for (number, walker) in walkers.iter().enumerate() {
                let seen = box_of(&camera, walker, &mut random);
                if let Some([left, top, width, height]) = seen {
                    let id = walker.id;
                    writeln!(
                        recorded.detections,
                        "{},{id},{left:.2},{top:.2},{width:.2},{height:.2},person",
                        time(seconds)
                    )
                    .expect("memory");
                    recorded.walkers.push(number);
                }
                if number < self.phones && frame % FRAMES_PER_S == 0 {
                    let own = camera.position_deg(walker.at);
                    let error = walker.bias_m.map(|bias_m| bias_m + 0.75 * normal(&mut random));
                    let longitude = own[0] + error[0] / (111_320.0 * ORIGIN_DEG[1].to_radians().cos());
                    let latitude = own[1] + error[1] / 111_200.0;
                    writeln!(
                        recorded.fixes,
                        "{},phone-{number},{longitude:.8},{latitude:.8}",
                        time(seconds + 0.2)
                    )
                    .expect("memory");
                }
            }
        }
        recorded
    }
}

/// The two walkers that are nearest to each other get each other's ids.
fn swap_neighbours(walkers: &mut [Walker], random: &mut ChaCha8Rng) {
    let one = random.random_range(0..walkers.len());
    let distance = |other: usize| {
        let (a, b) = (walkers[one].at, walkers[other].at);
        (a[0] - b[0]).hypot(a[1] - b[1])
    };
    let nearest =
        (0..walkers.len()).filter(|other| *other != one).min_by(|a, b| distance(*a).total_cmp(&distance(*b)));
    if let Some(other) = nearest {
        let id = walkers[one].id;
        walkers[one].id = walkers[other].id;
        walkers[other].id = id;
    }
}

/// A box with 2 px of noise; `None` out of view.
fn box_of(camera: &Camera, walker: &Walker, random: &mut ChaCha8Rng) -> Option<[f64; 4]> {
    let [right, ahead] = walker.at;
    let foot = camera.pixel([right, ahead, 0.0]);
    let head = camera.pixel([right, ahead, walker.height_m]);
    let height = foot[1] - head[1];
    let width = 0.32 * height;
    let mut noise = || 2.0 * normal(random);
    let [left, top] = [foot[0] - 0.5 * width + noise(), head[1] + noise()];
    let (right_px, bottom) = (foot[0] + 0.5 * width + noise(), foot[1] + noise());
    let is_inside = left > 0.0 && top > 0.0 && right_px < SIZE_PX[0] && bottom < SIZE_PX[1];
    is_inside.then_some([left, top, right_px - left, bottom - top])
}
