//! The cases on simulated worlds.

use super::cases::{Case, Experiment, METHODS, key};
use super::splits::{Split, TestSet, forty_rows_of_four_traverses};
use crate::domain::SigmaM;
use crate::simulation::{Options, Route, Scene, TargetShape};
use crate::{Method, Truth};

/// The methods whose figures may depend on the training seed.
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
    /// The options with each of the seeds.
    pub(super) fn of(self, base: &Options) -> Vec<Options> {
        let seeds = (0..self.count).map(|at| self.first.wrapping_add(at));
        seeds.map(|seed| Options { seed, camera_seed: seed, ..base.clone() }).collect()
    }

    /// The same with another number of worlds.
    const fn with_count(self, count: u64) -> Self {
        Self { count, ..self }
    }
}

/// A simulated experiment before its worlds are made.
struct Simulated<'a> {
    group: &'static str,
    worlds: Vec<Options>,
    /// Flags of `simulate` beyond the scene, for the first world.
    flags: &'a str,
    /// Key, title and test set of every case.
    cases: Vec<(&'a str, &'a str, TestSet)>,
}

impl Simulated<'_> {
    fn experiment(self) -> anyhow::Result<Experiment> {
        let first = self.worlds[0].clone();
        // A user knows the error of a receiver only as a whole.
        let sigma_m = first.gnss_sigma_m.hypot(first.gnss_bias_sigma_m);
        let case = |(key, title, test): &(&str, &str, TestSet)| Case {
            key: (*key).to_owned(),
            title: (*title).to_owned(),
            description: String::new(),
            command: Some(command(&first, self.flags, test, sigma_m)),
        };
        let tests: Vec<TestSet> = self.cases.iter().map(|(_, _, test)| *test).collect();
        let split = |options: Options| -> Box<dyn Fn() -> anyhow::Result<Split>> {
            let tests = tests.clone();
            Box::new(move || Split::of_world(&options, &tests))
        };
        Ok(Experiment {
            group: self.group,
            cases: self.cases.iter().map(case).collect(),
            splits: self.worlds.into_iter().map(split).collect(),
            seeds: 1,
            truth: Truth::Columns,
            gnss_sigma: SigmaM::new(sigma_m)?,
            methods: Method::list(METHODS)?,
            show_curves: false,
            in_main_table: true,
        })
    }
}

/// The flags of `simulate` beyond those of training, and of `evaluate`.
fn test_flags(test: &TestSet) -> [String; 2] {
    let mut simulate = match test.route {
        None | Some(Route::Lines) => String::new(),
        Some(Route::NewLine) => " --test-route new-line".to_owned(),
        Some(Route::Area) => " --test-route area".to_owned(),
        Some(Route::Standing) => " --test-route standing".to_owned(),
    };
    if let Some(offset_m) = test.new_line_offset_m {
        simulate += &format!(" --new-line-offset-m {offset_m}");
    }
    let shift = test.box_shift_px;
    let evaluate = if shift > 0.0 { format!(" --box-shift-px {shift}") } else { String::new() };
    [simulate, evaluate]
}

fn command(world: &Options, flags: &str, test: &TestSet, sigma_m: f64) -> String {
    let size = match world.scene {
        Scene::Airport => "1920x1080",
        Scene::Square => "1280x720",
    };
    let [simulate, evaluate] = test_flags(test);
    format!(
        "sightfix simulate {} --seed {1} --camera-seed {1} --out train.csv --test-out test.csv --samples {2} \
         --test-samples {3}{flags}{simulate}\n\
         sightfix evaluate --train train.csv --test test.csv --image-size {size} --gnss-sigma-m {4}{evaluate}",
        world.scene,
        world.seed,
        world.samples,
        test.rows,
        (1e3 * sigma_m).round() / 1e3
    )
}

const AIRPORT: &str = "Simulated airport";
const SQUARE: &str = "Simulated square";

