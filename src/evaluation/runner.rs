//! Runs every method over the test rows, in order of time per target, once per seed.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::time::Instant;

use super::learners::{Learnt, RecipeModel, learn_recipe, recipes_of, tune_imm_ukf};
use super::metrics::{Judged, Metrics};
use super::report::{MethodReport, Report};
use crate::domain::{
    BoundingBox, EpochReport, ImageSize, Method, Observation, Recipe, Result, Sample, SigmaM, Step, Truth,
};
use crate::filters::ImmUkf;
use crate::fusion::observed::{ObservedPositions, UNKNOWN_RECEIVER_M2};
use crate::fusion::target_track::TargetTrack;
use crate::fusion::track::{TrackSettings, passes};
use crate::fusion::two_step::fuse;
use crate::geo::{EastNorth, LocalPlane, Position};
use crate::model::{FEWEST_SAMPLES, R95_PER_SIGMA, dnn, homography};

/// One row to be told and judged.
#[derive(Debug, Clone, PartialEq)]
pub struct TestRow {
    /// Box, fix, or both.
    pub observation: Observation,
    /// Where the target truly was, if the row says so.
    pub truth: Option<Position>,
}

/// What to evaluate, and how.
#[derive(Clone)]
pub struct EvaluateOptions {
    /// In the order of the table.
    pub methods: Vec<Method>,
    /// The recipe that tracks use.
    pub default_recipe: Recipe,
    /// Every seed from 1 to this.
    pub seeds: u64,
    /// Passes of every fit; `None` for the recipe's own.
    pub epochs: Option<u32>,
    /// Size of the image, if known.
    pub image_size: Option<ImageSize>,
    /// Standard deviation per axis of the receiver, if known.
    pub gnss_sigma: Option<SigmaM>,
    /// Test boxes grow to the upper left by this, px.
    pub box_shift_px: f64,
    /// CPU seconds used so far by whoever evaluates.
    pub cpu_s: fn() -> f64,
}

/// A told position of the first seed, for the plots.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TracePoint {
    /// Index of the test row.
    pub row: usize,
    /// Told.
    pub position: Position,
    /// Its error, m, where the truth is known.
    pub error_m: Option<f64>,
}

/// All told positions of a method with the first seed, in order of target and time.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// The method's name.
    pub method: String,
    /// In order of target, then time.
    pub points: Vec<TracePoint>,
}

/// How a recipe's fit went, with the first seed.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// The recipe.
    pub recipe: Recipe,
    /// A point per epoch.
    pub epochs: Vec<EpochReport>,
}

/// A report with what the plots need beside it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Evaluation {
    /// Figures.
    pub report: Report,
    /// Of the first seed.
    pub traces: Vec<Trace>,
    /// Of the first seed.
    pub curves: Vec<Curve>,
}

/// What an evaluation is at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Doing<'a> {
    /// In words.
    pub words: &'a str,
    /// Steps done. A step is a recipe's fit, or a method over all test rows, with one seed.
    pub done: u32,
    /// Steps to do.
    pub planned: u32,
}

/// Who hears what is being done, and how many steps are behind.
struct Steps<'a> {
    tell: &'a mut dyn FnMut(&Doing<'_>) -> ControlFlow<()>,
    done: u32,
    planned: u32,
}

impl Steps<'_> {
    fn say(&mut self, words: &str) -> ControlFlow<()> {
        (self.tell)(&Doing { words, done: self.done, planned: self.planned })
    }
}

/// A position with the radius that the method states for 95 %.
#[derive(Debug, Clone, Copy)]
struct Told {
    position: Position,
    r95_m: Option<f64>,
}

/// Test rows of one target, in order of time: indexes into all of them.
type Target = Vec<usize>;

