//! The plaza of ../shared/data: pairs right with a known model and without one, over redrawn phones. What
//! is drawn again are the errors of the fixes, as the data's description says; identities and true positions
//! judge alone.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use sightfix::domain::{
    Detection, Fix, GnssError, ImageSize, ReceivedFix, ReceiverId, Receivers, Recipe, Sample, TargetId,
    TimeBounds,
};
use sightfix::exchange::{FixFormat, Format, RowRules, read_detections, read_received_fixes};
use sightfix::fusion::association::{
    Cancellation, MatchSettings, Matching, match_with_model, match_without_model,
};
use sightfix::fusion::pairing::{PairingRule, PairingSettings, pair};
use sightfix::geo::{Position, distance_m};
use sightfix::model::{FitInput, FitOptions, Regressor, fit};

const CAMERAS: [&str; 3] = ["c1", "c2", "c3"];
/// Draw of the phones' errors that known models are trained on.
const TRAINING_DRAW: u64 = 100;

struct Plaza {
    /// By camera: boxes with the tracker's ids.
    detections: BTreeMap<&'static str, Vec<Detection>>,
    /// Person by camera and tracker's id.
    persons: BTreeMap<(String, String), String>,
    truth: BTreeMap<String, Vec<(f64, Position)>>,
    fixes: Vec<ReceivedFix>,
}

fn seconds(time: jiff::Timestamp) -> f64 {
    time.as_microsecond() as f64 / 1e6
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/plaza")
}

fn table(name: &str) -> Vec<csv::StringRecord> {
    let mut reader = csv::Reader::from_path(folder().join(name)).expect("the file");
    reader.records().map(|row| row.expect("a row")).collect()
}

impl Plaza {
    fn read() -> Self {
        let time_bounds = TimeBounds::at("2026-01-01T00:00:00Z".parse().expect("a time"));
        let rules = RowRules { time_bounds, image_size: None };
        let open = |name: &str| std::fs::File::open(folder().join(name)).expect("the file");
        let detections = CAMERAS
            .map(|camera| {
                let file = open(&format!("detections_{camera}.csv"));
                let rows = read_detections(file, Format::Csv, &rules, None).expect("a header");
                (camera, rows.map(|row| row.expect("a file").expect("a row")).collect())
            })
            .into();
        // A person is also the id of an unbroken track.
        let persons = table("identity.csv")
            .iter()
            .flat_map(|row| [1, 2].map(|id| ((row[0].to_owned(), row[id].to_owned()), row[2].to_owned())))
            .collect();
        let mut truth: BTreeMap<String, Vec<(f64, Position)>> = BTreeMap::new();
        for row in table("truth.csv") {
            let degrees = |at: usize| row[at].parse::<f64>().expect("degrees");
            let position = Position::new(degrees(2), degrees(3)).expect("a position");
            let time = row[0].parse().expect("a time");
            truth.entry(row[1].to_owned()).or_default().push((seconds(time), position));
        }
        let rows = read_received_fixes(open("fixes.csv"), FixFormat::Csv, time_bounds).expect("a header");
        let fixes = rows.map(|row| row.expect("a file").expect("a row")).collect();
        Self { detections, persons, truth, fixes }
    }

    fn person_of(receiver_id: &ReceiverId) -> String {
        receiver_id.as_str().replace("phone-", "person-")
    }

    /// True position of a person on the straight line between annotated instants.
    fn true_position(&self, person: &str, at_s: f64) -> Option<Position> {
        let path = self.truth.get(person)?;
        let next = path.partition_point(|(time_s, _)| *time_s < at_s).min(path.len() - 1);
        let (before, after) = (path[next.saturating_sub(1)], path[next]);
        let span_s = after.0 - before.0;
        let share = if span_s > 0.0 { ((at_s - before.0) / span_s).clamp(0.0, 1.0) } else { 0.0 };
        let mix = |a: f64, b: f64| (1.0 - share) * a + share * b;
        Position::new(
            mix(before.1.longitude_deg(), after.1.longitude_deg()),
            mix(before.1.latitude_deg(), after.1.latitude_deg()),
        )
        .ok()
    }

