//! A few rows of boxes and fixes, for tests that need a quick fit.

use std::array;

use jiff::Timestamp;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::noise::standard_normal;
use crate::domain::{BoundingBox, Fix, Sample, TargetId};
use crate::geo::{EastNorth, LocalPlane, Position};

/// Samples of a small camera 6 m above a square that a person crosses several times, with their true positions;
/// `sigma_m` is the standard deviation per axis of the fixes.
#[must_use]
pub fn walk(passes: usize, per_pass: usize, sigma_m: f64, seed: u64) -> Vec<Sample> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let plane = LocalPlane::new(Position::new(103.9868, 30.628).expect("valid"));
    let mut samples = Vec::new();
    for pass in 0..passes {
        let across_m = rng.random_range(-12.0..12.0);
        let bias: [f64; 2] = array::from_fn(|_| 0.8 * sigma_m * standard_normal(&mut rng));
        for step in 0..per_pass {
            let part = step as f64 / per_pass as f64;
            let truth = EastNorth { east_m: across_m + 6.0 * part, north_m: 15.0 + 30.0 * part };
            let fix = EastNorth {
                east_m: truth.east_m + bias[0] + 0.6 * sigma_m * standard_normal(&mut rng),
                north_m: truth.north_m + bias[1] + 0.6 * sigma_m * standard_normal(&mut rng),
            };
            samples.push(Sample {
                time: Timestamp::from_second(1_600_000_000 + (pass * 1000 + step) as i64).expect("time"),
                target_id: TargetId::new("walker").expect("name"),
                bounding_box: box_of(truth, &mut rng),
                fix: Fix { position: plane.to_position(fix), sigma_m: None },
                class: None,
                score: None,
                truth: Some(plane.to_position(truth)),
            });
        }
    }
    samples
}

/// The box of a person of 1.75 m at a position, for a camera 6 m up that looks north and 15 deg down.
fn box_of(truth: EastNorth, rng: &mut ChaCha8Rng) -> BoundingBox {
    let (sin, cos) = 15f64.to_radians().sin_cos();
    let pixel = |up_m: f64| {
        let depth_m = truth.north_m * cos + (6.0 - up_m) * sin;
        let down_m = (6.0 - up_m) * cos - truth.north_m * sin;
        (960.0 + 1200.0 * truth.east_m / depth_m, 540.0 + 1200.0 * down_m / depth_m, depth_m)
    };
    let ((foot_x, foot_y, depth_m), (_, head_y, _)) = (pixel(0.0), pixel(1.75));
    let width_px = 1200.0 * 0.6 / depth_m + 0.5 * standard_normal(rng);
    let height_px = foot_y - head_y + 0.5 * standard_normal(rng);
    let left_px = foot_x - 0.5 * width_px + 0.5 * standard_normal(rng);
    BoundingBox::new(left_px, foot_y - height_px, width_px, height_px).expect("a box")
}
