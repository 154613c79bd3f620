//! Runs the methods of every case over its worlds, and averages their figures.

use std::collections::BTreeMap;

use super::Runner;
use super::cases::{Case, Experiment, key};
use super::splits::Split;
use crate::domain::Recipe;
use crate::{
    Curve, ErrorMetrics, EvaluateOptions, Evaluation, MethodReport, ScoredPrediction, TestRow, Trace,
    TracePoint,
};

/// The recipe of tracks, and the default recipe of a camera.
const DEFAULT_RECIPE: Recipe = Recipe::Auto;

/// The figures of a method on a case.
pub(super) struct MethodScore {
    pub(super) name: String,
    /// On all rows for which it has a position; the seeds' means are those of the worlds.
    pub(super) report: MethodReport,
    /// On the rows with a box, so that methods with a box and without are compared on the same rows.
    pub(super) with_box: Option<ErrorMetrics>,
    /// The least and the largest mean error of one world on these rows, m.
    pub(super) range_m: Option<[f64; 2]>,
}

/// The figures of a case, means over its worlds.
pub(super) struct CaseScore {
    pub(super) case: Case,
    pub(super) group: &'static str,
    pub(super) in_main_table: bool,
    pub(super) worlds: usize,
    /// Rows of the first world.
    pub(super) train_rows: usize,
    pub(super) test_rows: usize,
    pub(super) gnss_sigma_m: f64,
    pub(super) methods: Vec<MethodScore>,
    /// Methods that could not run, with the reason.
    pub(super) failed: BTreeMap<String, String>,
    /// Curves of the first world; empty if the experiment shows none.
    pub(super) curves: Vec<Curve>,
    /// The predictions of all worlds, where a picture shows them.
    pub(super) traces: Vec<Trace>,
    /// The predictions and the test rows of the first world, where a picture shows them.
    pub(super) first_world: (Vec<Trace>, Vec<TestRow>),
}

impl CaseScore {
    pub(super) fn method(&self, name: &str) -> Option<&MethodScore> {
        self.methods.iter().find(|one| one.name == name)
    }

    /// The figures of a method on rows with a box.
    pub(super) fn figures(&self, method: &str) -> Option<&ErrorMetrics> {
        self.method(method)?.with_box.as_ref()
    }

    pub(super) fn mean_m(&self, method: &str) -> Option<f64> {
        Some(self.figures(method)?.mean_m)
    }

    pub(super) fn coverage95(&self, method: &str) -> Option<f64> {
        self.figures(method)?.coverage95
    }
}

/// Evaluates an experiment; one score per case.
pub(super) fn evaluate(
    mut experiment: Experiment,
    runner: &mut dyn Runner,
) -> anyhow::Result<Vec<CaseScore>> {
    let cases = std::mem::take(&mut experiment.cases);
    let mut worlds: Vec<Vec<WorldScore>> = cases.iter().map(|_| Vec::new()).collect();
    let mut curves = Vec::new();
    for split in &experiment.splits {
        let split = split()?;
        let (test, begins) = split.joined_tests()?;
        let options = options(&experiment, &split, runner.cpu_s());
        let evaluation = runner.evaluate(split.input(), &test, &experiment.truth, &options)?;
        for (at, scores) in worlds.iter_mut().enumerate() {
            let end = begins.get(at + 1).copied().unwrap_or(test.len());
            scores.push(WorldScore::of(&evaluation, &split, &test, begins[at]..end));
        }
        if curves.is_empty() && experiment.show_curves {
            curves = evaluation.curves;
        }
    }
    let mut scores: Vec<CaseScore> =
        cases.into_iter().zip(worlds).map(|(case, worlds)| score(case, &experiment, worlds)).collect();
    if let Some(first) = scores.first_mut() {
        first.curves = curves;
    }
    Ok(scores)
}

fn options(experiment: &Experiment, split: &Split, cpu_s: fn() -> f64) -> EvaluateOptions {
    EvaluateOptions {
        methods: experiment.methods.clone(),
        default_recipe: DEFAULT_RECIPE,
        seeds: experiment.seeds,
        epochs: None,
        image_size: split.image_size,
        gnss_sigma: Some(experiment.gnss_sigma),
        gnss_bias_sigma: None,
        box_shift_px: 0.0,
        cpu_s,
    }
}

/// A case on one world.
struct WorldScore {
    methods: Vec<MethodScore>,
    failed: BTreeMap<String, String>,
    train_rows: usize,
    traces: Vec<Trace>,
    test: Vec<TestRow>,
}

