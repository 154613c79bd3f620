//! World tracks: what a site of many cameras costs, as a share of one core.

use std::time::Instant;

use jiff::{SignedDuration, Timestamp};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use sightfix::domain::{CameraId, TargetId};
use sightfix::fusion::world::{CameraFrame, WorldDetection, WorldTrackSettings, WorldTracker};
use sightfix::geo::{EastNorth, LocalPlane, PlaneCovariance, Position};

use crate::ratio::median;
use crate::tables;

const CAMERAS: usize = 20;
const TARGETS_PER_CAMERA: usize = 20;
const FRAMES_PER_S: usize = 10;
const DURATION_S: usize = 20;

pub(crate) fn run() {
    tables::head(
        "World tracks, 20 cameras x 20 targets x 10 frames a second, one thread",
        &["targets", "us per detection", "share of one core (target 1)"],
    );
    for (name, spacing_m) in [("of each camera its own", 60.0), ("each seen by two cameras", 30.0)] {
        let frames = frames(spacing_m);
        let mut rounds: Vec<f64> = (0..5).map(|_| track(&frames)).collect();
        let seconds = median(&mut rounds);
        let detections: usize = frames.iter().map(|frame| frame.detections.len()).sum();
        let per_detection_us = 1e6 * seconds / detections as f64;
        tables::row(name, &[(per_detection_us, 2), (seconds / DURATION_S as f64, 4)]);
    }
}

/// Time to process all frames, s.
fn track(frames: &[CameraFrame]) -> f64 {
    let plane = LocalPlane::new(Position::new(11.0, 48.0).expect("within range"));
    let mut tracker = WorldTracker::new(plane, WorldTrackSettings::default());
    let began = Instant::now();
    for frame in frames {
        std::hint::black_box(tracker.observe(frame));
    }
    began.elapsed().as_secs_f64()
}

/// Walkers at random within 60 m wide views at that spacing, each with its tracker's id.
fn frames(spacing_m: f64) -> Vec<CameraFrame> {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let width_m = spacing_m * CAMERAS as f64;
    let count = (TARGETS_PER_CAMERA as f64 * width_m / 60.0) as usize;
    let mut walkers: Vec<([f64; 2], [f64; 2])> = (0..count)
        .map(|_| {
            let at = [width_m * random.random::<f64>(), 40.0 * random.random::<f64>()];
            (at, [random.random_range(-1.5..1.5), random.random_range(-0.5..0.5)])
        })
        .collect();
    let start = Timestamp::from_second(1_767_600_000).expect("within range");
    let mut frames = Vec::new();
    for step in 0..FRAMES_PER_S * DURATION_S {
        let interval_s = 1.0 / FRAMES_PER_S as f64;
        let time = start + SignedDuration::from_secs_f64(step as f64 * interval_s);
        for (at, velocity) in &mut walkers {
            *at = [(at[0] + interval_s * velocity[0]).rem_euclid(width_m), at[1] + interval_s * velocity[1]];
        }
        for camera in 0..CAMERAS {
            let west_m = spacing_m * camera as f64;
            let seen = |(at, _): &([f64; 2], [f64; 2])| (at[0] - west_m).rem_euclid(width_m) < 60.0;
            let detections = walkers
                .iter()
                .enumerate()
                .filter(|(_, walker)| seen(walker))
                .map(|(number, (at, _))| WorldDetection {
                    tracker_id: TargetId::new(&format!("{number}")).ok(),
                    receiver: None,
                    position: EastNorth {
                        east_m: at[0] + 0.15 * random.sample::<f64, _>(StandardNormal),
                        north_m: at[1] + 0.15 * random.sample::<f64, _>(StandardNormal),
                    },
                    covariance_m2: PlaneCovariance::isotropic(0.04),
                    offset_covariance_m2: PlaneCovariance::isotropic(0.02),
                    common_covariance_m2: PlaneCovariance::isotropic(0.3),
                })
                .collect();
            let camera = CameraId::new(&format!("c{camera}")).expect("a slug");
            frames.push(CameraFrame { camera, time, detections });
        }
    }
    frames
}
