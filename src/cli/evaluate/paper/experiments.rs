//! What is tried: worlds, recordings, and the methods worth comparing on each.

use std::path::Path;

use anyhow::Context as _;
use jiff::{SignedDuration, Timestamp};

use crate::domain::{ImageSize, Observation, Sample, SigmaM};
use crate::evaluation::{Method, TestRow, Truth};
use crate::simulation::{Options, Route, Scene, World, simulate};

/// A hole in the recordings longer than this ends a stretch of time.
const STRETCH_HOLE: SignedDuration = SignedDuration::from_mins(10);
/// Fewer rows than this make no stretch of their own to test on.
const FEWEST_STRETCH_ROWS: usize = 300;
/// Standard deviation per axis of the recordings' receiver, m: 2.7 m mean error at a fixed point
/// (METHOD.md section 1) over sqrt(pi / 2).
const REAL_SIGMA_M: f64 = 2.2;

/// The methods that a user would choose among.
const DEFAULTS: &str =
    "gnss,imm_ukf,homography.denied,auto.one_step,auto.two_step,auto.denied,track,track.denied";

/// One table of the page.
pub(super) struct Experiment {
    pub(super) group: &'static str,
    pub(super) title: String,
    pub(super) what: String,
    /// The same with files, where `simulate` and `evaluate` can do it.
    pub(super) command: Option<String>,
    pub(super) train: Vec<Sample>,
    pub(super) test: Vec<TestRow>,
    pub(super) truth: Truth,
    pub(super) image_size: Option<ImageSize>,
    pub(super) gnss_sigma: SigmaM,
    pub(super) box_shift_px: f64,
    pub(super) methods: Vec<Method>,
    pub(super) show_curves: bool,
    /// Whether the group has a table of all its experiments together.
    pub(super) pooled: bool,
}

impl Experiment {
    /// An experiment on simulated worlds; `flags` is what the commands need beyond the scene.
    fn simulated(
        group: &'static str,
        title: &str,
        train: &Options,
        test: &Options,
        flags: &str,
    ) -> anyhow::Result<Self> {
        let (learnt, tried) = (simulate(train), simulate(test));
        let scene = train.scene;
        let image_size = learnt.image_size;
        let size = format!("{}x{}", image_size.width_px(), image_size.height_px());
        let command = format!(
            "sightfix simulate {scene} --out train.csv --test-out test.csv --samples {} --test-samples {}{flags}\n\
             sightfix evaluate --train train.csv --test test.csv --image-size {size} --gnss-sigma-m {} --seeds 3",
            train.samples, test.samples, train.gnss_sigma_m
        );
        Ok(Self {
            group,
            title: title.to_owned(),
            what: String::new(),
            command: Some(command),
            train: learnt.training_samples(),
            test: test_rows(&tried),
            truth: Truth::Columns,
            image_size: Some(image_size),
            gnss_sigma: SigmaM::new(train.gnss_sigma_m)?,
            box_shift_px: 0.0,
            methods: Method::list(DEFAULTS)?,
            show_curves: false,
            pooled: false,
        })
    }
}

fn test_rows(world: &World) -> Vec<TestRow> {
    let test_row = |row: &crate::simulation::SimulatedRow| TestRow {
        observation: Observation {
            time: row.time,
            target_id: Some(row.target_id.clone()),
            bounding_box: row.bounding_box,
            fix: row.fix,
        },
        truth: Some(row.truth),
    };
    world.rows.iter().map(test_row).collect()
}

/// Everything on simulated worlds.
pub(super) fn simulated() -> anyhow::Result<Vec<Experiment>> {
    let mut all = tables_of_the_paper()?;
    all.extend(other_conditions()?);
    all.extend(few_passes()?);
    Ok(all)
}

/// Tables 1 and 2, enlarged boxes, and a line that was not in training.
fn tables_of_the_paper() -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "The paper's experiments on simulated worlds";
    let airport = Options::new(Scene::Airport);
    let square = Options::new(Scene::Square);
    let mut one = Experiment::simulated(GROUP, "Scenario 1: airport", &airport, &airport.test(400), "")?;
    one.what =
        "Table 1 of the paper has GNSS 36.95, IMM-UKF 25.42, DNN 27.32, one-step 15.95, two-step 17.67 m."
            .to_owned();
    one.methods = Method::all();
    one.show_curves = true;
    let mut all = vec![one];
    for shift_px in [10.0, 30.0] {
        let title = format!("Airport, test boxes enlarged by {shift_px} px to the upper left");
        let mut one = Experiment::simulated(GROUP, &title, &airport, &airport.test(400), "")?;
        one.command = one.command.map(|command| format!("{command} --box-shift-px {shift_px}"));
        one.box_shift_px = shift_px;
        all.push(one);
    }
    for base in [&airport, &square] {
        let test = Options { route: Route::NewLine, ..base.test(400) };
        let title = format!("{}, a line that was not in training", base.scene);
        all.push(Experiment::simulated(GROUP, &title, base, &test, " --test-route new-line")?);
    }
    all.push(Experiment::simulated(GROUP, "Scenario 3: walked square", &square, &square.test(2_000), "")?);
    for camera_seed in 1..=6 {
        let base = Options { camera_seed, seed: camera_seed, samples: 4_000, ..square.clone() };
        let test = Options { route: Route::Standing, ..base.test(450) };
        let title = format!("Scenario 2: standing at a fixed point, camera and place {camera_seed}");
        let flags = format!(" --test-route standing --seed {camera_seed} --camera-seed {camera_seed}");
        let mut one = Experiment::simulated("Standing, and Table 2 (denied)", &title, &base, &test, &flags)?;
        if camera_seed == 1 {
            one.what = "Table 1 of the paper has GNSS 2.72, IMM-UKF 2.02, DNN 3.03, one-step 2.00, two-step \
                        1.87 m; Table 2 has, denied, mean/variance/max DNN 3.02/0.01/3.57, one-step \
                        2.40/0.004/2.86. 450 rows hold about six independent fixes, so that one place says \
                        little; the table of all places does."
                .to_owned();
            one.methods = Method::all();
        }
        one.pooled = true;
        all.push(one);
    }
    Ok(all)
}