/// The aircraft of the airport, 37 m long with the antenna behind the cockpit: in a curve the antenna's
/// distance from the foot of the box varies by more than ten metres.
const LARGE: TargetShape =
    TargetShape { length_m: 37.0, width_m: 34.0, height_m: 12.0, antenna_ahead_m: 14.0, antenna_left_m: 0.0 };
const LARGE_FLAGS: &str = " --target-size-m 37x34x12 --antenna-m 14,0";

/// The airport: as in the paper, with a large aircraft, and with disturbances.
pub(super) fn airport(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    let base = Options { samples: DISTURBED_ROWS, without_cut_boxes: true, ..Options::new(Scene::Airport) };
    let uncut = Simulated {
        group: AIRPORT,
        worlds: worlds.of(&base),
        flags: " --train-without-cut-boxes",
        cases: vec![("airport-cut", "boxes cut by the border, none in training", TestSet::new(400))],
    };
    let mut all = vec![scenario_1(worlds)?];
    all.extend(large_aircraft(worlds)?);
    all.push(uncut.experiment()?);
    for condition in conditions(Scene::Airport) {
        all.push(condition.experiment(AIRPORT, worlds)?);
    }
    Ok(all)
}

fn scenario_1(worlds: Worlds) -> anyhow::Result<Experiment> {
    let test = TestSet::new(400);
    let mut as_the_paper = Simulated {
        group: AIRPORT,
        worlds: worlds.of(&Options::new(Scene::Airport)),
        flags: "",
        cases: vec![
            ("airport", "scenario 1 of the paper: 35 m aircraft, 29.5 m receiver", test),
            ("airport+10", "boxes enlarged by 10 px", test.enlarged_by(10.0)),
            ("airport+30", "boxes enlarged by 30 px", test.enlarged_by(30.0)),
            ("airport-new-line", "a line 20 m beside", test.on(Route::NewLine)),
        ],
    }
    .experiment()?;
    as_the_paper.methods = Method::all();
    as_the_paper.show_curves = true;
    as_the_paper.cases[0].description =
        "Table 1 of the paper has GNSS 36.95, IMM-UKF 25.42, DNN 27.32, one-step 15.95, two-step 17.67 m."
            .to_owned();
    Ok(as_the_paper)
}

fn large_aircraft(worlds: Worlds) -> anyhow::Result<[Experiment; 2]> {
    let large = Options { target_shape: Some(LARGE), ..Options::new(Scene::Airport) };
    let quiet = Options { samples: 4_000, gnss_sigma_m: 8.0, ..large.clone() };
    let test = TestSet::new(400);
    let of_large = Simulated {
        group: AIRPORT,
        worlds: worlds.of(&large),
        flags: LARGE_FLAGS,
        cases: vec![
            (key::LARGE, "large aircraft, 37 m, antenna 14 m ahead", test),
            ("large+10", "the same, boxes enlarged by 10 px", test.enlarged_by(10.0)),
            (key::LARGE_30_PX, "the same, boxes enlarged by 30 px", test.enlarged_by(30.0)),
        ],
    };
    let beside = TestSet { new_line_offset_m: Some(12.0), ..test.on(Route::NewLine) };
    let of_quiet = Simulated {
        group: AIRPORT,
        worlds: worlds.of(&quiet),
        flags: &format!("{LARGE_FLAGS} --gnss-sigma-m 8"),
        cases: vec![
            ("large-8", "large aircraft, 8 m receiver", test),
            (key::LARGE_NEW_LINE, "the same, a line 12 m beside", beside),
        ],
    };
    Ok([of_large.experiment()?, of_quiet.experiment()?])
}