/// Learns from the training samples and judges every method over the test rows.
///
/// `progress` hears what is being done; breaking ends the evaluation with what there is so far.
///
/// # Errors
/// A box shift that makes boxes invalid. A method that cannot run is named in the report instead.
pub fn evaluate(
    train: &[Sample],
    test: &[TestRow],
    truth: &Truth,
    options: &EvaluateOptions,
    progress: &mut dyn FnMut(&Doing<'_>) -> ControlFlow<()>,
) -> Result<Evaluation> {
    let mut test = test.to_vec();
    for row in &mut test {
        let shifted = row.observation.bounding_box.map(|drawn| shifted(drawn, options.box_shift_px));
        row.observation.bounding_box = shifted.transpose()?;
    }
    let mut run = Run {
        train,
        test: &test,
        truth,
        options,
        targets: targets(&test),
        plane: LocalPlane::new(middle(train, &test)),
        seeds: BTreeMap::new(),
        evaluation: Evaluation::default(),
    };
    let seeds = options.seeds.max(1);
    let a_seed = recipes_of(&options.methods, options.default_recipe).len() + options.methods.len();
    let planned = u32::try_from(a_seed as u64 * seeds).unwrap_or(u32::MAX);
    let mut steps = Steps { tell: progress, done: 0, planned };
    for seed in 1..=seeds {
        if run.seed(seed, &mut steps).is_break() {
            break;
        }
    }
    Ok(run.finish())
}

/// The box grown to the upper left, as in the paper's test of bad boxes.
fn shifted(drawn: BoundingBox, by_px: f64) -> Result<BoundingBox> {
    let [left_px, top_px, width_px, height_px] = drawn.sides_px();
    BoundingBox::new(left_px - by_px, top_px - by_px, width_px + by_px, height_px + by_px)
}

fn targets(test: &[TestRow]) -> Vec<Target> {
    let mut order: Vec<usize> = (0..test.len()).collect();
    let key = |index: &usize| (&test[*index].observation.target_id, test[*index].observation.time);
    order.sort_by(|one, other| key(one).cmp(&key(other)));
    let same =
        |one: &usize, next: &usize| test[*one].observation.target_id == test[*next].observation.target_id;
    order.chunk_by(same).map(<[usize]>::to_vec).collect()
}

/// Origin of the filters' plane: the first fix that there is.
fn middle(train: &[Sample], test: &[TestRow]) -> Position {
    let first = train.first().map(|sample| sample.fix.position);
    let in_test = || test.iter().find_map(|row| Some(row.observation.fix?.position));
    first.or_else(in_test).unwrap_or_else(|| Position::new(0.0, 0.0).expect("within range"))
}

/// What one method did with one seed.
struct SeedRun {
    metrics: Metrics,
    train_cpu_s: f64,
    fuse_us: f64,
}

struct Run<'a> {
    train: &'a [Sample],
    test: &'a [TestRow],
    truth: &'a Truth,
    options: &'a EvaluateOptions,
    targets: Vec<Target>,
    plane: LocalPlane,
    seeds: BTreeMap<String, Vec<SeedRun>>,
    evaluation: Evaluation,
}

impl Run<'_> {
    fn seed(&mut self, seed: u64, steps: &mut Steps<'_>) -> ControlFlow<()> {
        let mut models: BTreeMap<&str, Learnt<RecipeModel>> = BTreeMap::new();
        for recipe in recipes_of(&self.options.methods, self.options.default_recipe) {
            steps.say(&format!("{recipe}, seed {seed}"))?;
            let mut say = |words: &str| steps.say(words);
            let model = learn_recipe(recipe, seed, self.train, self.options, &mut say);
            steps.done += 1;
            if let (1, Ok(learnt)) = (seed, &model.outcome) {
                self.evaluation.curves.push(Curve { recipe, epochs: learnt.curve.clone() });
            }
            models.insert(recipe.as_str(), model);
        }
        for method in self.options.methods.clone() {
            steps.say(&format!("{method}, seed {seed}"))?;
            let model = method.recipe(self.options.default_recipe).map(|recipe| &models[recipe.as_str()]);
            let begun_s = (self.options.cpu_s)();
            let answerer = match model {
                Some(Learnt { outcome: Ok(model), .. }) => self.over_model(method, model),
                Some(Learnt { outcome: Err(reason), .. }) => Err(reason.clone()),
                None => self.baseline(method, seed),
            };
            let own_cpu_s = (self.options.cpu_s)() - begun_s;
            let train_cpu_s = own_cpu_s + model.map_or(0.0, |model| model.cpu_s);
            match answerer {
                Ok(answerer) => self.judge(method, seed, answerer, train_cpu_s),
                Err(reason) => {
                    self.evaluation.report.failed.insert(method.to_string(), reason);
                }
            }
            steps.done += 1;
        }
        ControlFlow::Continue(())
    }

    /// Answers all rows and judges what was told.
    fn judge(&mut self, method: Method, seed: u64, mut answerer: Answerer<'_>, train_cpu_s: f64) {
        let (mut judged, mut points, mut rows) = (Vec::new(), Vec::new(), 0_u32);
        let mut busy_s = 0.0;
        for target in &self.targets {
            let begun = Instant::now();
            let told = answerer(target);
            busy_s += begun.elapsed().as_secs_f64();
            for (&row, told) in target.iter().zip(told) {
                rows += 1;
                let Some(Told { position, r95_m }) = told else { continue };
                let error_m = self.truth.error_m(self.test[row].truth, position);
                judged.extend(error_m.map(|error_m| Judged { error_m, r95_m }));
                points.push(TracePoint { row, position, error_m });
            }
        }
        let name = method.to_string();
        let Some(metrics) = Metrics::of(&judged) else {
            let reason = "no test row has both an answer and a truth".to_owned();
            self.evaluation.report.failed.insert(name, reason);
            return;
        };
        if seed == 1 {
            self.evaluation.traces.push(Trace { method: name.clone(), points });
        }
        let fuse_us = 1e6 * busy_s / f64::from(rows.max(1));
        self.seeds.entry(name).or_default().push(SeedRun { metrics, train_cpu_s, fuse_us });
    }

    fn finish(mut self) -> Evaluation {
        let report = &mut self.evaluation.report;
        report.order = self.options.methods.iter().map(Method::to_string).collect();
        for (name, seeds) in self.seeds {
            let figures: Vec<Metrics> = seeds.iter().map(|seed| seed.metrics.clone()).collect();
            let count = seeds.len() as f64;
            let Some(metrics) = Metrics::over_seeds(&figures) else { continue };
            report.methods.insert(
                name,
                MethodReport {
                    metrics,
                    seed_means_m: figures.iter().map(|seed| seed.mean_m).collect(),
                    train_cpu_s: seeds.iter().map(|seed| seed.train_cpu_s).sum::<f64>() / count,
                    fuse_us: seeds.iter().map(|seed| seed.fuse_us).sum::<f64>() / count,
                },
            );
        }
        self.evaluation
    }
}

