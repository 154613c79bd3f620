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

/// Rows to learn from and rows to be tried on, of one camera.
pub(super) struct Split {
    pub(super) train: Vec<Sample>,
    pub(super) test: Vec<TestRow>,
    pub(super) image_size: Option<ImageSize>,
}

impl Split {
    /// The world of a seed, with a camera of that seed, and its test rows on a route.
    pub(super) fn of_world(base: &Options, seed: u64, test_rows: usize, route: Route) -> Self {
        let train = Options { seed, camera_seed: seed, ..base.clone() };
        let learnt = simulate(&train);
        let tried = simulate(&Options { route, ..train.test(test_rows) });
        Self {
            train: learnt.training_samples(),
            test: test_rows_of(&tried),
            image_size: Some(learnt.image_size),
        }
    }
}

/// The methods whose answer may hang on a seed.
const SEEDED: &str = "auto.one_step,auto.two_step,track";
/// Seeds of simulated worlds: so many from the first on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Worlds {
    pub(super) first: u64,
    pub(super) count: u64,
}

impl Worlds {
    pub(super) fn seeds(self) -> impl Iterator<Item = u64> {
        (0..self.count).map(move |at| self.first.wrapping_add(at))
    }

    /// So many times as many.
    const fn times(self, factor: u64) -> Self {
        Self { count: self.count * factor, ..self }
    }
}

/// One table of the page.
pub(super) struct Experiment {
    pub(super) group: &'static str,
    pub(super) title: String,
    pub(super) what: String,
    /// The same with files, where `simulate` and `evaluate` can do it.
    pub(super) command: Option<String>,
    /// One world for each seed, or the one recording for all.
    pub(super) worlds: Vec<Split>,
    /// Seeds of training, each on every world.
    pub(super) seeds: u64,
    pub(super) truth: Truth,
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
        (base, test_samples, route): (&Options, usize, Route),
        worlds: Worlds,
        flags: &str,
    ) -> anyhow::Result<Self> {
        let splits: Vec<Split> =
            worlds.seeds().map(|seed| Split::of_world(base, seed, test_samples, route)).collect();
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
            what: String::new(),
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

/// Everything on simulated worlds; each table is over so many of them.
pub(super) fn simulated(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    let mut all = tables_of_the_paper(worlds)?;
    all.extend(other_conditions(worlds)?);
    all.extend(few_passes(worlds)?);
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
    one.what =
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

/// One place tells little, for its 450 rows hold about six independent fixes; so four times as many
/// worlds.
fn standing(square: &Options, worlds: Worlds) -> anyhow::Result<Experiment> {
    const GROUP: &str = "Standing, and Table 2 (denied)";
    let base = Options { samples: 4_000, ..square.clone() };
    let test = (&base, 450, Route::Standing);
    let title = "Scenario 2: standing at a fixed point, each world another camera and place";
    let mut one = Experiment::simulated(GROUP, title, test, worlds.times(4), " --test-route standing")?;
    one.what = "Table 1 of the paper has GNSS 2.72, IMM-UKF 2.02, DNN 3.03, one-step 2.00, two-step 1.87 m; \
                Table 2 has, denied, mean/variance/max DNN 3.02/0.01/3.57, one-step 2.40/0.004/2.86. Here \
                the variance is the mean of those within each place."
        .to_owned();
    one.methods = Method::all();
    Ok(one)
}

/// What real cameras suffer: its name, the flags of the commands, the options.
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
    for scene in Scene::ALL {
        for (name, flags, options) in conditions(scene) {
            let title = format!("{scene}: {name}");
            let test = (&options, 1_000, Route::Lines);
            all.push(Experiment::simulated(GROUP, &title, test, worlds, flags)?);
        }
    }
    Ok(all)
}

/// Four passes of ten boxes each.
fn few_passes(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "Few passes: 4 passes, 40 boxes";
    let mut all = Vec::new();
    for scene in Scene::ALL {
        let base = Options { samples: 600, ..Options::new(scene) };
        let mut one =
            Experiment::simulated(GROUP, scene.as_str(), (&base, 1_000, Route::Lines), worlds.times(2), "")?;
        for world in &mut one.worlds {
            world.train = forty_of_four_passes(&world.train);
        }
        one.command = None;
        all.push(one);
    }
    Ok(all)
}

/// The first world with several seeds of training.
fn training_seeds(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    const GROUP: &str = "Seeds of training alone, one world";
    let mut all = Vec::new();
    for scene in Scene::ALL {
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
pub(super) fn real_square(folder: &Path, seeds: u64) -> anyhow::Result<Vec<Experiment>> {
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
            worlds: vec![Split {
                train: rows.iter().filter(outside).cloned().collect(),
                test: stretch.iter().map(test_row).collect(),
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
        observation: Observation {
            time: sample.time,
            target_id: Some(sample.target_id.clone()),
            bounding_box: Some(sample.bounding_box),
            fix: Some(sample.fix),
        },
        truth: None,
    }
}
