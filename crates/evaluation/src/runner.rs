//! Runs every method over the test rows, in order of time per target, once per seed.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::time::Instant;

use super::metrics::{ErrorMetrics, ScoredPrediction};
use super::model_fits::{RecipeModel, Timed, fit_recipe, recipes_of};
use super::options::{EvaluateOptions, Progress, TestRow};
use super::predictors::{Prediction, Predictor, Predictors, TargetRows};
use super::report::MethodReport;
use super::traces::{Curve, Evaluation, Trace, TracePoint};
use super::truth::error_m;
use crate::domain::{Method, Result, Sample, Truth};
use crate::geo::{LocalPlane, Position};
use crate::model::FitInput;

/// Fits what the methods need on the training samples and scores every method on the test rows. Boxes
/// without a fix serve the recipes alone.
///
/// `progress` is called before every step; breaking ends the evaluation with the methods and seeds
/// that were complete by then.
///
/// # Errors
/// A box shift that makes boxes invalid. A method that cannot run is named in the report instead.
pub fn evaluate<'a>(
    train: impl Into<FitInput<'a>>,
    test: &[TestRow],
    truth: &Truth,
    options: &EvaluateOptions,
    progress: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
) -> Result<Evaluation> {
    let train = train.into();
    let mut test = test.to_vec();
    for row in &mut test {
        row.observation = row
            .observation
            .clone()
            .try_map_box(|bounding_box| bounding_box.grown_to_upper_left(options.box_shift_px))?;
    }
    let plane = LocalPlane::new(first_fix(train.samples, &test));
    let mut run = Run {
        predictors: Predictors { train, test: &test, options, plane },
        truth,
        targets: rows_by_target(&test),
        seeds: BTreeMap::new(),
        evaluation: Evaluation::default(),
    };
    let seeds = options.seeds.max(1);
    let steps_per_seed = recipes_of(&options.methods, options.default_recipe).len() + options.methods.len();
    let planned = u32::try_from(steps_per_seed as u64 * seeds).unwrap_or(u32::MAX);
    let mut steps = Steps { observer: progress, done: 0, planned };
    for seed in 1..=seeds {
        if run.seed(seed, &mut steps).is_break() {
            break;
        }
    }
    Ok(run.finish())
}

fn rows_by_target(test: &[TestRow]) -> Vec<TargetRows> {
    let mut order: Vec<usize> = (0..test.len()).collect();
    let key = |index: &usize| (test[*index].observation.target_id(), test[*index].observation.time());
    order.sort_by(|one, other| key(one).cmp(&key(other)));
    let same =
        |one: &usize, next: &usize| test[*one].observation.target_id() == test[*next].observation.target_id();
    order.chunk_by(same).map(<[usize]>::to_vec).collect()
}

/// Origin of the baselines' plane.
fn first_fix(train: &[Sample], test: &[TestRow]) -> Position {
    let first = train.first().map(|sample| sample.fix.position);
    let in_test = || test.iter().find_map(|row| Some(row.observation.fix()?.position));
    first.or_else(in_test).unwrap_or_else(|| Position::new(0.0, 0.0).expect("within range"))
}

/// The observer of an evaluation and the count of its steps.
struct Steps<'a> {
    observer: &'a mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
    done: u32,
    planned: u32,
}

impl Steps<'_> {
    fn report(&mut self, phase: &str) -> ControlFlow<()> {
        (self.observer)(&Progress { phase, done: self.done, planned: self.planned })
    }
}

/// The figures of one method with one seed.
struct SeedRun {
    metrics: ErrorMetrics,
    train_cpu_s: f64,
    fuse_us: f64,
}

struct Run<'a> {
    predictors: Predictors<'a>,
    truth: &'a Truth,
    targets: Vec<TargetRows>,
    /// Runs per method, one per seed.
    seeds: BTreeMap<String, Vec<SeedRun>>,
    evaluation: Evaluation,
}

