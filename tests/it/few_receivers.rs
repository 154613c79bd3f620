//! Error of the recipe `gaussian_process` against the number of receivers, with and without boxes that have
//! no fix, and with known points: tables of docs/explanation/method.md. One walk is one receiver on one way through the picture.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use rand::SeedableRng as _;
use rand::seq::SliceRandom as _;
use rand_chacha::ChaCha8Rng;
use sightfix::domain::{
    BoundingBox, Detection, GaussMarkovNoise, GnssError, ImageSize, KnownPoint, NoiseCorrelation,
    ReceivedFix, Receivers, Recipe, Sample, SigmaM, TargetClass, TargetId, TimeBounds,
};
use sightfix::evaluation::baselines::homography;
use sightfix::evaluation::site::{nearest_to_corners, position_at};
use sightfix::exchange::{FixFormat, Format, RowRules, read_detections, read_received_fixes};
use sightfix::fusion::pairing::{PairingRule, PairingSettings, pair};
use sightfix::geo::{EastNorth, LocalPlane, Position, distance_m};
use sightfix::model::{FitInput, FitOptions, fit};
use sightfix::simulation::{Options, Scene, SimulatedReceiver, simulate_split, standard_normal};

const RECEIVERS: [usize; 5] = [2, 3, 5, 10, 20];

/// A camera whose targets partly carry receivers.
struct Recording {
    image_size: ImageSize,
    /// Boxes with their fixes, by the target that carries the receiver.
    samples: BTreeMap<TargetId, Vec<Sample>>,
    /// All boxes.
    boxes: Vec<Detection>,
    /// Boxes of targets without a receiver, and where they were.
    tests: Vec<(BoundingBox, Position)>,
}

/// What there is beside the samples of receivers.
#[derive(Debug, Clone, Copy)]
struct Beside {
    boxes: bool,
    known_points: usize,
}

/// Mean error, m, and share of the true positions within the stated 95 % radius.
#[derive(Default, Clone, Copy)]
struct Score {
    mean_m: f64,
    coverage: f64,
}

impl Recording {
    /// The samples of some receivers, chosen by the seed.
    fn samples_of(&self, receivers: usize, seed: u64) -> Vec<Sample> {
        let mut carriers: Vec<&TargetId> = self.samples.keys().collect();
        carriers.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        carriers.iter().take(receivers).flat_map(|carrier| self.samples[*carrier].clone()).collect()
    }

    /// Fits a model with the fixes of some receivers, chosen by the seed; `None` if they do not suffice.
    fn score(&self, recipe: Recipe, receivers: usize, seed: u64, beside: Beside) -> Option<Score> {
        let samples = self.samples_of(receivers, seed);
        let paired: BTreeSet<_> = samples.iter().map(|sample| (sample.time, &sample.target_id)).collect();
        let is_unpaired = |own: &&Detection| beside.boxes && !paired.contains(&(own.time, &own.target_id));
        let unpaired: Vec<Detection> = self.boxes.iter().filter(is_unpaired).cloned().collect();
        let options = FitOptions {
            recipe,
            seed: 1,
            epochs: None,
            image_size: Some(self.image_size),
            gnss_error: GnssError::Unknown,
            gnss_bias_sigma_m: None,
        };
        let input = FitInput {
            samples: &samples,
            unpaired: &unpaired,
            known_points: &self.known_points(beside.known_points, seed),
        };
        let fitted = fit(input, &options, &mut |_| ControlFlow::Continue(()))
            .inspect_err(|error| println!("{receivers} receivers, draw {seed}, {beside:?}: {error}"));
        let model = fitted.ok()?.load().expect("a model");
        Some(self.scored(|bounding_box| {
            let regression = model.regress(bounding_box, None);
            let r95_m = regression.r95_scale * regression.e_regression_m2.sqrt();
            Some((model.plane().to_position(regression.regressed), r95_m))
        }))
    }

    /// The robust homography of the feet of the same samples, where its answers are below its horizon; it states no radius.
    fn score_of_homography(&self, receivers: usize, seed: u64) -> Score {
        let samples = self.samples_of(receivers, seed);
        let plane = LocalPlane::new(samples[0].fix.position);
        let pairs: Vec<(BoundingBox, EastNorth)> =
            samples.iter().map(|sample| (sample.bounding_box, plane.to_plane(sample.fix.position))).collect();
        let map = homography::fit(&pairs, seed).expect("enough samples");
        self.scored(|bounding_box| Some((plane.to_position(map.project(bounding_box)?), f64::NAN)))
    }

