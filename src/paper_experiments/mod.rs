//! The experiments of the paper, and further ones of this project, as a Markdown page of results
//! (docs/accuracy.md).
//!
//! All models are fitted on training rows with the recipes unchanged; nothing is selected by test
//! results. What never happens here: I/O.

mod ablations;
mod experiments;

use std::fmt::Write as _;

use experiments::Experiment;

use crate::clock::process_cpu_s;
use crate::domain::{Recipe, Sample};
use crate::evaluation::{EvaluateOptions, Evaluation, MethodReport, Metrics, TestRow, Truth};

pub use experiments::Worlds;

/// Epochs whose Es is listed.
const SHOWN_EPOCHS: [u32; 8] = [1, 2, 5, 10, 20, 50, 100, 200];

/// The recipe of tracks, and the default recipe of a camera.
const DEFAULT_RECIPE: Recipe = Recipe::Auto;

/// A recording of a real camera with a surveyed line as ground truth.
pub struct RealRecording {
    /// Its samples, in order of time.
    pub samples: Vec<Sample>,
    /// The surveyed line.
    pub truth: Truth,
}

/// Runs evaluations and shows the progress.
pub trait Runner {
    /// Evaluates methods on training and test rows.
    ///
    /// # Errors
    /// The evaluation's own.
    fn evaluate(
        &mut self,
        train: &[Sample],
        test: &[TestRow],
        truth: &Truth,
        options: &EvaluateOptions,
    ) -> anyhow::Result<Evaluation>;

    /// Reports the experiment that begins.
    fn begin(&mut self, experiment: &str);
}

/// Runs all experiments and returns the page.
///
/// # Errors
/// An evaluation or a fit that fails.
pub fn page(
    worlds: Worlds,
    recording: Option<&RealRecording>,
    runner: &mut dyn Runner,
) -> anyhow::Result<String> {
    let Worlds { first, count } = worlds;
    let mut page = String::from(HEAD);
    let shared_data = if recording.is_some() { " --shared-data DIR" } else { "" };
    // Writing to a string cannot fail.
    let _ = writeln!(
        page,
        "Made by `sightfix evaluate --paper --seeds {count} --first-world {first}{shared_data}`.\n"
    );
    let mut experiments = experiments::simulated(worlds)?;
    if let Some(recording) = recording {
        experiments.extend(experiments::real_square(recording, count)?);
    }
    let mut group = "";
    let mut pooled = Vec::new();
    for (number, experiment) in experiments.iter().enumerate() {
        let title = &experiment.title;
        runner.begin(&format!("experiment {} of {}: {title}", number + 1, experiments.len()));
        if experiment.group != group {
            pool(&mut page, &mut pooled);
            group = experiment.group;
            let _ = writeln!(page, "## {group}\n");
        }
        let evaluation = over_worlds(experiment, runner)?;
        section(&mut page, experiment, &evaluation);
        if experiment.pooled {
            pooled.push(evaluation);
        }
    }
    pool(&mut page, &mut pooled);
    ablations::tables(&mut page, worlds, runner)?;
    Ok(page)
}

/// Evaluates every world of an experiment, and averages over worlds; learning curves are those of the
/// first.
fn over_worlds(experiment: &Experiment, runner: &mut dyn Runner) -> anyhow::Result<Evaluation> {
    let mut evaluations = Vec::new();
    for world in &experiment.worlds {
        evaluations.push(runner.evaluate(
            &world.train,
            &world.test,
            &experiment.truth,
            &EvaluateOptions {
                methods: experiment.methods.clone(),
                default_recipe: DEFAULT_RECIPE,
                seeds: experiment.seeds,
                epochs: None,
                image_size: world.image_size,
                gnss_sigma: Some(experiment.gnss_sigma),
                gnss_bias_sigma: None,
                box_shift_px: experiment.box_shift_px,
                cpu_s: process_cpu_s,
            },
        )?);
    }
    let mut all = evaluations.remove(0);
    if evaluations.is_empty() {
        return Ok(all);
    }
    for (name, one) in &mut all.report.methods {
        let others = evaluations.iter().filter_map(|evaluation| evaluation.report.methods.get(name));
        let every: Vec<MethodReport> = std::iter::once(one.clone()).chain(others.cloned()).collect();
        let figures: Vec<Metrics> = every.iter().map(|own| own.metrics.clone()).collect();
        let count = every.len() as f64;
        if let Some(metrics) = Metrics::over_seeds(&figures) {
            *one = MethodReport {
                metrics,
                seed_means_m: every.iter().flat_map(|own| own.seed_means_m.clone()).collect(),
                train_cpu_s: every.iter().map(|own| own.train_cpu_s).sum::<f64>() / count,
                fuse_us: every.iter().map(|own| own.fuse_us).sum::<f64>() / count,
            };
        }
    }
    for evaluation in evaluations {
        all.report.failed.extend(evaluation.report.failed);
    }
    Ok(all)
}

const HEAD: &str = "\
# How accurate it is

Generated; do not edit. Errors are horizontal and geodesic (WGS 84), in metres. `cov50` and `cov95` are
the shares of true positions inside the stated 50 % and 95 % radius. The error to a line is the
distance to its nearest point, so it is smaller than the error to a known position, and its coverage
larger. A method that gives a position without a box (from the fix, or from earlier rows) is evaluated on
more rows than one that does not.

