//! Error and coverage over many simulated worlds where little or something wrong is known: the first minutes of a camera,
//! hidden feet, boxes that are wrong. Each test prints the figures of docs/explanation/method.md and holds the marks.
//!
//! `cargo test -p sightfix-evaluation --test marks -- --ignored --nocapture`

use std::collections::BTreeMap;
use std::ops::{ControlFlow, Range};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use sightfix_domain::domain::{
    BoundingBox, Fix, Flag, GnssError, ImageSize, Motion, Observation, Recipe, SigmaM, TargetId,
};
use sightfix_domain::geo::{EastNorth, LocalPlane, Position, distance_m};
use sightfix_fusion::target_track::TargetTrack;
use sightfix_fusion::track::TrackSettings;
use sightfix_fusion::two_step::fuse_observed;
use sightfix_model::{FitOptions, R95_PER_SIGMA, Regressor, fit};
use sightfix_simulation::{Options, Route, Scene, SimulatedRow, TargetShape, World, simulate_split};

/// Worlds on which nothing was chosen.
const WORLDS: Range<u64> = 201..209;

/// Errors with their stated radii.
#[derive(Default)]
struct Errors(Vec<(f64, f64)>);

impl Errors {
    fn add(&mut self, position: Position, row: &SimulatedRow, r95_m: f64) {
        self.0.push((distance_m(position, row.truth), r95_m));
    }

    fn mean_m(&self) -> f64 {
        self.0.iter().map(|(error_m, _)| error_m).sum::<f64>() / self.0.len() as f64
    }

    fn inside(&self) -> f64 {
        self.0.iter().filter(|(error_m, r95_m)| error_m <= r95_m).count() as f64 / self.0.len() as f64
    }

    fn text(&self) -> String {
        let radius_m = self.0.iter().map(|(_, r95_m)| r95_m).sum::<f64>() / self.0.len() as f64;
        format!("{:.2} m, {:.3} inside {radius_m:.1} m", self.mean_m(), self.inside())
    }
}

/// Two-step fusion and the tracks of all targets of a camera.
struct Camera {
    model: Regressor,
    image_size: ImageSize,
    tracks: BTreeMap<TargetId, TargetTrack>,
    fused: Errors,
    tracked: Errors,
    flagged: usize,
}

impl Camera {
    /// `sigma_m` is what the profile states of the receivers.
    fn trained(world: &World, sigma_m: Option<f64>) -> Self {
        let sigma = sigma_m.map(|sigma_m| SigmaM::new(sigma_m).expect("valid"));
        let options = FitOptions {
            recipe: Recipe::GaussianProcess,
            seed: 1,
            epochs: None,
            image_size: Some(world.image_size),
            gnss_error: sigma.map_or(GnssError::Unknown, GnssError::Known),
            gnss_bias_sigma_m: None,
        };
        let fitted = fit(&world.training_samples(), &options, &mut |_| ControlFlow::Continue(()));
        Self {
            model: fitted.expect("fits").load().expect("a model"),
            image_size: world.image_size,
            tracks: BTreeMap::new(),
            fused: Errors::default(),
            tracked: Errors::default(),
            flagged: 0,
        }
    }

    fn forget(&mut self) {
        self.tracks.clear();
        self.fused = Errors::default();
        self.tracked = Errors::default();
        self.flagged = 0;
    }

    /// Answers a row with that box; counts the answer where it `counts`.
    fn observe(&mut self, row: &SimulatedRow, bounding_box: BoundingBox, fix: Option<Fix>, counts: bool) {
        let target_id = row.target_id.clone();
        let observation =
            Observation::new(row.time, Some(target_id.clone()), Some(bounding_box), fix).expect("a box");
        let track = self.tracks.entry(target_id).or_default();
        let observed = track.observe(&observation, Some(&self.model), Some(self.image_size), None);
        let model = Some((&self.model, 1));
        let fused = fuse_observed(&observation, &observed, model, Some(self.image_size)).expect("a model");
        let tracked = track.update(&observed, || TrackSettings::from_model(&self.model));
        if counts {
            self.fused.add(fused.fused, row, fused.r95_m);
            self.flagged += usize::from(fused.flags.contains(&Flag::FootHidden));
            if let Some(tracked) = tracked {
                self.tracked.add(tracked.position, row, tracked.state.r95_m);
            }
        }
    }
}