    /// The same phones at the same instants with errors of another draw: Gauss-Markov of 2.5 m per axis and
    /// 30 s, and 0.75 m white.
    fn redrawn(&self, seed: u64) -> Vec<ReceivedFix> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { random.sample(StandardNormal) };
        let mut biases: BTreeMap<&ReceiverId, (f64, [f64; 2])> = BTreeMap::new();
        let mut redrawn = Vec::with_capacity(self.fixes.len());
        for fix in &self.fixes {
            let receiver_id = fix.receiver_id.as_ref().expect("a receiver");
            let at_s = seconds(fix.time);
            let truth = self.true_position(&Self::person_of(receiver_id), at_s).expect("annotated");
            let decay = biases.get(receiver_id).map_or(0.0, |(last_s, _)| (-(at_s - last_s) / 30.0).exp());
            let bias = biases.entry(receiver_id).or_insert((at_s, [0.0; 2]));
            bias.0 = at_s;
            for bias_m in &mut bias.1 {
                *bias_m = decay * *bias_m + 2.5 * (1.0 - decay * decay).sqrt() * normal();
            }
            let [east_m, north_m] = bias.1.map(|bias_m| bias_m + 0.75 * normal());
            let metres_per_degree = 111_320.0 * truth.latitude_deg().to_radians().cos();
            let position = Position::new(
                truth.longitude_deg() + east_m / metres_per_degree,
                truth.latitude_deg() + north_m / 111_200.0,
            );
            let fix_at = Fix { position: position.expect("near"), sigma_m: None };
            redrawn.push(ReceivedFix { fix: fix_at, ..fix.clone() });
        }
        redrawn
    }

    /// A model of a camera trained with known identities.
    fn known_model(&self, camera: &str, fixes: &[ReceivedFix]) -> Regressor {
        let carriers: BTreeMap<String, TargetId> = fixes
            .iter()
            .filter_map(|fix| fix.receiver_id.clone())
            .map(|id| (Self::person_of(&id), TargetId::from(id)))
            .collect();
        let (mut carried, mut others) = (Vec::new(), Vec::new());
        for own in &self.detections[camera] {
            match carriers.get(self.person(camera, own)) {
                Some(target_id) => carried.push(Detection { target_id: target_id.clone(), ..own.clone() }),
                None => others.push(own.clone()),
            }
        }
        let settings = PairingSettings { rule: PairingRule::Interpolated, ..PairingSettings::default() };
        let samples: Vec<Sample> = pair(carried, fixes.to_vec(), &Receivers::default(), &settings).samples;
        let options = FitOptions {
            recipe: Recipe::GaussianProcess,
            seed: 1,
            epochs: None,
            image_size: Some(image_size()),
            gnss_error: GnssError::Unknown,
            gnss_bias_sigma_m: None,
        };
        let input = FitInput { samples: &samples, unpaired: &others };
        let fitted = fit(input, &options, &mut |_| ControlFlow::Continue(())).expect("a fit");
        fitted.load().expect("a model")
    }

    fn person(&self, camera: &str, own: &Detection) -> &str {
        &self.persons[&(camera.to_owned(), own.target_id.as_str().to_owned())]
    }

    /// The boxes of a camera as of a tracker whose ids never break.
    fn unbroken(&self, camera: &str) -> Vec<Detection> {
        let of = |own: &Detection| {
            let target_id = TargetId::new(self.person(camera, own)).expect("an id");
            Detection { target_id, ..own.clone() }
        };
        self.detections[camera].iter().map(of).collect()
    }

    /// Mean error of regressed positions of all boxes, m.
    fn mean_error_m(&self, camera: &str, model: &Regressor) -> f64 {
        let boxes: Vec<&Detection> = self.detections[camera].iter().step_by(4).collect();
        let sum: f64 = boxes
            .iter()
            .map(|own| {
                let truth =
                    self.true_position(self.person(camera, own), seconds(own.time)).expect("annotated");
                let regressed = model.regress(&own.bounding_box, None).regressed;
                distance_m(model.plane().to_position(regressed), truth)
            })
            .sum();
        sum / boxes.len() as f64
    }

    /// True pairs: a tracker's id and the receiver of its person, with three fixes and more between its first
    /// and last box.
    fn true_pairs(
        &self,
        camera: &str,
        boxes: &[Detection],
        fixes: &[ReceivedFix],
    ) -> BTreeSet<(String, String)> {
        let mut spans: BTreeMap<&str, (f64, f64)> = BTreeMap::new();
        for own in boxes {
            let at_s = seconds(own.time);
            let span = spans.entry(own.target_id.as_str()).or_insert((at_s, at_s));
            *span = (span.0.min(at_s), span.1.max(at_s));
        }
        let receivers: BTreeSet<&ReceiverId> =
            fixes.iter().filter_map(|fix| fix.receiver_id.as_ref()).collect();
        let mut pairs = BTreeSet::new();
        for (tracker_id, (from_s, to_s)) in spans {
            let person = &self.persons[&(camera.to_owned(), tracker_id.to_owned())];
            for receiver_id in receivers.iter().filter(|id| &Self::person_of(id) == person) {
                let inside = fixes.iter().filter(|fix| {
                    fix.receiver_id.as_ref() == Some(receiver_id)
                        && (from_s..=to_s).contains(&seconds(fix.time))
                });
                if inside.count() >= 3 {
                    pairs.insert((tracker_id.to_owned(), receiver_id.as_str().to_owned()));
                }
            }
        }
        pairs
    }
}

