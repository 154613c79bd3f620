//! The experiments: their worlds or recordings, and the methods compared on each.

use jiff::{SignedDuration, Timestamp};

use super::RealRecording;
use crate::domain::{ImageSize, Observation, Sample, SigmaM};
use crate::evaluation::{Method, TestRow, Truth};
use crate::simulation::{Options, Route, Scene, World, simulate};

/// A gap in a recording longer than this separates sessions.
const MAX_GAP: SignedDuration = SignedDuration::from_mins(10);
/// Sessions with fewer rows are not used as test sets.
const MIN_SESSION_ROWS: usize = 300;
/// Standard deviation per axis of the recordings' receiver, m: 2.7 m mean error at a fixed point,
/// divided by sqrt(pi / 2).
const REAL_SIGMA_M: f64 = 2.2;

/// The methods between which a user chooses.
const DEFAULTS: &str =
    "gnss,imm_ukf,homography.denied,auto.one_step,auto.two_step,auto.denied,track,track.denied";

/// Training and test rows of one camera.
pub(super) struct TrainTestSplit {
    pub(super) train: Vec<Sample>,
    pub(super) test: Vec<TestRow>,
    pub(super) image_size: Option<ImageSize>,
}

impl TrainTestSplit {
    /// The world of a seed, also the camera's, with test rows on a route.
    pub(super) fn of_world(base: &Options, seed: u64, test_rows: usize, route: Route) -> Self {
        let train = Options { seed, camera_seed: seed, ..base.clone() };
        let train_world = simulate(&train);
        let test_world = simulate(&Options { route, ..train.test(test_rows) });
        Self {
            train: train_world.training_samples(),
            test: test_rows_of(&test_world),
            image_size: Some(train_world.image_size),
        }
    }
}

/// The methods whose results may depend on the training seed.
const SEEDED: &str = "auto.one_step,auto.two_step,track";

/// Consecutive seeds of simulated worlds.
#[derive(Debug, Clone, Copy)]
pub struct Worlds {
    /// The first seed.
    pub first: u64,
    /// Number of worlds.
    pub count: u64,
}

impl Worlds {
    pub(super) fn seeds(self) -> impl Iterator<Item = u64> {
        (0..self.count).map(move |at| self.first.wrapping_add(at))
    }

    /// The same with a multiple of worlds.
    const fn times(self, factor: u64) -> Self {
        Self { count: self.count * factor, ..self }
    }
}

/// One table of the page.
pub(super) struct Experiment {
    pub(super) group: &'static str,
    pub(super) title: String,
    pub(super) description: String,
    /// Commands that reproduce the experiment, where `simulate` and `evaluate` can.
    pub(super) command: Option<String>,
    /// One per seed, or one recording.
    pub(super) worlds: Vec<TrainTestSplit>,
    /// Number of training seeds on every world.
    pub(super) seeds: u64,
    pub(super) truth: Truth,
    pub(super) gnss_sigma: SigmaM,
    pub(super) box_shift_px: f64,
    pub(super) methods: Vec<Method>,
    pub(super) show_curves: bool,
    /// Whether the group has a table over all its experiments.
    pub(super) pooled: bool,
}

impl Experiment {
    /// An experiment on simulated worlds; `flags` are the flags of `simulate` beyond the scene.
    fn simulated(
        group: &'static str,
        title: &str,
        (base, test_samples, route): (&Options, usize, Route),
        worlds: Worlds,
        flags: &str,
    ) -> anyhow::Result<Self> {
        let splits: Vec<TrainTestSplit> =
            worlds.seeds().map(|seed| TrainTestSplit::of_world(base, seed, test_samples, route)).collect();
        let first = worlds.first;
        let size = splits[0].image_size.map_or_else(String::new, |size| {
            format!(" --image-size {}x{}", size.width_px(), size.height_px())
        });
        let command = format!(
            "sightfix simulate {} --seed {first} --camera-seed {first} --out train.csv \
             --test-out test.csv --samples {} --test-samples {test_samples}{flags}\n\
             sightfix evaluate --train train.csv --test test.csv{size} --gnss-sigma-m {}",
            base.scene, base.samples, base.gnss_sigma_m
        );
        Ok(Self {
            group,
            title: title.to_owned(),
            description: String::new(),
            command: Some(command),
            worlds: splits,
            seeds: 1,
            truth: Truth::Columns,
            gnss_sigma: SigmaM::new(base.gnss_sigma_m)?,
            box_shift_px: 0.0,
            methods: Method::list(DEFAULTS)?,
            show_curves: false,
            pooled: false,
        })
    }
}