/// Rows with a box and a fix.
fn complete(world: &World) -> impl Iterator<Item = (&SimulatedRow, BoundingBox, Fix)> {
    world.rows.iter().filter_map(|row| Some((row, row.bounding_box?, row.fix?)))
}

#[test]
#[ignore = "takes minutes"]
fn the_first_minutes_of_one_phone() {
    for samples in [20, 40, 80] {
        let (mut gnss, mut fused, mut tracked, mut sigmas_m) =
            (Errors::default(), Errors::default(), Errors::default(), Vec::new());
        for seed in WORLDS.start..WORLDS.start + 16 {
            let options = Options { seed, camera_seed: seed, samples, ..Options::new(Scene::Square) };
            let (training, test) = simulate_split(&options, 400);
            let mut camera = Camera::trained(&training, None);
            let sigma_m = camera.model.e_gnss_m2().sqrt();
            sigmas_m.push(sigma_m);
            for (row, bounding_box, fix) in complete(&test) {
                gnss.add(fix.position, row, R95_PER_SIGMA * sigma_m);
                camera.observe(row, bounding_box, Some(fix), true);
            }
            fused.0.append(&mut camera.fused.0);
            tracked.0.append(&mut camera.tracked.0);
        }
        sigmas_m.sort_by(f64::total_cmp);
        println!(
            "{samples} rows: GNSS {}; two-step {}; track {}; sigma {:.2} to {:.2} m, median {:.2}",
            gnss.text(),
            fused.text(),
            tracked.text(),
            sigmas_m[0],
            sigmas_m[15],
            sigmas_m[8]
        );
        assert!(fused.inside() >= 0.9 && fused.mean_m() <= gnss.mean_m());
    }
}

#[test]
#[ignore = "takes minutes"]
fn people_whose_feet_are_hidden() {
    let mut shares: BTreeMap<&str, (Errors, Errors, usize)> = BTreeMap::new();
    for seed in WORLDS {
        let options =
            Options { seed, camera_seed: seed, samples: 1_200, targets: 8, ..Options::new(Scene::Square) };
        let (training, test) = simulate_split(&options, 800);
        let mut camera = Camera::trained(&training, None);
        for (name, often, hidden) in [
            ("none hidden", 0.0, 0.0..0.1),
            ("20 % hidden", 1.0, 0.2..0.201),
            ("40 % hidden", 1.0, 0.4..0.401),
            ("60 % hidden", 1.0, 0.6..0.601),
            ("in a tenth of the rows 20 to 60 % hidden", 0.1, 0.2..0.6),
        ] {
            camera.forget();
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            for (row, bounding_box, fix) in complete(&test) {
                let is_hidden = random.random_range(0.0..1.0) < often;
                let share = if is_hidden { random.random_range(hidden.clone()) } else { 0.0 };
                let [left_px, top_px, width_px, height_px] = bounding_box.sides_px();
                let seen = BoundingBox::new(left_px, top_px, width_px, (1.0 - share) * height_px);
                camera.observe(row, seen.expect("a box"), Some(fix), true);
            }
            let (fused, tracked, flagged) = shares.entry(name).or_default();
            fused.0.append(&mut camera.fused.0);
            tracked.0.append(&mut camera.tracked.0);
            *flagged += camera.flagged;
        }
    }
    for (name, (fused, tracked, flagged)) in &shares {
        let flagged = *flagged as f64 / fused.0.len() as f64;
        println!("{name}: two-step {}; track {}; flagged {flagged:.3}", fused.text(), tracked.text());
    }
    let (whole, some) = (&shares["none hidden"], &shares["in a tenth of the rows 20 to 60 % hidden"]);
    assert!(some.0.mean_m() <= 1.3 * whole.0.mean_m() && some.0.inside() >= 0.88);
    assert!(some.1.mean_m() <= 1.3 * whole.1.mean_m() && some.1.inside() >= 0.88);
    let fifth = &shares["20 % hidden"];
    assert!(fifth.0.inside() >= 0.85 && fifth.1.inside() >= 0.75);
}

