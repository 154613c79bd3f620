//! Ships that pass a camera on the shore: sparse AIS fixes, some repeated, among emitters out of view.

use std::fmt::Write as _;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::Recorded;

const START_S: i64 = 1_704_067_200;
const ORIGIN_DEG: [f64; 2] = [9.0, 54.0];
const FOCAL_PX: f64 = 1_900.0;
const CAMERA_M: f64 = 30.0;
const PITCH: f64 = 0.045;

fn normal(random: &mut ChaCha8Rng) -> f64 {
    random.sample(StandardNormal)
}

fn time(seconds: f64) -> String {
    let at = jiff::Timestamp::from_millisecond(START_S * 1000 + (seconds * 1000.0) as i64).expect("in range");
    format!("{at:.3}")
}

fn degrees([east_m, north_m]: [f64; 2]) -> [f64; 2] {
    [
        ORIGIN_DEG[0] + east_m / (111_320.0 * ORIGIN_DEG[1].to_radians().cos()),
        ORIGIN_DEG[1] + north_m / 111_300.0,
    ]
}

/// Pixel of a point to the right, ahead and above the water, m.
fn pixel([right, ahead, up]: [f64; 3]) -> [f64; 2] {
    let (sin, cos) = PITCH.sin_cos();
    let down = CAMERA_M - up;
    let depth = ahead * cos + down * sin;
    [960.0 + FOCAL_PX * right / depth, 540.0 + FOCAL_PX * (down * cos - ahead * sin) / depth]
}

/// One straight way: from a point at a time, m and m/s.
struct Way {
    from_s: f64,
    from_m: [f64; 2],
    velocity_m_s: [f64; 2],
}

impl Way {
    fn at(&self, at_s: f64) -> [f64; 2] {
        [0, 1].map(|axis| self.from_m[axis] + self.velocity_m_s[axis] * (at_s - self.from_s))
    }
}

/// Two ships that pass `passes` times each, and twenty emitters that are never seen.
pub(super) fn recorded(seed: u64, passes: usize) -> Recorded {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let yaw: f64 = random.random_range(0.0..std::f64::consts::TAU);
    let turned = |[right, ahead]: [f64; 2]| {
        [yaw.cos() * right + yaw.sin() * ahead, yaw.cos() * ahead - yaw.sin() * right]
    };
    let mut recorded = Recorded {
        detections: "time,target_id,left,top,width,height,class\n".to_owned(),
        fixes: "time,receiver_id,longitude,latitude\n".to_owned(),
        walkers: Vec::new(),
    };
    let pass_s = 420.0;
    let mut fixes: Vec<(f64, String, [f64; 2])> = Vec::new();
    for ship in 0..2 {
        let (length_m, height_m) = ([90.0, 55.0][ship], [22.0, 16.0][ship]);
        for pass in 0..passes {
            let from_s = pass as f64 * pass_s + 150.0 * ship as f64;
            let side = if random.random::<bool>() { 1.0 } else { -1.0 };
            let ahead_m = random.random_range(450.0..1_100.0);
            let speed_m_s = random.random_range(5.0..8.0);
            let heading: f64 = random.random_range(-0.5..0.5);
            let way = Way {
                from_s,
                from_m: [-side * 700.0, ahead_m - 250.0 * heading],
                velocity_m_s: [side * speed_m_s * heading.cos(), speed_m_s * heading.sin()],
            };
            let duration_s = 1_400.0 / speed_m_s;
            boxes_of_pass(&way, duration_s, [length_m, height_m], (ship, pass), &mut recorded, &mut random);
            let along = [way.velocity_m_s[0] / speed_m_s, way.velocity_m_s[1] / speed_m_s];
            let mut at_s = from_s + random.random_range(0.0..5.0);
            while at_s < from_s + duration_s {
                let at = way.at(at_s);
                let antenna = [0, 1].map(|axis| at[axis] - 0.2 * length_m * along[axis]);
                fixes.push((at_s, format!("ship-{ship}"), antenna));
                at_s += random.random_range(2.0..12.0);
            }
        }
    }
    for emitter in 0..20 {
        let (distance_m, bearing) =
            (random.random_range(2_500.0..9_000.0), random.random_range(0.0..std::f64::consts::TAU));
        let speed_m_s = if emitter % 3 == 0 { 0.0 } else { random.random_range(3.0..9.0) };
        let heading: f64 = random.random_range(0.0..std::f64::consts::TAU);
        let way = Way {
            from_s: 0.0,
            from_m: [distance_m * f64::cos(bearing), distance_m * f64::sin(bearing)],
            velocity_m_s: [speed_m_s * heading.cos(), speed_m_s * heading.sin()],
        };
        let mut at_s = random.random_range(0.0..20.0);
        while at_s < passes as f64 * pass_s {
            fixes.push((at_s, format!("emitter-{emitter}"), way.at(at_s)));
            at_s += random.random_range(5.0..30.0);
        }
    }
    fixes.sort_by(|one, other| one.0.total_cmp(&other.0));
    for (at_s, receiver, at) in fixes {
        let [right, ahead] = at.map(|own| own + 3.0 * normal(&mut random));
        let [longitude, latitude] = degrees(turned([right, ahead]));
        writeln!(recorded.fixes, "{},{receiver},{longitude:.8},{latitude:.8}", time(at_s)).expect("memory");
        // Gateways send the latest position again.
        if random.random::<f64>() < 0.5 {
            writeln!(recorded.fixes, "{},{receiver},{longitude:.8},{latitude:.8}", time(at_s + 1.0))
                .expect("memory");
        }
    }
    recorded
}

fn boxes_of_pass(
    way: &Way,
    duration_s: f64,
    [length_m, height_m]: [f64; 2],
    (ship, pass): (usize, usize),
    recorded: &mut Recorded,
    random: &mut ChaCha8Rng,
) {
    for second in 0..duration_s as usize {
        let at_s = way.from_s + second as f64;
        let [right, ahead] = way.at(at_s);
        let foot = pixel([right, ahead, 0.0]);
        let head = pixel([right, ahead, height_m]);
        let width = FOCAL_PX * length_m / ahead;
        let mut noise = || 2.0 * normal(random);
        let (left, top, bottom) = (foot[0] - 0.5 * width + noise(), head[1] + noise(), foot[1] + noise());
        if left < 0.0 || left + width > 1_920.0 || top < 0.0 || bottom > 1_080.0 {
            continue;
        }
        let height = bottom - top;
        writeln!(
            recorded.detections,
            "{},{},{left:.2},{top:.2},{width:.2},{height:.2},ship",
            time(at_s),
            100 * (ship + 1) + pass
        )
        .expect("memory");
        recorded.walkers.push(ship);
    }
}
