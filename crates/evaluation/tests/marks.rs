//! Error and coverage over many simulated worlds where little or something wrong is known: the first minutes of a camera,
//! hidden feet, boxes that are wrong, airports of other forms. Each test prints the figures of docs/explanation/marks.md
//! and docs/explanation/method.md and holds the marks.
//!
//! `cargo test -p sightfix-evaluation --test marks -- --ignored --nocapture`

use std::collections::BTreeMap;
use std::ops::{ControlFlow, Range};

use jiff::{SignedDuration, Timestamp};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use sightfix_domain::domain::{
    BoundingBox, Fix, Flag, GnssError, ImageSize, Method, Motion, Observation, Recipe, SigmaM, TargetId,
    Truth,
};
use sightfix_domain::geo::{EastNorth, LocalPlane, Position, distance_m};
use sightfix_evaluation::{ErrorMetrics, EvaluateOptions, TestRow, evaluate};
use sightfix_fusion::smoother::{FilteredState, PathState, TrackPath};
use sightfix_fusion::target_track::{TargetTrack, TrackEstimate};
use sightfix_fusion::track::TrackSettings;
use sightfix_fusion::two_step::fuse_observed;
use sightfix_model::{FitOptions, R95_PER_SIGMA, Regressor, fit};
use sightfix_simulation::{
    AirportForm, Options, Route, Scene, SimulatedRow, TargetShape, World, simulate_split,
};

/// Worlds on which nothing was chosen.
const WORLDS: Range<u64> = 201..209;

/// Errors with their stated radii, m, of one world or of several.
#[derive(Default)]
struct Errors {
    rows: Vec<(f64, f64)>,
    /// Mean error, m, and share inside the radius, of each world.
    worlds: Vec<[f64; 2]>,
}

impl Errors {
    fn add(&mut self, position: Position, row: &SimulatedRow, r95_m: f64) {
        self.rows.push((distance_m(position, row.truth), r95_m));
    }

    /// Adds the rows of one more world.
    fn add_world(&mut self, world: &Self) {
        self.rows.extend(&world.rows);
        self.worlds.push([world.mean_m(), world.inside()]);
    }

    fn mean_m(&self) -> f64 {
        self.rows.iter().map(|(error_m, _)| error_m).sum::<f64>() / self.rows.len() as f64
    }

    fn inside(&self) -> f64 {
        self.rows.iter().filter(|(error_m, r95_m)| error_m <= r95_m).count() as f64 / self.rows.len() as f64
    }

    /// Mean error, share inside the radius, and mean radius; the former two with their ranges over worlds.
    fn text(&self) -> String {
        let radius_m = self.rows.iter().map(|(_, r95_m)| r95_m).sum::<f64>() / self.rows.len() as f64;
        let range = |figure: usize, digits: usize| {
            let least = self.worlds.iter().map(|world| world[figure]).fold(f64::INFINITY, f64::min);
            let most = self.worlds.iter().map(|world| world[figure]).fold(f64::NEG_INFINITY, f64::max);
            if least > most { String::new() } else { format!(" ({least:.digits$} to {most:.digits$})") }
        };
        let (mean_m, inside) = (self.mean_m(), self.inside());
        format!("{mean_m:.2} m{}, {inside:.3}{} inside {radius_m:.1} m", range(0, 2), range(1, 2))
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
            fused.add_world(&camera.fused);
            tracked.add_world(&camera.tracked);
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
        assert!(fused.inside() >= 0.9 && tracked.inside() >= 0.9 && fused.mean_m() <= gnss.mean_m());
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
            fused.add_world(&camera.fused);
            tracked.add_world(&camera.tracked);
            *flagged += camera.flagged;
        }
    }
    for (name, (fused, tracked, flagged)) in &shares {
        let flagged = *flagged as f64 / fused.rows.len() as f64;
        println!("{name}: two-step {}; track {}; flagged {flagged:.3}", fused.text(), tracked.text());
    }
    let (whole, some) = (&shares["none hidden"], &shares["in a tenth of the rows 20 to 60 % hidden"]);
    assert!(some.0.mean_m() <= 1.3 * whole.0.mean_m() && some.0.inside() >= 0.88);
    assert!(some.1.mean_m() <= 1.3 * whole.1.mean_m() && some.1.inside() >= 0.88);
    let fifth = &shares["20 % hidden"];
    assert!(fifth.0.inside() >= 0.85 && fifth.1.inside() >= 0.85);
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
        fused.add_world(&camera.fused);
        tracked.add_world(&camera.tracked);
    }
    println!("GNSS {}; two-step {}; track {}", gnss.text(), fused.text(), tracked.text());
    assert!(fused.mean_m() <= 0.5 * gnss.mean_m() && tracked.mean_m() <= fused.mean_m());
    assert!(fused.inside() >= 0.8 && tracked.inside() >= 0.85);
}