/// The square: as in the paper, with several receivers and sessions, with broken ids, and with disturbances.
pub(super) fn square(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    // Twice as many worlds: a receiver's error is nearly the same in all rows of one of them.
    let twice = worlds.with_count(2 * worlds.count);
    let base = Options { samples: DISTURBED_ROWS, ..Options::new(Scene::Square) };
    let test = TestSet::new(600);
    let sessions = Options { sessions: 2, gnss_sigma_m: 1.5, gnss_bias_sigma_m: 2.0, ..base.clone() };
    let sessions = Simulated {
        group: SQUARE,
        worlds: twice.of(&sessions),
        flags: " --sessions 2 --gnss-sigma-m 1.5 --gnss-bias-sigma-m 2",
        cases: vec![("square-sessions", "two sessions that disagree by a bias of 2 m", test)],
    };
    let tracker = Options { targets: 8, route: Route::Area, tracker_id_lifetime_s: Some(20.0), ..base };
    let tracker = Simulated {
        group: SQUARE,
        worlds: twice.of(&tracker),
        flags: " --targets 8 --route area --tracker-id-lifetime-s 20",
        cases: vec![("square-ids", "8 people come and go, ids go to others", test)],
    };
    let mut all =
        vec![walked(twice)?, many_receivers(worlds)?, sessions.experiment()?, tracker.experiment()?];
    for condition in conditions(Scene::Square) {
        let is_compared = condition.key == key::GROSS[1][1];
        all.push(condition.experiment(SQUARE, if is_compared { twice } else { worlds })?);
    }
    Ok(all)
}

fn walked(worlds: Worlds) -> anyhow::Result<Experiment> {
    let test = TestSet::new(600);
    let mut walked = Simulated {
        group: SQUARE,
        worlds: worlds.of(&Options { samples: DISTURBED_ROWS, ..Options::new(Scene::Square) }),
        flags: "",
        cases: vec![
            ("square", "scenario 3 of the paper: one person, one receiver", test),
            ("square-new-line", "a line 2 m beside", test.on(Route::NewLine)),
            ("square-standing", "scenario 2: standing at a fixed point", test.on(Route::Standing)),
            ("square+10", "boxes enlarged by 10 px", test.enlarged_by(10.0)),
        ],
    }
    .experiment()?;
    walked.methods = Method::all();
    walked.show_curves = true;
    walked.cases[2].description =
        "Table 1 of the paper has GNSS 2.72, IMM-UKF 2.02, DNN 3.03, one-step 2.00, two-step 1.87 m; Table 2 \
         has, denied, mean/variance/max DNN 3.02/0.01/3.57, one-step 2.40/0.004/2.86. Here the variance is \
         the mean of those within each place."
            .to_owned();
    Ok(walked)
}

/// Twenty worlds of 6 to 20 targets, in view for three minutes to one, each with a receiver whose bias
/// lasts.
fn many_receivers(worlds: Worlds) -> anyhow::Result<Experiment> {
    const COUNT: usize = 20;
    let base = Options {
        route: Route::Area,
        gnss_sigma_m: 1.5,
        gnss_bias_sigma_m: 2.0,
        ..Options::new(Scene::Square)
    };
    let mut each = worlds.with_count(COUNT as u64).of(&base);
    for (index, world) in each.iter_mut().enumerate() {
        world.targets = 6 + 14 * index / (COUNT - 1);
        world.samples = world.targets * (180 - 120 * index / (COUNT - 1));
    }
    Simulated {
        group: SQUARE,
        worlds: each,
        flags: " --targets 6 --route area --gnss-sigma-m 1.5 --gnss-bias-sigma-m 2",
        cases: vec![(
            key::MANY_RECEIVERS,
            "6 to 20 people, each with a receiver and its bias, 3 to 1 min",
            TestSet::new(600),
        )],
    }
    .experiment()
}

/// A disturbance of a real camera.
pub(super) struct Condition {
    pub(super) key: String,
    pub(super) name: &'static str,
    flags: &'static str,
    pub(super) options: Options,
}

impl Condition {
    fn experiment(self, group: &'static str, worlds: Worlds) -> anyhow::Result<Experiment> {
        Simulated {
            group,
            worlds: worlds.of(&self.options),
            flags: self.flags,
            cases: vec![(&self.key, self.name, TestSet::new(600))],
        }
        .experiment()
    }
}

/// Training rows of disturbed worlds, and of those that they are compared with.
const DISTURBED_ROWS: usize = 2_000;