    fn scored(&self, answer: impl Fn(&BoundingBox) -> Option<(Position, f64)>) -> Score {
        let of_box = |(bounding_box, truth): &(BoundingBox, Position)| {
            let (position, r95_m) = answer(bounding_box)?;
            Some((distance_m(position, *truth), r95_m))
        };
        let errors: Vec<(f64, f64)> = self.tests.iter().filter_map(of_box).collect();
        let mean = |of: fn(&(f64, f64)) -> f64| errors.iter().map(of).sum::<f64>() / errors.len() as f64;
        let coverage = mean(|(error_m, r95_m)| f64::from(u8::from(error_m <= r95_m)));
        Score { mean_m: mean(|(error_m, _)| *error_m), coverage }
    }

    /// Places near the corners of what is seen, where an operator has read them off a picture and a map.
    fn known_points(&self, count: usize, seed: u64) -> Vec<KnownPoint> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let feet_px: Vec<[f64; 2]> = self.tests.iter().map(|(own, _)| own.foot_px()).collect();
        let mut point = |at: usize| {
            let (own, truth) = &self.tests[at];
            let mut draw_m = || KnownPoint::DEFAULT_SIGMA_M * standard_normal(&mut random);
            let error = EastNorth { east_m: draw_m(), north_m: draw_m() };
            KnownPoint {
                image_px: own.foot_px(),
                position: LocalPlane::new(*truth).to_position(error),
                sigma_m: SigmaM::new(KnownPoint::DEFAULT_SIGMA_M).expect("a sigma"),
            }
        };
        nearest_to_corners(&feet_px).into_iter().take(count).map(&mut point).collect()
    }

    /// A simulated square with 40 walkers, each of whom passes for a minute.
    fn simulated(seed: u64) -> Self {
        let options =
            Options { seed, camera_seed: seed, targets: 40, samples: 2_400, ..Options::new(Scene::Square) };
        let (train, test) = simulate_split(&options, 1_000);
        let mut samples: BTreeMap<TargetId, Vec<Sample>> = BTreeMap::new();
        let mut boxes = Vec::new();
        for sample in train.training_samples() {
            boxes.push(Detection {
                time: sample.time,
                target_id: sample.target_id.clone(),
                bounding_box: sample.bounding_box,
                class: sample.class.clone(),
                score: None,
            });
            samples.entry(sample.target_id.clone()).or_default().push(sample);
        }
        let tests = test.rows.iter().filter_map(|row| Some((row.bounding_box?, row.truth))).collect();
        Self { image_size: train.image_size, samples, boxes, tests }
    }

    /// One camera of the plaza. Whose a phone is, is known; other targets have the tracker's ids. With a seed the errors of
    /// the fixes are drawn again.
    fn plaza(camera: &str, redrawn: Option<u64>) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/plaza");
        let table = |name: &str| {
            let mut reader = csv::Reader::from_path(folder.join(name)).expect("the file");
            reader.records().map(|row| row.expect("a row")).collect::<Vec<_>>()
        };
        let persons: BTreeMap<String, String> = table("identity.csv")
            .iter()
            .filter(|row| &row[0] == camera)
            .map(|row| (row[1].to_owned(), row[2].to_owned()))
            .collect();
        let truths: BTreeMap<(jiff::Timestamp, String), Position> = table("truth.csv")
            .iter()
            .map(|row| {
                let degrees = |at: usize| row[at].parse::<f64>().expect("degrees");
                let key = (row[0].parse().expect("a time"), row[1].to_owned());
                (key, Position::new(degrees(2), degrees(3)).expect("a position"))
            })
            .collect();
        let mut fixes = plaza_fixes(&folder.join("fixes.csv"));
        if let Some(seed) = redrawn {
            fixes = with_redrawn_errors(fixes, &truths, seed);
        }
        let carriers: BTreeSet<String> = fixes
            .iter()
            .filter_map(|fix| fix.receiver_id.as_ref())
            .map(|id| id.as_str().to_owned())
            .collect();
        let (mut boxes, mut tests) =
            (plaza_boxes(&folder.join(format!("detections_{camera}.csv"))), Vec::new());
        for (number, own) in boxes.iter_mut().enumerate() {
            own.class = TargetClass::new("person").ok();
            let person = &persons[own.target_id.as_str()];
            if carriers.contains(person) {
                own.target_id = TargetId::new(person).expect("a name");
            } else if number % 4 == 0 {
                tests.extend(truths.get(&(own.time, person.clone())).map(|truth| (own.bounding_box, *truth)));
            }
        }
        let settings = PairingSettings { rule: PairingRule::Interpolated, ..PairingSettings::default() };
        let mut samples: BTreeMap<TargetId, Vec<Sample>> = BTreeMap::new();
        for sample in pair(boxes.clone(), fixes, &Receivers::default(), &settings).samples {
            samples.entry(sample.target_id.clone()).or_default().push(sample);
        }
        Self { image_size: ImageSize::new(1920, 1080).expect("a size"), samples, boxes, tests }
    }
}