/// A tug with a trailer, whose antenna is on the tug's roof.
const TRAILER: TargetShape =
    TargetShape { length_m: 20.0, width_m: 3.0, height_m: 4.0, antenna_ahead_m: 8.0, antenna_left_m: 0.0 };
/// What two-step fusion is compared with; then two-step fusion and tracks, of the default recipe.
const BASELINES: [&str; 4] = ["gnss", "imm_ukf", "homography.denied", "dnn.denied"];
const TWO_STEP: &str = "auto.two_step";
const TRACK: &str = "track";

/// The figures of each method in one world, on rows with box and fix.
fn figures(options: &Options) -> BTreeMap<String, ErrorMetrics> {
    let (training, test) = simulate_split(options, 400);
    let rows = complete(&test).map(|(row, bounding_box, fix)| {
        let target_id = Some(row.target_id.clone());
        let observation = Observation::new(row.time, target_id, Some(bounding_box), Some(fix));
        TestRow { observation: observation.expect("a box"), truth: Some(row.truth) }
    });
    let methods = [&BASELINES[..], &[TWO_STEP, TRACK]].concat().join(",");
    let evaluated = EvaluateOptions {
        methods: Method::list(&methods).expect("names of methods"),
        default_recipe: Recipe::Auto,
        seeds: 1,
        epochs: None,
        image_size: Some(test.image_size),
        gnss_sigma: Some(SigmaM::new(options.gnss_sigma_m).expect("valid")),
        gnss_bias_sigma: None,
        box_shift_px: 0.0,
        cpu_s: || 0.0,
    };
    let rows: Vec<_> = rows.collect();
    let samples = training.training_samples();
    let evaluation =
        evaluate(&samples[..], &rows, &Truth::Columns, &evaluated, &mut |_| ControlFlow::Continue(()));
    let methods = evaluation.expect("valid options").report.methods;
    methods.into_iter().map(|(name, report)| (name, report.metrics)).collect()
}

/// Mean of a figure of a method over worlds, with its range.
fn over_worlds(
    worlds: &[BTreeMap<String, ErrorMetrics>],
    method: &str,
    figure: impl Fn(&ErrorMetrics) -> Option<f64>,
) -> [f64; 3] {
    let of_worlds: Vec<f64> = worlds.iter().filter_map(|world| figure(world.get(method)?)).collect();
    let mean = of_worlds.iter().sum::<f64>() / of_worlds.len() as f64;
    let least = of_worlds.iter().copied().fold(f64::INFINITY, f64::min);
    let most = of_worlds.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    [mean, least, most]
}