/// A large aircraft 12 m beside the lines of training.
#[test]
#[ignore = "takes minutes"]
fn a_line_that_was_never_walked() {
    let (mut fused, mut tracked, mut gnss) = (Errors::default(), Errors::default(), Errors::default());
    for seed in WORLDS {
        let options = Options {
            seed,
            camera_seed: seed,
            samples: 4_000,
            gnss_sigma_m: 8.0,
            target_shape: Some(TargetShape {
                length_m: 37.0,
                width_m: 34.0,
                height_m: 12.0,
                antenna_ahead_m: 14.0,
                antenna_left_m: 0.0,
            }),
            ..Options::new(Scene::Airport)
        };
        let (training, _) = simulate_split(&options, 1);
        let test = Options { route: Route::NewLine, new_line_offset_m: Some(12.0), ..options.clone() };
        let (_, test) = simulate_split(&test, 600);
        let mut camera = Camera::trained(&training, Some(8.0));
        for (row, bounding_box, fix) in complete(&test) {
            gnss.add(fix.position, row, 8.0 * R95_PER_SIGMA);
            camera.observe(row, bounding_box, Some(fix), true);
        }
        println!("{seed}: two-step {}; track {}", camera.fused.text(), camera.tracked.text());
        fused.0.append(&mut camera.fused.0);
        tracked.0.append(&mut camera.tracked.0);
    }
    println!("GNSS {}; two-step {}; track {}", gnss.text(), fused.text(), tracked.text());
    assert!(fused.mean_m() <= 0.5 * gnss.mean_m() && tracked.mean_m() <= fused.mean_m());
    assert!(fused.inside() >= 0.8 && tracked.inside() >= 0.75);
}

/// A box of any size anywhere in the image.
fn false_box(random: &mut ChaCha8Rng, size: ImageSize) -> BoundingBox {
    let (image_px, most_px) = ([size.width_px(), size.height_px()].map(f64::from), [0.4, 0.5]);
    let [width_px, height_px] = [0, 1].map(|side| random.random_range(10.0..most_px[side] * image_px[side]));
    let left_px = random.random_range(0.0..image_px[0] - width_px);
    let top_px = random.random_range(0.0..image_px[1] - height_px);
    BoundingBox::new(left_px, top_px, width_px, height_px).expect("a box")
}

/// A fix a kilometre off in any direction.
fn gross(fix: Fix, row: &SimulatedRow, random: &mut ChaCha8Rng) -> Fix {
    let (sin, cos) = random.random_range(0.0..std::f64::consts::TAU).sin_cos();
    let moved = EastNorth { east_m: 1_000.0 * cos, north_m: 1_000.0 * sin };
    Fix { position: LocalPlane::new(row.truth).to_position(moved), ..fix }
}