/// Tells the positions of one target's rows, in their order.
type Answerer<'a> = Box<dyn FnMut(&Target) -> Vec<Option<Told>> + 'a>;

impl<'a> Run<'a> {
    /// Rows that are answered each by itself.
    fn row_by_row<'b>(&self, tell: impl Fn(&Observation) -> Option<Told> + 'b) -> Answerer<'b>
    where
        'a: 'b,
    {
        let test = self.test;
        Box::new(move |target| target.iter().map(|&row| tell(&test[row].observation)).collect())
    }

    /// The receiver's variance per axis for fixes that do not state their own, m2.
    fn gnss_variance_m2(&self, learnt_m2: Option<f64>) -> f64 {
        let known = self.options.gnss_sigma.map(SigmaM::variance_m2);
        known.or(learnt_m2).unwrap_or(UNKNOWN_RECEIVER_M2)
    }

    fn baseline<'b>(&self, method: Method, seed: u64) -> Result<Answerer<'b>, String>
    where
        'a: 'b,
    {
        let known = self.options.gnss_sigma.is_some();
        let variance_m2 = self.gnss_variance_m2(None);
        match method {
            Method::Gnss => Ok(self.row_by_row(move |observation| {
                let fix = observation.fix?;
                let sigma_m = fix.sigma_m.map(SigmaM::metres).or(known.then(|| variance_m2.sqrt()));
                let r95_m = sigma_m.map(|sigma_m| R95_PER_SIGMA * sigma_m);
                Some(Told { position: fix.position, r95_m })
            })),
            Method::ImmUkf => Ok(self.imm_ukf(variance_m2)),
            Method::Dnn | Method::DnnDenied => self.dnn(method == Method::Dnn, seed),
            Method::HomographyDenied => self.homography(seed),
            Method::Recipe(..) | Method::Track | Method::TrackDenied => Err("needs a model".to_owned()),
        }
    }

    /// The supervised network; in its 6D form it answers only rows that have a fix.
    fn dnn<'b>(&self, with_fix: bool, seed: u64) -> Result<Answerer<'b>, String>
    where
        'a: 'b,
    {
        self.enough()?;
        let plane = self.plane;
        let network = dnn::fit(self.train, &plane, with_fix, seed);
        Ok(self.row_by_row(move |observation| {
            let drawn = observation.bounding_box.as_ref()?;
            let fix = observation.fix.filter(|_| with_fix).map(|fix| plane.to_plane(fix.position));
            let point = (fix.is_some() == with_fix).then(|| network.regress(drawn, fix))?;
            Some(Told { position: plane.to_position(point), r95_m: None })
        }))
    }

    fn homography<'b>(&self, seed: u64) -> Result<Answerer<'b>, String>
    where
        'a: 'b,
    {
        let plane = self.plane;
        let pairs: Vec<(BoundingBox, EastNorth)> = self
            .train
            .iter()
            .map(|sample| (sample.bounding_box, plane.to_plane(sample.fix.position)))
            .collect();
        let homography = homography::fit(&pairs, seed)
            .ok_or("fewer than 8 training samples, or all of them at one spot")?;
        Ok(self.row_by_row(move |observation| {
            let point = homography.project(observation.bounding_box.as_ref()?)?;
            Some(Told { position: plane.to_position(point), r95_m: None })
        }))
    }

    /// The recipes refuse by themselves; the network has no such check.
    fn enough(&self) -> Result<(), String> {
        let fewest = FEWEST_SAMPLES;
        if (self.train.len() as u64) < fewest {
            return Err(format!("needs at least {fewest} training samples, has {}", self.train.len()));
        }
        Ok(())
    }

    fn imm_ukf<'b>(&self, variance_m2: f64) -> Answerer<'b>
    where
        'a: 'b,
    {
        let tuned = tune_imm_ukf(&passes(self.train, &self.plane), variance_m2);
        let (plane, test) = (self.plane, self.test);
        Box::new(move |target| {
            let mut filter = ImmUkf::new(tuned);
            let mut last = target.first().map(|&row| test[row].observation.time);
            let tell = |&row: &usize| {
                let Observation { time, fix, .. } = &test[row].observation;
                let seconds = last.replace(*time).map_or(0.0, |last| time.duration_since(last).as_secs_f64());
                let fix = fix.map(|fix| {
                    let own_m2 = fix.sigma_m.map_or(variance_m2, SigmaM::variance_m2);
                    (plane.to_plane(fix.position), own_m2)
                });
                let estimate = filter.step(seconds, fix)?;
                Some(Told {
                    position: plane.to_position(estimate.position),
                    r95_m: Some(R95_PER_SIGMA * estimate.variance_m2.sqrt()),
                })
            };
            target.iter().map(tell).collect()
        })
    }

    fn over_model<'b>(&self, method: Method, model: &'b RecipeModel) -> Result<Answerer<'b>, String>
    where
        'a: 'b,
    {
        let regressor = &model.regressor;
        let (plane, image_size) = (*regressor.plane(), self.options.image_size);
        let e_gnss_m2 = self.gnss_variance_m2(Some(regressor.e_gnss_m2()));
        Ok(match method {
            Method::Recipe(_, Step::TwoStep) => self.row_by_row(move |observation| {
                let fused = fuse(observation, Some((regressor, 0)), image_size, Some(e_gnss_m2))?;
                Some(Told { position: fused.fused, r95_m: Some(fused.r95_m) })
            }),
            Method::Recipe(_, step) => self.row_by_row(move |observation| {
                let fix = observation.fix.filter(|_| step == Step::OneStep);
                let fix = fix.map(|fix| plane.to_plane(fix.position));
                let regression = regressor.regress(observation.bounding_box.as_ref()?, fix);
                Some(Told {
                    position: plane.to_position(regression.regressed),
                    r95_m: Some(regression.r95_scale * regression.e_regression_m2.sqrt()),
                })
            }),
            Method::Track | Method::TrackDenied => {
                let settings = TrackSettings::learn(self.train, regressor);
                let test = self.test;
                let denied = method == Method::TrackDenied;
                Box::new(move |target| {
                    let mut track = TargetTrack::default();
                    let tell = |&row: &usize| {
                        let mut observation = test[row].observation.clone();
                        observation.fix = observation.fix.filter(|_| !denied);
                        let e_gnss_m2 = Some(e_gnss_m2);
                        let observed =
                            ObservedPositions::of(&observation, Some(regressor), image_size, e_gnss_m2);
                        let estimate = match observed.is_empty() {
                            true => track.at(observation.time),
                            false => track.update(&observed, || settings),
                        }?;
                        Some(Told { position: estimate.position, r95_m: Some(estimate.state.r95_m) })
                    };
                    target.iter().map(tell).collect()
                })
            }
            _ => return Err("needs no model".to_owned()),
        })
    }
}

#[cfg(test)]
mod tests;