#[test]
#[ignore = "takes minutes"]
fn airports_of_other_forms() {
    println!(
        "| airport | GNSS | IMM-UKF | homography | DNN | two-step | ratio | inside 50 % | inside 95 % | r95 | NLL | \
         track | inside 95 % | misses |"
    );
    println!("|{}", "---|".repeat(14));
    let forms = AirportForm::ALL.iter().map(|form| (form.to_string(), *form, None));
    let cases: Vec<_> =
        forms.chain([("plain, a trailer".to_owned(), AirportForm::Plain, Some(TRAILER))]).collect();
    for (receiver, gnss_sigma_m, gnss_time_constant_s) in
        [("white, 29.5 m", 29.5, None), ("coloured, 6 m", 6.0, Some(45.0))]
    {
        for (name, airport_form, target_shape) in &cases {
            let base = Options {
                airport_form: *airport_form,
                target_shape: *target_shape,
                gnss_sigma_m,
                gnss_time_constant_s,
                samples: 4_000,
                ..Options::new(Scene::Airport)
            };
            let of_seed = |seed| figures(&Options { seed, camera_seed: seed, ..base.clone() });
            let worlds: Vec<_> = WORLDS.map(of_seed).collect();
            let mean_m = |method| over_worlds(&worlds, method, |own| Some(own.mean_m));
            let inside = |method| over_worlds(&worlds, method, |own| own.coverage95);
            let best_m = BASELINES.map(|method| mean_m(method)[0]).into_iter().fold(f64::INFINITY, f64::min);
            let ratio = mean_m(TWO_STEP)[0] / best_m;
            let [half, ..] = over_worlds(&worlds, TWO_STEP, |own| own.coverage50);
            let marks = [
                ("ratio", ratio <= 1.05),
                ("inside 50 %", (0.40..=0.75).contains(&half)),
                ("two-step inside 95 %", (0.90..=0.99).contains(&inside(TWO_STEP)[0])),
                ("track inside 95 %", (0.90..=0.99).contains(&inside(TRACK)[0])),
            ];
            let misses: Vec<&str> =
                marks.iter().filter(|(_, is_met)| !is_met).map(|(mark, _)| *mark).collect();
            let range = |[mean, least, most]: [f64; 3]| format!("{mean:.2} ({least:.2} to {most:.2})");
            let baselines = BASELINES.map(|method| format!("{:.2}", mean_m(method)[0])).join(" | ");
            println!(
                "| {name}, {receiver} | {baselines} | {} | {ratio:.2} | {half:.2} | {} | {:.1} | {:.2} | {} | {} | {} |",
                range(mean_m(TWO_STEP)),
                range(inside(TWO_STEP)),
                over_worlds(&worlds, TWO_STEP, |own| own.mean_r95_m)[0],
                over_worlds(&worlds, TWO_STEP, |own| own.negative_log_likelihood)[0],
                range(mean_m(TRACK)),
                range(inside(TRACK)),
                misses.join(", "),
            );
            assert!(worlds.len() == 8 && ratio <= 1.25 && inside(TWO_STEP)[0] >= 0.85, "{name}, {receiver}");
        }
    }
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
                fused.add_world(&camera.fused);
                tracked.add_world(&camera.tracked);
            }
        }
        for (case, (fused, tracked)) in &cases {
            println!("{scene:?}, {case}: two-step {}; track {}", fused.text(), tracked.text());
        }
        for (case, (fused, tracked)) in &cases {
            assert!(fused.inside() >= 0.88 && tracked.inside() >= 0.88, "{scene:?}, {case}");
        }
    }
}

/// A target of that speed or less stands, m/s.
const STANDING_M_S: f64 = 0.1;

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
    /// Seconds in which the target stood, and those whose interval holds 0.
    standing: usize,
    standing_inside: usize,
    positions: Errors,
}

impl Speeds {
    fn add(&mut self, motion: Motion, difference_m_s: f64, true_speed_m_s: f64, true_course_deg: f64) {
        let [low_mps, high_mps] = motion.speed_interval_mps;
        if true_speed_m_s <= STANDING_M_S {
            self.standing += 1;
            self.standing_inside += usize::from(low_mps <= true_speed_m_s);
            return;
        }
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
            "{:.1} %, differences {:.1} %; +- {:.1} %, {coverage:.3} inside; course {courses:.3} inside; {} of {} standing; \
             position {}",
            100.0 * tracked,
            100.0 * differences,
            100.0 * half_width,
            self.standing_inside,
            self.standing,
            self.positions.text(),
        )
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The true speed, m/s, and course, degrees, over the second before a row. A target of the square stops and sets out
/// between two rows, so a mean that reaches beyond the row would be of a speed that it never has.
fn true_motion(before: &SimulatedRow, row: &SimulatedRow) -> Option<(f64, f64)> {
    let seconds = row.time.duration_since(before.time).as_secs_f64();
    let moved = LocalPlane::new(before.truth).to_plane(row.truth);
    let speed_m_s = moved.east_m.hypot(moved.north_m) / seconds;
    (seconds <= 1.0).then(|| (speed_m_s, moved.east_m.atan2(moved.north_m).to_degrees()))
}

/// The path of a track, and the rows of which its smoothed states are compared with the truth.
struct Path<'a> {
    plane: LocalPlane,
    states: Vec<FilteredState>,
    /// Row, two-step difference, true speed and true course, by the time of the state.
    compared: BTreeMap<Timestamp, (&'a SimulatedRow, f64, f64, f64)>,
}

impl Path<'_> {
    fn new(plane: LocalPlane) -> Self {
        Self { plane, states: Vec::new(), compared: BTreeMap::new() }
    }