/// The disturbances of a scene; at the airport also none, with as many rows.
pub(super) fn conditions(scene: Scene) -> Vec<Condition> {
    let base = Options { samples: DISTURBED_ROWS, ..Options::new(scene) };
    let mut all = Vec::new();
    let mut add = |key: &str, name, flags, options: Options| {
        all.push(Condition { key: format!("{scene}-{key}"), name, flags, options });
    };
    match scene {
        Scene::Airport => add("undisturbed", "2,000 training rows", "", base.clone()),
        Scene::Square => add(
            "cut",
            "boxes cut by the border",
            " --border-cuts true",
            Options { border_cuts: true, ..base.clone() },
        ),
    }
    let gross = Options { gross_fixes: 0.05, ..base.clone() };
    add("gross", "5 % of the fixes wrong by 1 km", " --gross-fixes 0.05", gross);
    let barrel = Options { lens_distortion: -0.1, ..base.clone() };
    add("barrel", "a lens with 10 % barrel", " --lens-distortion -0.1", barrel);
    add("noise", "4 px of box noise", " --box-noise-px 4", Options { box_noise_px: 4.0, ..base.clone() });
    add("occluded", "20 % occluded", " --occlusion 0.2", Options { occlusion: 0.2, ..base.clone() });
    add(
        "outliers",
        "5 % outliers of box or fix",
        " --outliers 0.05",
        Options { outliers: 0.05, ..base.clone() },
    );
    add("gaps", "30 % without fix", " --gnss-gaps 0.3", Options { gnss_gaps: 0.3, ..base.clone() });
    add("targets", "6 targets", " --targets 6", Options { targets: 6, ..base });
    all
}

/// Four traverses of ten boxes each.
pub(super) fn few_traverses(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    let mut all = Vec::new();
    for &scene in Scene::ALL {
        let base = Options { samples: 600, ..Options::new(scene) };
        let mut experiment = Simulated {
            group: "Four walks of ten boxes",
            worlds: Vec::from([base.clone()]),
            flags: "",
            cases: vec![("few", "", TestSet::new(600))],
        }
        .experiment()?;
        experiment.cases[0].key = format!("{scene}-few");
        experiment.cases[0].title = format!("{scene}: 4 traverses, 40 boxes");
        experiment.cases[0].command = None;
        let thinned = |options: Options| -> Box<dyn Fn() -> anyhow::Result<Split>> {
            Box::new(move || {
                let mut split = Split::of_world(&options, &[TestSet::new(600)])?;
                split.train = forty_rows_of_four_traverses(&split.train);
                Ok(split)
            })
        };
        let twice = worlds.with_count(2 * worlds.count);
        experiment.splits = twice.of(&base).into_iter().map(thinned).collect();
        all.push(experiment);
    }
    Ok(all)
}

/// The first world with several training seeds.
pub(super) fn training_seeds(worlds: Worlds) -> anyhow::Result<Vec<Experiment>> {
    let mut all = Vec::new();
    for &scene in Scene::ALL {
        let chosen = ["airport-undisturbed", "square-outliers"];
        for condition in conditions(scene) {
            if !chosen.contains(&condition.key.as_str()) {
                continue;
            }
            let key = format!("seeds-{}", condition.key);
            let title = format!("{scene}: {}", condition.name);
            let mut one = condition.experiment("Seeds of training alone, one world", worlds.with_count(1))?;
            for case in &mut one.cases {
                case.key.clone_from(&key);
                case.title.clone_from(&title);
                case.command = case.command.take().map(|text| format!("{text} --seeds {}", worlds.count));
            }
            one.seeds = worlds.count;
            one.methods = Method::list(SEEDED)?;
            one.in_main_table = false;
            all.push(one);
        }
    }
    Ok(all)
}

/// The samples of a scene's traverses over its lines or its area, for the curve over their number.
pub(super) fn walks_of(scene: Scene, worlds: Worlds) -> Vec<Options> {
    let route = if scene == Scene::Square { Route::Area } else { Route::Lines };
    worlds.of(&Options { samples: 1_800, route, ..Options::new(scene) })
}