fn test_rows_of(world: &World) -> Vec<TestRow> {
    let test_row = |row: &crate::simulation::SimulatedRow| {
        Some(TestRow { observation: row.observation()?, truth: Some(row.truth) })
    };
    world.rows.iter().filter_map(test_row).collect()
}

/// All experiments on simulated worlds.
pub(super) fn simulated(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    let mut all = tables_of_the_paper(worlds)?;
    all.extend(other_conditions(worlds)?);
    all.extend(few_traverses(worlds)?);
    all.extend(training_seeds(worlds)?);
    Ok(all)
}

/// Tables 1 and 2, enlarged boxes, and a line that was not in training.
fn tables_of_the_paper(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "The paper's experiments on simulated worlds";
    let airport = Options::new(Scene::Airport);
    let square = Options::new(Scene::Square);
    let lines = (&airport, 400, Route::Lines);
    let mut one = Experiment::simulated(GROUP, "Scenario 1: airport", lines, worlds, "")?;
    one.description =
        "Table 1 of the paper has GNSS 36.95, IMM-UKF 25.42, DNN 27.32, one-step 15.95, two-step 17.67 m."
            .to_owned();
    one.methods = Method::all();
    one.show_curves = true;
    let mut all = vec![one];
    for shift_px in [10.0, 30.0] {
        let title = format!("Airport, test boxes enlarged by {shift_px} px to the upper left");
        let mut one = Experiment::simulated(GROUP, &title, lines, worlds, "")?;
        one.command = one.command.map(|command| format!("{command} --box-shift-px {shift_px}"));
        one.box_shift_px = shift_px;
        all.push(one);
    }
    for base in [&airport, &square] {
        let title = format!("{}, a line that was not in training", base.scene);
        let test = (base, 400, Route::NewLine);
        all.push(Experiment::simulated(GROUP, &title, test, worlds, " --test-route new-line")?);
    }
    let walked = (&square, 2_000, Route::Lines);
    all.push(Experiment::simulated(GROUP, "Scenario 3: walked square", walked, worlds, "")?);
    all.push(standing(&square, worlds)?);
    Ok(all)
}

/// Four times as many worlds: the 450 rows of one place contain only about six independent fixes.
fn standing(square: &Options, worlds: Worlds) -> anyhow::Result<Experiment> {
    const GROUP: &str = "Standing, and Table 2 (denied)";
    let base = Options { samples: 4_000, ..square.clone() };
    let test = (&base, 450, Route::Standing);
    let title = "Scenario 2: standing at a fixed point, each world another camera and place";
    let mut one = Experiment::simulated(GROUP, title, test, worlds.times(4), " --test-route standing")?;
    one.description =
        "Table 1 of the paper has GNSS 2.72, IMM-UKF 2.02, DNN 3.03, one-step 2.00, two-step 1.87 m; \
                Table 2 has, denied, mean/variance/max DNN 3.02/0.01/3.57, one-step 2.40/0.004/2.86. Here \
                the variance is the mean of those within each place."
            .to_owned();
    one.methods = Method::all();
    Ok(one)
}

/// Disturbances of real cameras: name, flags of `simulate`, options.
pub(super) fn conditions(scene: Scene) -> [(&'static str, &'static str, Options); 8] {
    let base = Options { samples: 4_000, ..Options::new(scene) };
    [
        ("4 px of box noise", " --box-noise-px 4", Options { box_noise_px: 4.0, ..base.clone() }),
        (
            "a lens with 10 % barrel",
            " --lens-distortion -0.1",
            Options { lens_distortion: -0.1, ..base.clone() },
        ),
        ("boxes cut by the border", " --border-cuts true", Options { border_cuts: true, ..base.clone() }),
        ("no box cut by the border", " --border-cuts false", Options { border_cuts: false, ..base.clone() }),
        ("20 % occluded", " --occlusion 0.2", Options { occlusion: 0.2, ..base.clone() }),
        ("5 % outliers", " --outliers 0.05", Options { outliers: 0.05, ..base.clone() }),
        ("30 % without fix", " --gnss-gaps 0.3", Options { gnss_gaps: 0.3, ..base.clone() }),
        ("6 targets", " --targets 6", Options { targets: 6, ..base }),
    ]
}