    fn push(&mut self, estimate: &TrackEstimate) {
        let state = &estimate.state;
        self.states.push(FilteredState {
            time: state.time,
            position: self.plane.to_plane(estimate.position),
            velocity: state.velocity,
            covariance: state.normal_covariance(),
            velocity_covariance: state.velocity_covariance,
            stationary_probability: state.stationary_probability,
            moments: state.moments,
        });
    }

    /// Compares what was smoothed with the truth, for the track has ended.
    fn end(&self, smoothed: &mut [Smoothed]) {
        for Smoothed { lag, speeds } in smoothed {
            self.compare(lag.map_or_else(|| smoothed_path(&self.states), |lag| self.with_lag(lag)), speeds);
        }
    }

    /// Every state smoothed with those of some time after it.
    fn with_lag(&self, lag: SignedDuration) -> Vec<PathState> {
        let with_later = |at: usize| {
            let states = &self.states[at..];
            let later = states.partition_point(|it| it.time.duration_since(states[0].time) <= lag);
            smoothed_path(&states[..later]).first().copied()
        };
        (0..self.states.len()).filter_map(with_later).collect()
    }

    fn compare(&self, states: Vec<PathState>, smoothed: &mut Speeds) {
        for state in states {
            let Some((row, difference_m_s, speed_m_s, course_deg)) = self.compared.get(&state.time) else {
                continue;
            };
            smoothed.positions.add(self.plane.to_position(state.position), row, state.covariance.r95_m());
            smoothed.add(state.motion(), *difference_m_s, *speed_m_s, *course_deg);
        }
    }
}

fn smoothed_path(states: &[FilteredState]) -> Vec<PathState> {
    let mut path = TrackPath::new(1 << 24);
    states.iter().for_each(|state| path.push(state.clone()));
    path.smoothed()
}

/// The figures of states that are smoothed with what was measured until a lag later, or by the end of the track.
#[derive(Default)]
struct Smoothed {
    lag: Option<SignedDuration>,
    speeds: Speeds,
}

/// Adds the speeds of a world's rows after its target was tracked over a distance, of the filter and smoothed.
fn add_speeds(world: &World, camera: &Camera, after_m: f64, speeds: &mut Speeds, smoothed: &mut [Smoothed]) {
    let mut track = TargetTrack::default();
    let mut path: Option<Path<'_>> = None;
    let (mut tracked_m, mut previous): (f64, Option<Position>) = (0.0, None);
    let rows: Vec<_> = complete(world).collect();
    for pair in rows.windows(2) {
        let [(before, ..), (row, bounding_box, fix)] = pair else {
            continue;
        };
        let observation = Observation::new(row.time, None, Some(*bounding_box), Some(*fix)).expect("a box");
        let observed = track.observe(&observation, Some(&camera.model), Some(camera.image_size), None);
        let model = Some((&camera.model, 1));
        let fused = fuse_observed(&observation, &observed, model, Some(camera.image_size)).expect("a model");
        let state = track.update(&observed, || TrackSettings::from_model(&camera.model));
        let step_s = row.time.duration_since(before.time).as_secs_f64();
        let last = previous.replace(fused.fused).filter(|_| step_s <= 1.0);
        if let Some(estimate) = &state {
            if last.is_none() || estimate.state.restarted {
                path.take().into_iter().for_each(|ended| ended.end(smoothed));
            }
            path.get_or_insert_with(|| Path::new(LocalPlane::new(estimate.position))).push(estimate);
        }
        tracked_m = if last.is_some() { tracked_m + distance_m(before.truth, row.truth) } else { 0.0 };
        if let (Some(last), Some(state), Some((speed_m_s, course_deg))) =
            (last, state, true_motion(before, row))
            && tracked_m >= after_m
        {
            let difference_m_s = distance_m(last, fused.fused) / step_s;
            speeds.positions.add(state.position, row, state.state.r95_m);
            speeds.add(state.state.motion(), difference_m_s, speed_m_s, course_deg);
            let compared = (*row, difference_m_s, speed_m_s, course_deg);
            path.iter_mut().for_each(|path| _ = path.compared.insert(state.state.time, compared));
        }
    }
    path.into_iter().for_each(|ended| ended.end(smoothed));
}