Each simulated table is over several worlds, each with its own camera, paths, noise and receiver; the
numbers are means over worlds, and `spread` is the standard deviation of the worlds' means. The variation
over training seeds of one world has a section of its own; on the real square `spread` is over training
seeds.

Ground truth used during development: that of simulated worlds (seeds 1 to 6, 101 to 103, 201, 202, and
1000 to 1099), with which constants of the error estimates and of the tracks were set; and the surveyed
line of the real square, with which earlier constants and settings of the track were compared and the
between-session variance was added. So the results on the real square are not on untouched data. The
simulated worlds of this page (from seed 2001 on) were not used before, and nothing was changed
afterwards but that addition, which does not affect them: each is one session.

If a receiver's error is correlated over minutes, the error of one model is nearly the same everywhere, so
in one world nearly all or nearly none of the true positions are inside a radius; coverage is meaningful
only over many worlds.

";

/// The section of one experiment: description, table, and Es per epoch if requested.
fn section(page: &mut String, experiment: &Experiment, evaluation: &Evaluation) {
    let _ = writeln!(page, "### {}\n\n{}\n", experiment.title, experiment.description);
    let _ = writeln!(
        page,
        "{} {}, {} training rows and {} test rows in the first, receiver sigma {} m per axis.\n",
        experiment.worlds.len(),
        if experiment.worlds.len() == 1 { "world" } else { "worlds" },
        experiment.worlds[0].train.len(),
        experiment.worlds[0].test.len(),
        experiment.gnss_sigma.metres()
    );
    if let Some(command) = &experiment.command {
        let _ = writeln!(page, "```sh\n{command}\n```\n");
    }
    let _ = writeln!(
        page,
        "| method | mean | spread | median | p95 | max | variance | RMSE | in 1 m | in 5 m | cov50 | cov95 | \
         train s | us | n |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    );
    for (name, one) in evaluation.report.rows() {
        let Metrics { mean_m, median_m, p95_m, max_m, variance_m2, rmse_m, n, .. } = one.metrics;
        let within = |bound: &str| percent(one.metrics.share_within.get(bound).copied());
        let _ = writeln!(
            page,
            "| `{name}` | {mean_m:.3} | {:.3} | {median_m:.3} | {p95_m:.3} | {max_m:.2} | {variance_m2:.3} | \
             {rmse_m:.3} | {} | {} | {} | {} | {:.2} | {:.2} | {n} |",
            one.seed_spread_m(),
            within("1"),
            within("5"),
            percent(one.metrics.coverage50),
            percent(one.metrics.coverage95),
            one.train_cpu_s,
            one.fuse_us,
        );
    }
    page.push('\n');
    for (name, reason) in &evaluation.report.failed {
        let _ = writeln!(page, "`{name}` was not run: {reason}.\n");
    }
    if experiment.show_curves {
        curves(page, evaluation);
    }
}

fn curves(page: &mut String, evaluation: &Evaluation) {
    let _ = writeln!(page, "Es per epoch of the final fit, first world:\n");
    let head: String = SHOWN_EPOCHS.iter().map(|epoch| format!(" {epoch} |")).collect();
    let _ = writeln!(page, "| recipe |{head} last |\n|---|{}", "---|".repeat(SHOWN_EPOCHS.len() + 1));
    for curve in &evaluation.curves {
        let _ = write!(page, "| `{}` |", curve.recipe);
        let cell =
            |scale: Option<f64>| scale.map_or_else(|| " |".to_owned(), |scale| format!(" {scale:.4} |"));
        for wanted in SHOWN_EPOCHS {
            let found = curve.epochs.iter().find(|one| one.epoch == wanted);
            page.push_str(&cell(found.map(|one| one.error_scale)));
        }
        page.push_str(&cell(curve.epochs.last().map(|one| one.error_scale)));
        page.push('\n');
    }
    page.push('\n');
}

/// The table of all experiments of a group together, every row with equal weight.
fn pool(page: &mut String, evaluations: &mut Vec<Evaluation>) {
    let Some(first) = evaluations.first().filter(|_| evaluations.len() > 1) else {
        evaluations.clear();
        return;
    };
    let _ = writeln!(page, "### All of these together\n\n| method | mean | cov95 | n |\n|---|---|---|---|");
    for (name, _) in first.report.rows() {
        let figures: Vec<&Metrics> = evaluations
            .iter()
            .filter_map(|evaluation| Some(&evaluation.report.methods.get(name)?.metrics))
            .collect();
        let rows: f64 = figures.iter().map(|one| one.n as f64).sum();
        let mean_m = figures.iter().map(|one| one.mean_m * one.n as f64).sum::<f64>() / rows;
        let inside = figures.iter().map(|one| Some(one.coverage95? * one.n as f64)).sum::<Option<f64>>();
        let _ =
            writeln!(page, "| `{name}` | {mean_m:.3} | {} | {rows} |", percent(inside.map(|sum| sum / rows)));
    }
    page.push('\n');
    evaluations.clear();
}

fn percent(share: Option<f64>) -> String {
    share.map_or_else(|| "-".to_owned(), |share| format!("{:.1}%", 100.0 * share))
}