fn image_size() -> ImageSize {
    ImageSize::new(1920, 1080).expect("a size")
}

/// Pairs counted against the truth.
#[derive(Default)]
struct Score {
    sure: usize,
    right: usize,
    found: usize,
    all: usize,
    /// Boxes of right pairs from 0.9 on, and of all true pairs.
    boxes_found: usize,
    boxes_all: usize,
    /// By stated probability from 0, 0.3, 0.5, 0.7, 0.9, 0.95: sum stated, right, number.
    bins: [(f64, usize, usize); 6],
}

impl Score {
    fn add(
        &mut self,
        plaza: &Plaza,
        camera: &str,
        (boxes, fixes): (&[Detection], &[ReceivedFix]),
        matching: &Matching,
    ) {
        let mut found = BTreeSet::new();
        for piece in &matching.pieces {
            let person = &plaza.persons[&(camera.to_owned(), piece.tracker_id.as_str().to_owned())];
            let is_right = person == &Plaza::person_of(&piece.receiver_id);
            let bin = [0.3, 0.5, 0.7, 0.9, 0.95].iter().filter(|least| piece.probability >= **least).count();
            self.bins[bin].0 += piece.probability;
            self.bins[bin].1 += usize::from(is_right);
            self.bins[bin].2 += 1;
            if piece.probability >= 0.9 {
                self.sure += 1;
                self.right += usize::from(is_right);
                if is_right {
                    self.boxes_found += piece.detections.len();
                    found.insert((piece.tracker_id.clone(), piece.receiver_id.clone()));
                }
            }
        }
        self.found += found.len();
        let pairs = plaza.true_pairs(camera, boxes, fixes);
        self.all += pairs.len();
        let carried: BTreeSet<&str> = pairs.iter().map(|(tracker_id, _)| tracker_id.as_str()).collect();
        self.boxes_all += boxes.iter().filter(|own| carried.contains(own.target_id.as_str())).count();
    }