#[test]
#[ignore = "takes minutes"]
fn speeds_of_walkers_and_vehicles() {
    for (scene, after_m, speeds_m_s) in
        [(Scene::Square, 5.0, &[1.0, 1.5, 2.0][..]), (Scene::Airport, 30.0, &[5.0, 10.0, 20.0, 40.0])]
    {
        let motions = speeds_m_s.iter().flat_map(|speed_m_s| [0.01, 0.05].map(|unrest| (*speed_m_s, unrest)));
        let mut cases: Vec<_> =
            motions.map(|motion| (motion, Speeds::default(), Smoothed::default())).collect();
        for seed in WORLDS {
            let area = Options { route: Route::Area, ..Options::new(scene) };
            let options = Options { seed, camera_seed: seed, samples: 1_500, ..area };
            let (training, _) = simulate_split(&options, 1);
            let camera = Camera::trained(&training, Some(options.gnss_sigma_m));
            for ((speed_m_s, speed_unrest), filtered, smoothed) in &mut cases {
                let moving = Options {
                    mean_speed_m_s: Some(*speed_m_s),
                    speed_unrest: *speed_unrest,
                    ..options.clone()
                };
                let (_, test) = simulate_split(&moving, 600);
                add_speeds(&test, &camera, after_m, filtered, std::slice::from_mut(smoothed));
            }
        }
        for ((speed_m_s, unrest), filtered, Smoothed { speeds: smoothed, .. }) in &mut cases {
            for (name, speeds) in [("filtered", &mut *filtered), ("smoothed", &mut *smoothed)] {
                println!("{scene:?}, {speed_m_s} m/s +- {:.0} %, {name}: {}", 100.0 * *unrest, speeds.text());
            }
            assert!(10 * filtered.standing_inside >= 9 * filtered.standing, "{scene:?}, {speed_m_s} m/s");
            assert!(filtered.coverage() >= 0.90, "{scene:?}, {speed_m_s} m/s");
            assert!(smoothed.coverage() >= 0.90, "{scene:?}, {speed_m_s} m/s, smoothed");
            assert!(scene == Scene::Square || median(&mut filtered.tracked) <= 0.05, "{speed_m_s} m/s");
        }
    }
}

#[test]
#[ignore = "takes minutes"]
fn smoothing_with_a_lag() {
    let lags_s = [0, 1, 2, 5, 10, 20, 30];
    for (scene, after_m, speed_m_s) in [(Scene::Square, 5.0, 1.5), (Scene::Airport, 30.0, 10.0)] {
        let lags = lags_s.map(|lag_s| Some(SignedDuration::from_secs(lag_s)));
        let mut cases: Vec<Smoothed> =
            lags.into_iter().chain([None]).map(|lag| Smoothed { lag, ..Smoothed::default() }).collect();
        for seed in WORLDS {
            let area = Options { route: Route::Area, mean_speed_m_s: Some(speed_m_s), ..Options::new(scene) };
            let options = Options { seed, camera_seed: seed, samples: 1_500, speed_unrest: 0.05, ..area };
            let (training, test) = simulate_split(&options, 600);
            let camera = Camera::trained(&training, Some(options.gnss_sigma_m));
            add_speeds(&test, &camera, after_m, &mut Speeds::default(), &mut cases);
        }
        for Smoothed { lag, speeds } in &mut cases {
            let lag = lag.map_or("whole track".to_owned(), |lag| format!("lag {} s", lag.as_secs()));
            println!("{scene:?}, {speed_m_s} m/s, {lag}: {}", speeds.text());
        }
        let inside = |case: &Smoothed| case.speeds.positions.inside();
        assert!(cases.iter().all(|case| inside(case) >= 0.90 && case.speeds.coverage() >= 0.90), "{scene:?}");
        let error_m = |at: usize| cases[at].speeds.positions.mean_m();
        let (of_10_s, of_whole) = (error_m(lags_s.len() - 3), error_m(lags_s.len()));
        assert!(of_10_s <= 1.02 * of_whole, "{scene:?}: {of_10_s} m beside {of_whole} m");
    }
}