#[test]
#[ignore = "takes minutes"]
fn boxes_that_are_wrong() {
    for scene in [Scene::Square, Scene::Airport] {
        let mut cases: BTreeMap<&str, (Errors, Errors)> = BTreeMap::new();
        for seed in WORLDS {
            let options = Options { seed, camera_seed: seed, samples: 1_500, ..Options::new(scene) };
            let (training, test) = simulate_split(&options, 600);
            let mut camera = Camera::trained(&training, Some(options.gnss_sigma_m));
            for case in [
                "none",
                "no box",
                "frozen",
                "25 % false",
                "all false",
                "all false, gross fixes",
                "all false, no fix",
            ] {
                camera.forget();
                let mut random = ChaCha8Rng::seed_from_u64(seed);
                let (mut begin, mut frozen) = (None, None);
                for (row, seen, fix) in complete(&test) {
                    let begun = *begin.get_or_insert(row.time);
                    let elapsed_s = row.time.duration_since(begun).as_secs_f64();
                    let bounding_box = match case {
                        "none" => seen,
                        // Each 30 s of good boxes are followed by 100 s of one and the same.
                        "frozen" if elapsed_s < 30.0 => seen,
                        "frozen" => *frozen.get_or_insert(seen),
                        "25 % false" if random.random_range(0.0..1.0) >= 0.25 => seen,
                        _ => false_box(&mut random, test.image_size),
                    };
                    let fix = match case {
                        "all false, no fix" => None,
                        "all false, gross fixes" => Some(gross(fix, row, &mut random)),
                        _ => Some(fix),
                    };
                    camera.observe(row, bounding_box, fix, case != "frozen" || frozen.is_some());
                    if elapsed_s >= 130.0 {
                        (begin, frozen) = (None, None);
                    }
                }
                let (fused, tracked) = cases.entry(case).or_default();
                fused.0.append(&mut camera.fused.0);
                tracked.0.append(&mut camera.tracked.0);
            }
        }
        for (case, (fused, tracked)) in &cases {
            println!("{scene:?}, {case}: two-step {}; track {}", fused.text(), tracked.text());
        }
        for (case, (fused, tracked)) in &cases {
            // The boxes of a vehicle count until the picture is known to be frozen.
            let mark = if *case == "frozen" { 0.85 } else { 0.88 };
            assert!(fused.inside() >= mark && tracked.inside() >= mark, "{scene:?}, {case}");
        }
    }
}

/// Speeds with their stated intervals, beside differences of two-step positions.
#[derive(Default)]
struct Speeds {
    /// Relative errors.
    tracked: Vec<f64>,
    differences: Vec<f64>,
    /// Half of the intervals' widths, relative to the true speeds.
    half_widths: Vec<f64>,
    speeds_inside: usize,
    courses_inside: usize,
    courses: usize,
    positions: Errors,
}

impl Speeds {
    fn add(&mut self, motion: Motion, difference_m_s: f64, true_speed_m_s: f64, true_course_deg: f64) {
        let [low_mps, high_mps] = motion.speed_interval_mps;
        let of_truth = |speed_m_s: f64| (speed_m_s - true_speed_m_s).abs() / true_speed_m_s;
        self.tracked.push(of_truth(motion.speed_mps));
        self.differences.push(of_truth(difference_m_s));
        self.half_widths.push(0.5 * (high_mps - low_mps) / true_speed_m_s);
        self.speeds_inside += usize::from((low_mps..=high_mps).contains(&true_speed_m_s));
        if let Some(course) = motion.course {
            let [from_deg, to_deg] = course.interval_deg;
            let after = |deg: f64| (deg - from_deg).rem_euclid(360.0);
            self.courses += 1;
            self.courses_inside += usize::from(after(true_course_deg) <= after(to_deg));
        }
    }

    fn coverage(&self) -> f64 {
        self.speeds_inside as f64 / self.tracked.len() as f64
    }