impl WorldScore {
    /// The part of an evaluation that is about some of its test rows.
    fn of(evaluation: &Evaluation, split: &Split, test: &[TestRow], rows: std::ops::Range<usize>) -> Self {
        let has_box = |point: &&TracePoint| test[point.row].observation.bounding_box().is_some();
        let own = |trace: &Trace| {
            let points = trace.points.iter().filter(|point| rows.contains(&point.row));
            let moved = points.map(|point| TracePoint { row: point.row - rows.start, ..*point });
            Trace { method: trace.method.clone(), points: moved.collect() }
        };
        let score = |trace: &Trace| {
            let points = || trace.points.iter().filter(|point| rows.contains(&point.row));
            let all = metrics_of(points())?;
            let mut report = evaluation.report.methods.get(&trace.method)?.clone();
            // With several seeds the report is about all of them, the traces about the first.
            if report.seed_means_m.len() == 1 {
                report.seed_means_m = vec![all.mean_m];
                report.metrics = all;
            }
            let with_box = metrics_of(points().filter(has_box));
            let range_m = with_box.as_ref().map(|one| [one.mean_m; 2]);
            Some(MethodScore { name: trace.method.clone(), report, with_box, range_m })
        };
        Self {
            methods: evaluation.traces.iter().filter_map(score).collect(),
            failed: evaluation.report.failed.clone(),
            train_rows: split.train.len(),
            traces: evaluation.traces.iter().map(own).collect(),
            test: test[rows.clone()].to_vec(),
        }
    }
}

fn metrics_of<'a>(points: impl Iterator<Item = &'a TracePoint>) -> Option<ErrorMetrics> {
    let scored = |point: &TracePoint| Some(ScoredPrediction { error_m: point.error_m?, r95_m: point.r95_m });
    ErrorMetrics::of(&points.filter_map(scored).collect::<Vec<_>>())
}

/// The means over worlds of a case.
fn score(case: Case, experiment: &Experiment, worlds: Vec<WorldScore>) -> CaseScore {
    let is_pictured = [key::LARGE, key::MANY_RECEIVERS].contains(&case.key.as_str());
    let methods = worlds[0].methods.iter().filter_map(|own| average(&own.name, &worlds)).collect();
    CaseScore {
        case,
        group: experiment.group,
        in_main_table: experiment.in_main_table,
        worlds: worlds.len(),
        train_rows: worlds[0].train_rows,
        test_rows: worlds[0].test.len(),
        gnss_sigma_m: experiment.gnss_sigma.metres(),
        methods,
        failed: worlds.iter().flat_map(|world| world.failed.clone()).collect(),
        curves: Vec::new(),
        traces: if is_pictured { pooled(&worlds) } else { Vec::new() },
        first_world: worlds
            .into_iter()
            .next()
            .filter(|_| is_pictured)
            .map(|world| (world.traces, world.test))
            .unwrap_or_default(),
    }
}

/// The means of a method over the worlds on which it ran.
fn average(name: &str, worlds: &[WorldScore]) -> Option<MethodScore> {
    let every: Vec<&MethodScore> =
        worlds.iter().filter_map(|world| world.methods.iter().find(|other| other.name == name)).collect();
    let count = every.len() as f64;
    let figures: Vec<ErrorMetrics> = every.iter().map(|one| one.report.metrics.clone()).collect();
    let with_box: Vec<ErrorMetrics> = every.iter().filter_map(|one| one.with_box.clone()).collect();
    let report = MethodReport {
        metrics: ErrorMetrics::over_seeds(&figures)?,
        seed_means_m: every.iter().flat_map(|one| one.report.seed_means_m.clone()).collect(),
        train_cpu_s: every.iter().map(|one| one.report.train_cpu_s).sum::<f64>() / count,
        fuse_us: every.iter().map(|one| one.report.fuse_us).sum::<f64>() / count,
    };
    let widest =
        |[low, high]: [f64; 2], [other_low, other_high]: [f64; 2]| [low.min(other_low), high.max(other_high)];
    Some(MethodScore {
        name: name.to_owned(),
        report,
        with_box: ErrorMetrics::over_seeds(&with_box),
        range_m: every.iter().filter_map(|one| one.range_m).reduce(widest),
    })
}

/// The predictions of all worlds per method; rows are those of their own worlds.
fn pooled(worlds: &[WorldScore]) -> Vec<Trace> {
    let of_method = |trace: &Trace| Trace {
        method: trace.method.clone(),
        points: worlds
            .iter()
            .flat_map(|world| world.traces.iter().filter(|other| other.method == trace.method))
            .flat_map(|other| other.points.iter().copied())
            .collect(),
    };
    worlds[0].traces.iter().map(of_method).collect()
}