fn rules() -> RowRules {
    RowRules {
        time_bounds: TimeBounds::at("2026-01-01T00:00:00Z".parse().expect("a time")),
        image_size: None,
    }
}

fn plaza_boxes(path: &PathBuf) -> Vec<Detection> {
    let file = std::fs::File::open(path).expect("the file");
    let rows = read_detections(file, Format::Csv, &rules(), None).expect("a header");
    rows.map(|row| row.expect("a file").expect("a row")).collect()
}

/// The fixes; a phone's receiver has the id of the person who carries it.
fn plaza_fixes(path: &Path) -> Vec<ReceivedFix> {
    let text = std::fs::read_to_string(path).expect("the file").replace("phone-", "person-");
    let rows = read_received_fixes(text.as_bytes(), FixFormat::Csv, rules().time_bounds).expect("a header");
    rows.map(|row| row.expect("a file").expect("a row")).collect()
}

/// The fixes at the true positions of their carriers with other errors of a phone, as the recording states them.
fn with_redrawn_errors(
    fixes: Vec<ReceivedFix>,
    truths: &BTreeMap<(jiff::Timestamp, String), Position>,
    seed: u64,
) -> Vec<ReceivedFix> {
    let (coloured_m, white_m) = (2.5_f64, 0.75_f64);
    let variance_m2 = coloured_m.powi(2) + white_m.powi(2);
    let correlation = NoiseCorrelation { white_share: white_m.powi(2) / variance_m2, time_constant_s: 30.0 };
    let noise = GaussMarkovNoise { variance_m2, correlation };
    let plane = LocalPlane::new(fixes[0].fix.position);
    let mut paths: BTreeMap<&str, Vec<(jiff::Timestamp, EastNorth)>> = BTreeMap::new();
    for ((time, person), truth) in truths {
        paths.entry(person).or_default().push((*time, plane.to_plane(*truth)));
    }
    let mut receivers: BTreeMap<String, (SimulatedReceiver, jiff::Timestamp)> = BTreeMap::new();
    let redrawn = |mut own: ReceivedFix| {
        let person = own.receiver_id.as_ref()?.as_str().to_owned();
        let truth = position_at(paths.get(person.as_str())?, own.time)?;
        let number = receivers.len() as u64;
        let (receiver, latest) = receivers
            .entry(person)
            .or_insert_with(|| (SimulatedReceiver::seeded(noise, seed, number), own.time));
        let since_s = own.time.duration_since(std::mem::replace(latest, own.time)).as_secs_f64();
        own.fix.position = plane.to_position(receiver.measure(truth, since_s));
        Some(own)
    };
    fixes.into_iter().filter_map(redrawn).collect()
}

/// Whether boxes without a fix take part.
const BOXES: [Beside; 2] =
    [Beside { boxes: false, known_points: 0 }, Beside { boxes: true, known_points: 0 }];
/// Numbers of known points.
const KNOWN_POINTS: [Beside; 3] = [
    Beside { boxes: true, known_points: 0 },
    Beside { boxes: true, known_points: 1 },
    Beside { boxes: true, known_points: 4 },
];

/// A line of the table: mean errors of all recordings and draws with that many receivers.
fn compare(name: &str, recordings: &[Recording], receivers: usize, draws: u64, besides: &[Beside]) -> String {
    let mut cells = format!("| {name} | {receivers} |");
    for beside in besides {
        let scores: Vec<Score> = recordings
            .iter()
            .filter(|recording| recording.samples.len() >= receivers)
            .flat_map(|recording| {
                let own = |draw| recording.score(Recipe::GaussianProcess, receivers, draw, *beside);
                (1..=draws).filter_map(own)
            })
            .collect();
        let mean = |of: fn(&Score) -> f64| scores.iter().map(of).sum::<f64>() / scores.len() as f64;
        let (mean_m, coverage) = (mean(|score| score.mean_m), mean(|score| score.coverage));
        write!(cells, " {mean_m:.2} m | {coverage:.2} |").expect("memory");
    }
    cells
}

const HEADER: &str = "| case | receivers | without boxes: mean | coverage | with boxes: mean | coverage |\n\
                      |---|---:|---:|---:|---:|---:|";