    fn text(&mut self) -> String {
        let (coverage, courses) = (self.coverage(), self.courses_inside as f64 / self.courses as f64);
        let [tracked, differences, half_width] =
            [&mut self.tracked, &mut self.differences, &mut self.half_widths].map(|values| median(values));
        format!(
            "{:.1} %, differences {:.1} %; +- {:.1} %, {coverage:.3} inside; course {courses:.3} inside; position {}",
            100.0 * tracked,
            100.0 * differences,
            100.0 * half_width,
            self.positions.text(),
        )
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The true speed, m/s, and course, degrees, at the middle of three rows, each a second after the one before.
fn true_motion(rows: [&SimulatedRow; 3]) -> Option<(f64, f64)> {
    let [before, _, after] = rows;
    let seconds = after.time.duration_since(before.time).as_secs_f64();
    let moved = LocalPlane::new(before.truth).to_plane(after.truth);
    let speed_m_s = moved.east_m.hypot(moved.north_m) / seconds;
    (seconds <= 2.0 && speed_m_s > 0.1).then(|| (speed_m_s, moved.east_m.atan2(moved.north_m).to_degrees()))
}

/// Adds the speeds of a world's rows after its target was tracked over a distance.
fn add_speeds(world: &World, camera: &Camera, after_m: f64, speeds: &mut Speeds) {
    let mut track = TargetTrack::default();
    let (mut tracked_m, mut previous): (f64, Option<Position>) = (0.0, None);
    let rows: Vec<_> = complete(world).collect();
    for three in rows.windows(3) {
        let [(before, ..), (row, bounding_box, fix), (after, ..)] = three else { continue };
        let observation = Observation::new(row.time, None, Some(*bounding_box), Some(*fix)).expect("a box");
        let observed = track.observe(&observation, Some(&camera.model), Some(camera.image_size), None);
        let model = Some((&camera.model, 1));
        let fused = fuse_observed(&observation, &observed, model, Some(camera.image_size)).expect("a model");
        let state = track.update(&observed, || TrackSettings::from_model(&camera.model));
        let step_s = row.time.duration_since(before.time).as_secs_f64();
        let last = previous.replace(fused.fused).filter(|_| step_s <= 1.0);
        tracked_m = if last.is_some() { tracked_m + distance_m(before.truth, row.truth) } else { 0.0 };
        if let (Some(last), Some(state), Some((speed_m_s, course_deg))) =
            (last, state, true_motion([before, row, after]))
            && tracked_m >= after_m
        {
            speeds.positions.add(state.position, row, state.state.r95_m);
            speeds.add(state.state.motion(), distance_m(last, fused.fused) / step_s, speed_m_s, course_deg);
        }
    }
}

#[test]
#[ignore = "takes minutes"]
fn speeds_of_walkers_and_vehicles() {
    for (scene, after_m, speeds_m_s) in
        [(Scene::Square, 5.0, &[1.0, 1.5, 2.0][..]), (Scene::Airport, 30.0, &[5.0, 10.0, 20.0, 40.0])]
    {
        let motions = speeds_m_s.iter().flat_map(|speed_m_s| [0.01, 0.05].map(|unrest| (*speed_m_s, unrest)));
        let mut cases: Vec<_> = motions.map(|motion| (motion, Speeds::default())).collect();
        for seed in WORLDS {
            let area = Options { route: Route::Area, ..Options::new(scene) };
            let options = Options { seed, camera_seed: seed, samples: 1_500, ..area };
            let (training, _) = simulate_split(&options, 1);
            let camera = Camera::trained(&training, Some(options.gnss_sigma_m));
            for ((speed_m_s, speed_unrest), speeds) in &mut cases {
                let moving = Options {
                    mean_speed_m_s: Some(*speed_m_s),
                    speed_unrest: *speed_unrest,
                    ..options.clone()
                };
                let (_, test) = simulate_split(&moving, 600);
                add_speeds(&test, &camera, after_m, speeds);
            }
        }
        for ((speed_m_s, unrest), speeds) in &mut cases {
            println!("{scene:?}, {speed_m_s} m/s +- {:.0} %: {}", 100.0 * *unrest, speeds.text());
            assert!(speeds.coverage() >= 0.85, "{scene:?}, {speed_m_s} m/s");
            assert!(scene == Scene::Square || median(&mut speeds.tracked) <= 0.05, "{speed_m_s} m/s");
        }
    }
}