impl Run<'_> {
    fn seed(&mut self, seed: u64, steps: &mut Steps<'_>) -> ControlFlow<()> {
        let models = self.fit_recipes(seed, steps)?;
        let options = self.predictors.options;
        for method in options.methods.clone() {
            steps.report(&format!("{method}, seed {seed}"))?;
            let model = method.recipe(options.default_recipe).map(|recipe| &models[recipe.as_str()]);
            let predictor = Timed::run(options, || match model {
                Some(Timed { outcome: Ok(model), .. }) => self.predictors.of_model(method, model),
                Some(Timed { outcome: Err(reason), .. }) => Err(reason.clone()),
                None => self.predictors.baseline(method, seed),
            });
            let train_cpu_s = predictor.cpu_s + model.map_or(0.0, |model| model.cpu_s);
            match predictor.outcome {
                Ok(predictor) => self.score(method, seed, predictor, train_cpu_s),
                Err(reason) => self.fail(method, reason),
            }
            steps.done += 1;
        }
        ControlFlow::Continue(())
    }

    fn fit_recipes(
        &mut self,
        seed: u64,
        steps: &mut Steps<'_>,
    ) -> ControlFlow<(), BTreeMap<&'static str, Timed<RecipeModel>>> {
        let Predictors { train, options, .. } = self.predictors;
        let mut models = BTreeMap::new();
        for recipe in recipes_of(&options.methods, options.default_recipe) {
            steps.report(&format!("{recipe}, seed {seed}"))?;
            let model = fit_recipe(recipe, seed, train, options, &mut |phase| steps.report(phase));
            steps.done += 1;
            if let (1, Ok(fitted)) = (seed, &model.outcome) {
                self.evaluation.curves.push(Curve { recipe, epochs: fitted.curve.clone() });
            }
            models.insert(recipe.as_str(), model);
        }
        ControlFlow::Continue(models)
    }

    fn fail(&mut self, method: Method, reason: String) {
        self.evaluation.report.failed.insert(method.to_string(), reason);
    }

    /// Predicts all rows and scores the predictions against the truth.
    fn score(&mut self, method: Method, seed: u64, mut predictor: Predictor<'_>, train_cpu_s: f64) {
        let (mut scored, mut points, mut rows) = (Vec::new(), Vec::new(), 0_u32);
        let mut predicting_s = 0.0;
        for target in &self.targets {
            let start = Instant::now();
            let predictions = predictor(target);
            predicting_s += start.elapsed().as_secs_f64();
            for (&row, prediction) in target.iter().zip(predictions) {
                rows += 1;
                let Some(Prediction { position, r95_m, covariance }) = prediction else { continue };
                let error_m = error_m(self.truth, self.predictors.test[row].truth, position);
                scored.extend(error_m.map(|error_m| ScoredPrediction { error_m, r95_m }));
                points.push(TracePoint { row, position, error_m, r95_m, covariance });
            }
        }
        let Some(metrics) = ErrorMetrics::of(&scored) else {
            return self.fail(method, "no test row has both an answer and a truth".to_owned());
        };
        let name = method.to_string();
        if seed == 1 {
            self.evaluation.traces.push(Trace { method: name.clone(), points });
        }
        let fuse_us = 1e6 * predicting_s / f64::from(rows.max(1));
        self.seeds.entry(name).or_default().push(SeedRun { metrics, train_cpu_s, fuse_us });
    }

    fn finish(mut self) -> Evaluation {
        let report = &mut self.evaluation.report;
        report.order = self.predictors.options.methods.iter().map(Method::to_string).collect();
        for (name, seeds) in self.seeds {
            let figures: Vec<ErrorMetrics> = seeds.iter().map(|seed| seed.metrics.clone()).collect();
            let count = seeds.len() as f64;
            let Some(metrics) = ErrorMetrics::over_seeds(&figures) else { continue };
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