/// What real cameras suffer.
fn other_conditions() -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "Other conditions on simulated worlds";
    let mut all = Vec::new();
    for scene in Scene::ALL {
        let base = Options { samples: 4_000, ..Options::new(scene) };
        let cases = [
            ("4 px of box noise", " --box-noise-px 4", Options { box_noise_px: 4.0, ..base.clone() }),
            (
                "a lens with 10 % barrel",
                " --lens-distortion -0.1",
                Options { lens_distortion: -0.1, ..base.clone() },
            ),
            ("boxes cut by the border", " --border-cuts true", Options { border_cuts: true, ..base.clone() }),
            (
                "no box cut by the border",
                " --border-cuts false",
                Options { border_cuts: false, ..base.clone() },
            ),
            ("20 % occluded", " --occlusion 0.2", Options { occlusion: 0.2, ..base.clone() }),
            ("5 % outliers", " --outliers 0.05", Options { outliers: 0.05, ..base.clone() }),
            ("30 % without fix", " --gnss-gaps 0.3", Options { gnss_gaps: 0.3, ..base.clone() }),
            ("6 targets", " --targets 6", Options { targets: 6, ..base.clone() }),
        ];
        for (name, flags, options) in cases {
            let title = format!("{scene}: {name}");
            all.push(Experiment::simulated(GROUP, &title, &options, &options.test(1_000), flags)?);
        }
    }
    Ok(all)
}

/// Four passes of ten boxes each.
fn few_passes() -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "Few passes: 4 passes, 40 boxes";
    let mut all = Vec::new();
    for scene in Scene::ALL {
        for camera_seed in 1..=3 {
            let base = Options { samples: 600, camera_seed, seed: camera_seed, ..Options::new(scene) };
            let title = format!("{scene}, camera {camera_seed}");
            let mut one = Experiment::simulated(GROUP, &title, &base, &base.test(1_000), "")?;
            one.train = forty_of_four_passes(&one.train);
            one.command = None;
            one.pooled = true;
            all.push(one);
        }
    }
    Ok(all)
}

/// Ten rows, evenly spread, of each of the first four passes.
fn forty_of_four_passes(samples: &[Sample]) -> Vec<Sample> {
    let together = |one: &Sample, next: &Sample| next.time.duration_since(one.time).as_secs() < 20;
    let passes = samples.chunk_by(together).take(4);
    let ten = |pass: &[Sample]| {
        (0..10).filter_map(|index| pass.get(index * pass.len() / 10).cloned()).collect::<Vec<_>>()
    };
    passes.flat_map(ten).collect()
}

/// The real square, each stretch of time told by a model of the others.
pub(super) fn real_square(folder: &Path) -> anyhow::Result<Vec<Experiment>> {
    let file = folder.join("square/training.csv");
    let rows = super::super::read_train(&file, None)?;
    let line = folder.join("square/truth_line.geojson");
    let text = std::fs::read_to_string(&line).with_context(|| format!("cannot read {}", line.display()))?;
    let truth = Truth::from_geojson(&text)?;
    let together = |one: &Sample, next: &Sample| next.time.duration_since(one.time) < STRETCH_HOLE;
    let stretches: Vec<&[Sample]> =
        rows.chunk_by(together).filter(|stretch| stretch.len() >= FEWEST_STRETCH_ROWS).collect();
    let mut all = Vec::new();
    for (index, stretch) in stretches.iter().enumerate() {
        let (from, until): (Timestamp, Timestamp) = (stretch[0].time, stretch[stretch.len() - 1].time);
        let outside = |sample: &&Sample| sample.time < from || sample.time > until;
        all.push(Experiment {
            group: "The real square, by stretches of time",
            title: format!("Stretch {}, {from} to {until}", index + 1),
            what: "Learnt from the other stretches; the error is the distance to the surveyed line."
                .to_owned(),
            command: None,
            train: rows.iter().filter(outside).cloned().collect(),
            test: stretch.iter().map(test_row).collect(),
            truth: truth.clone(),
            image_size: None,
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
        observation: Observation {
            time: sample.time,
            target_id: Some(sample.target_id.clone()),
            bounding_box: Some(sample.bounding_box),
            fix: Some(sample.fix),
        },
        truth: None,
    }
}