    fn print(&self, name: &str) {
        println!(
            "{name}: {} pairs from 0.9 on, {} right ({:.3}); {} of {} pairs found ({:.3}), {:.3} of their boxes",
            self.sure,
            self.right,
            self.precision(),
            self.found,
            self.all,
            self.found as f64 / self.all.max(1) as f64,
            self.boxes_found as f64 / self.boxes_all.max(1) as f64
        );
        for (stated, right, number) in self.bins {
            let number = number.max(1) as f64;
            println!("  stated {:.3}, right {:.3} of {number}", stated / number, right as f64 / number);
        }
    }

    /// Mean stated probability of the pairs from 0.9 on.
    fn stated(&self) -> f64 {
        self.bins[4..].iter().map(|bin| bin.0).sum::<f64>() / self.sure.max(1) as f64
    }

    fn precision(&self) -> f64 {
        self.right as f64 / self.sure.max(1) as f64
    }
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_plaza_pairs_with_a_known_model() {
    let plaza = Plaza::read();
    let (mut all, mut unbroken) = (Score::default(), Score::default());
    for camera in CAMERAS {
        let model = plaza.known_model(camera, &plaza.redrawn(TRAINING_DRAW));
        let mut score = Score::default();
        for draw in 1..=20 {
            let fixes = plaza.redrawn(draw);
            let matched = |boxes: &[Detection]| {
                let mut random = ChaCha8Rng::seed_from_u64(draw);
                let settings = MatchSettings::default();
                match_with_model(
                    boxes,
                    &fixes,
                    &Receivers::default(),
                    &model,
                    &settings,
                    &mut random,
                    Cancellation::NEVER,
                )
                .expect("within bounds")
            };
            let boxes = &plaza.detections[camera];
            let matching = matched(boxes);
            score.add(&plaza, camera, (boxes, &fixes), &matching);
            all.add(&plaza, camera, (boxes, &fixes), &matching);
            let boxes = plaza.unbroken(camera);
            unbroken.add(&plaza, camera, (&boxes, &fixes), &matched(&boxes));
        }
        score.print(camera);
    }
    unbroken.print("all cameras, ids that never break");
    all.print("all cameras");
    assert!(all.precision() >= 0.95);
    // The goal for the share found is 0.6 (docs/explanation/association.md).
    assert!(all.found as f64 >= 0.35 * all.all as f64);
    assert!((all.stated() - all.precision()).abs() <= 0.05, "stated {}", all.stated());
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_plaza_without_a_model() {
    let plaza = Plaza::read();
    let draws: u64 = std::env::var("PLAZA_DRAWS").map_or(1, |text| text.parse().expect("a number"));
    let (mut accepted, mut within, mut far_off) = (0, 0, 0);
    for camera in CAMERAS {
        for draw in 1..=draws {
            let fixes = plaza.redrawn(draw);
            let known_m = plaza.mean_error_m(camera, &plaza.known_model(camera, &fixes));
            let mut random = ChaCha8Rng::seed_from_u64(draw);
            let settings = MatchSettings::default();
            let boxes = &plaza.detections[camera];
            let found = match_without_model(
                boxes,
                &fixes,
                &Receivers::default(),
                image_size(),
                &settings,
                &mut random,
                Cancellation::NEVER,
            );
            match found {
                Err(reason) => println!("{camera}, draw {draw}: {reason}; with identities {known_m:.2} m"),
                Ok(joint) => {
                    let mean_m = plaza.mean_error_m(camera, &joint.model.load().expect("a model"));
                    let mut score = Score::default();
                    score.add(&plaza, camera, (boxes, &fixes), &joint.matching);
                    println!(
                        "{camera}, draw {draw}: {mean_m:.2} m, with identities {known_m:.2} m; {:?}; {} of {} sure pairs right",
                        joint.scores, score.right, score.sure
                    );
                    accepted += 1;
                    within += usize::from(mean_m <= 1.2 * known_m);
                    far_off += usize::from(mean_m > 2.0 * known_m);
                }
            }
        }
    }
    println!("accepted {accepted}, within 1.2 times {within}, beyond twice {far_off}");
    assert!(far_off <= 1);
}