#[test]
#[ignore = "fits 24 models"]
fn boxes_without_a_fix_help_where_few_walkers_carry_a_receiver() {
    println!("{HEADER}");
    let worlds: Vec<Recording> = (1..=3).map(|world| Recording::simulated(4_100 + world)).collect();
    for receivers in [2, 3, 5, 10] {
        println!("{}", compare("simulated square", &worlds, receivers, 1, &BOXES));
    }
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_boxes_without_a_fix_by_number_of_receivers() {
    println!("{HEADER}");
    for camera in ["c1", "c2", "c3"] {
        let recording = [Recording::plaza(camera, None)];
        println!(
            "{camera}: {} receivers seen, {} test boxes",
            recording[0].samples.len(),
            recording[0].tests.len()
        );
        for receivers in RECEIVERS {
            let draws = if receivers < 10 { 3 } else { 1 };
            println!("{}", compare(&format!("plaza {camera}"), &recording, receivers, draws, &BOXES));
        }
    }
}

const HEADER_OF_POINTS: &str = "| case | receivers | no known point: mean | coverage | one | coverage | four | coverage |\n\
                                |---|---:|---:|---:|---:|---:|---:|---:|";

/// The mean error of a line's cells that are metres.
fn means_m(line: &str) -> Vec<f64> {
    line.split('|').filter_map(|cell| cell.trim().strip_suffix(" m")?.parse().ok()).collect()
}

#[test]
#[ignore = "fits 96 models"]
fn known_points_help_where_few_walkers_carry_a_receiver() {
    println!("{HEADER_OF_POINTS}");
    let worlds: Vec<Recording> = (1..=8).map(|world| Recording::simulated(4_200 + world)).collect();
    for receivers in [1, 2, 5, 10] {
        let line = compare("simulated square", &worlds, receivers, 1, &KNOWN_POINTS);
        println!("{line}");
        let means_m = means_m(&line);
        assert!(means_m[2] < 0.6 * means_m[0], "{line}");
    }
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_known_points_by_number_of_receivers() {
    let draws = std::env::var("DRAWS").map_or(1, |draws| draws.parse().expect("a number"));
    println!("{HEADER_OF_POINTS}");
    for camera in ["c1", "c2", "c3"] {
        let recording = [Recording::plaza(camera, None)];
        for receivers in [2, 5, 20] {
            let name = format!("plaza {camera}");
            let line = compare(&name, &recording, receivers, draws, &KNOWN_POINTS);
            println!("{line}");
            let means_m = means_m(&line);
            assert!(means_m[2] < means_m[0], "{line}");
        }
    }
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_phones_beside_the_homography() {
    let draws = std::env::var("DRAWS").map_or(1, |draws| draws.parse().expect("a number"));
    println!("| camera | phones | homography | mean | ratio | inside |\n|---|---:|---|---|---:|---|");
    let mut all = Vec::new();
    for camera in ["c1", "c2", "c3"] {
        let recordings: Vec<Recording> =
            (1..=draws).map(|draw| Recording::plaza(camera, Some(draw))).collect();
        for phones in [20, 5] {
            let beside = Beside { boxes: true, known_points: 0 };
            let scores = recordings.iter().zip(1..).map(|(recording, draw)| {
                let own = recording.score(Recipe::Auto, phones, draw, beside).expect("a model");
                [own.mean_m, recording.score_of_homography(phones, draw).mean_m, own.coverage]
            });
            let scores: Vec<[f64; 3]> = scores.collect();
            let with_range = |at: usize| {
                let least = scores.iter().map(|own| own[at]).fold(f64::INFINITY, f64::min);
                let most = scores.iter().map(|own| own[at]).fold(0.0, f64::max);
                format!("{:.2} ({least:.2} to {most:.2})", mean(&scores, at))
            };
            let [own, of_homography, inside] = [0, 1, 2].map(with_range);
            let ratio = mean(&scores, 0) / mean(&scores, 1);
            println!("| {camera} | {phones} | {of_homography} | {own} | {ratio:.2} | {inside} |");
            all.extend(scores);
        }
    }
    // Over all rows: one draw of one camera may favour a homography.
    let (ratio, inside) = (mean(&all, 0) / mean(&all, 1), mean(&all, 2));
    assert!(ratio < 0.8 && inside > 0.9, "{ratio} of the homography, {inside} inside");
}

/// Mean of a figure over scores.
fn mean(scores: &[[f64; 3]], at: usize) -> f64 {
    scores.iter().map(|own| own[at]).sum::<f64>() / scores.len() as f64
}