fn other_conditions(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "Other conditions on simulated worlds";
    let mut all = Vec::new();
    for &scene in Scene::ALL {
        for (name, flags, options) in conditions(scene) {
            let title = format!("{scene}: {name}");
            let test = (&options, 1_000, Route::Lines);
            all.push(Experiment::simulated(GROUP, &title, test, worlds, flags)?);
        }
    }
    Ok(all)
}

/// Four traverses of ten boxes each.
fn few_traverses(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "Few passes: 4 passes, 40 boxes";
    let mut all = Vec::new();
    for &scene in Scene::ALL {
        let base = Options { samples: 600, ..Options::new(scene) };
        let mut one =
            Experiment::simulated(GROUP, scene.as_str(), (&base, 1_000, Route::Lines), worlds.times(2), "")?;
        for world in &mut one.worlds {
            world.train = forty_rows_of_four_traverses(&world.train);
        }
        one.command = None;
        all.push(one);
    }
    Ok(all)
}

/// The first world with several training seeds.
fn training_seeds(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "Seeds of training alone, one world";
    let mut all = Vec::new();
    for &scene in Scene::ALL {
        let plain = [("as it is", "", Options { samples: 4_000, ..Options::new(scene) })];
        let harder = conditions(scene);
        let chosen = harder.into_iter().filter(|(name, ..)| ["5 % outliers", "6 targets"].contains(name));
        for (name, flags, options) in plain.into_iter().chain(chosen) {
            let title = format!("{scene}: {name}");
            let test = (&options, 1_000, Route::Lines);
            let first = Worlds { count: 1, ..worlds };
            let mut one = Experiment::simulated(GROUP, &title, test, first, flags)?;
            one.command = one.command.map(|command| format!("{command} --seeds {}", worlds.count));
            one.seeds = worlds.count;
            one.methods = Method::list(SEEDED)?;
            all.push(one);
        }
    }
    Ok(all)
}

/// Ten evenly spaced rows of each of the first four traverses.
fn forty_rows_of_four_traverses(samples: &[Sample]) -> Vec<Sample> {
    let is_same = |one: &Sample, next: &Sample| next.time.duration_since(one.time).as_secs() < 20;
    let traverses = samples.chunk_by(is_same).take(4);
    let ten = |traverse: &[Sample]| {
        (0..10).filter_map(|index| traverse.get(index * traverse.len() / 10).cloned()).collect::<Vec<_>>()
    };
    traverses.flat_map(ten).collect()
}

/// The real square: each session is the test set of a model trained on the others.
pub(super) fn real_square(recording: &RealRecording, seeds: u64) -> anyhow::Result<Vec<Experiment>> {
    let RealRecording { samples: rows, truth } = recording;
    let is_same = |one: &Sample, next: &Sample| next.time.duration_since(one.time) < MAX_GAP;
    let sessions: Vec<&[Sample]> =
        rows.chunk_by(is_same).filter(|session| session.len() >= MIN_SESSION_ROWS).collect();
    let mut all = Vec::new();
    for (index, session) in sessions.iter().enumerate() {
        let (from, until): (Timestamp, Timestamp) = (session[0].time, session[session.len() - 1].time);
        let outside = |sample: &&Sample| sample.time < from || sample.time > until;
        all.push(Experiment {
            group: "The real square, by stretches of time",
            title: format!("Stretch {}, {from} to {until}", index + 1),
            description: "Trained on the other sessions; the error is the distance to the surveyed line."
                .to_owned(),
            command: None,
            worlds: vec![TrainTestSplit {
                train: rows.iter().filter(outside).cloned().collect(),
                test: session.iter().map(test_row).collect(),
                image_size: None,
            }],
            seeds,
            truth: truth.clone(),
            gnss_sigma: SigmaM::new(REAL_SIGMA_M)?,
            box_shift_px: 0.0,
            methods: Method::all(),
            show_curves: false,
            pooled: true,
        });
    }
    Ok(all)
}

fn test_row(sample: &Sample) -> TestRow {
    TestRow {
        observation: Observation::with_fix(
            sample.time,
            Some(sample.target_id.clone()),
            Some(sample.bounding_box),
            sample.fix,
        ),
        truth: None,
    }
}
