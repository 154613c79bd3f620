//! Ablations: the balance of the loss and the smoothing of labels; and the cost of the default recipe.

use std::fmt::Write as _;
use std::ops::ControlFlow;

use super::Runner;
use super::simulated::Worlds;
use super::splits::{Split, TestSet};
use crate::domain::{GnssError, Recipe, SigmaM};
use crate::geo::distance_m;
use crate::model::network::LossWeights;
use crate::model::{Artifact, FitOptions, FitOverrides, fit_with};
use crate::simulation::{Options, Scene};

/// wX : wZ of the recipe `paper` (raw pixels and standardised degrees), and of `hybrid` (both scaled).
const BALANCES: [(Recipe, [f32; 5]); 2] = [
    (Recipe::Paper, [1.0 / 20.0, 1.0 / 200.0, 1.0 / 2_000.0, 1.0 / 20_000.0, 1.0 / 200_000.0]),
    (Recipe::Hybrid, [50.0, 5.0, 0.5, 0.05, 0.005]),
];
/// Candidates on raw labels, and on labels from a kinematic smoother.
const SMOOTHED: [[&str; 2]; 2] =
    [["projective/sides", "projective/sides+smoothed"], ["hybrid", "hybrid+smoothed"]];

/// Training rows of an ablation.
const ROWS: usize = 2_000;

/// All ablation tables.
pub(super) fn tables(page: &mut String, worlds: Worlds, runner: &mut dyn Runner) -> anyhow::Result<()> {
    loss_balance(page, worlds, runner)?;
    label_smoothing(page, worlds, runner)?;
    cost(page, worlds, runner.cpu_s())
}

fn loss_balance(page: &mut String, worlds: Worlds, runner: &mut dyn Runner) -> anyhow::Result<()> {
    let _ = writeln!(
        page,
        "## Error against the weight ratio wX : wZ\n\nMean error (m) of the regressed position from the box \
         alone, {} worlds of {ROWS} rows (airport, square). Of each recipe its own ratio stands in the \
         middle; ratios of `paper` are for raw pixels, those of `hybrid` for scaled boxes.\n\n\
         | recipe | wX : wZ | airport | square |\n|---|---|---|---|",
        worlds.count
    );
    for (recipe, ratios) in BALANCES {
        for ratio in ratios {
            let weights = LossWeights { reconstruction: ratio, regression: 1.0 };
            let mut cells = String::new();
            for &scene in Scene::ALL {
                let overrides = FitOverrides {
                    candidate: Some(recipe.as_str()),
                    loss_weights: Some(in_units(recipe, weights)),
                };
                let base = Options { samples: ROWS, ..Options::new(scene) };
                let (_, error_m) = mean_over(&base, worlds, recipe, overrides)?;
                let _ = write!(cells, " {error_m:.3} |");
            }
            let _ = writeln!(page, "| `{recipe}` | 1 : {} |{cells}", (1e6 / ratio).round() / 1e6);
            runner.begin(&format!("{recipe}, wX : wZ = 1 : {}", (1e6 / ratio).round() / 1e6));
        }
    }
    page.push('\n');
    Ok(())
}

/// `paper` normalises its weights as 1 : 2000, `hybrid` as 0.5 : 1. Adam is nearly invariant to the scale
/// of the loss, but a trial with a recipe's own ratio must reproduce that recipe exactly.
fn in_units(recipe: Recipe, weights: LossWeights) -> LossWeights {
    let unit = if recipe == Recipe::Paper { 1.0 / weights.reconstruction } else { 1.0 };
    LossWeights { reconstruction: unit * weights.reconstruction, regression: unit * weights.regression }
}

fn label_smoothing(page: &mut String, worlds: Worlds, runner: &mut dyn Runner) -> anyhow::Result<()> {
    let _ = writeln!(
        page,
        "## Labels prepared by a kinematic smoother, or not\n\nMeans over {} worlds, m: distance to the \
         fixes of held-out blocks of training (all that a choice may see), and to the truth of the test rows. \
         First with the fixes as they come, then smoothed.\n\n| case | candidate | held out, as they come | \
         smoothed | truth, as they come | smoothed |\n|---|---|---|---|---|---|",
        worlds.count
    );
    for &scene in Scene::ALL {
        let sized = |samples: usize| Options { samples, ..Options::new(scene) };
        for (name, options) in [("2,000 rows", sized(ROWS)), ("300 rows", sized(300))] {
            for pair in SMOOTHED {
                let mut columns = [String::new(), String::new()];
                for candidate in pair {
                    let overrides = FitOverrides { candidate: Some(candidate), loss_weights: None };
                    let (held_out_m, error_m) = mean_over(&options, worlds, Recipe::Auto, overrides)?;
                    let _ = write!(columns[0], " {held_out_m:.3} |");
                    let _ = write!(columns[1], " {error_m:.3} |");
                }
                let _ = writeln!(page, "| {scene}: {name} | `{}` |{}{}", pair[0], columns[0], columns[1]);
            }
            runner.begin(&format!("label smoothing: {scene}: {name}"));
        }
    }
    page.push('\n');
    Ok(())
}

fn cost(page: &mut String, worlds: Worlds, cpu_s: fn() -> f64) -> anyhow::Result<()> {
    let _ = writeln!(
        page,
        "## What the default costs\n\n`auto` on 10,000 rows, all candidates and held-out blocks included; the \
         first world (marks for a release build: 10 CPU s, 65,536 bytes).\n\n| scene | CPU s | model bytes |\n\
         |---|---|---|"
    );
    for &scene in Scene::ALL {
        for base in (Worlds { count: 1, ..worlds }).of(&Options::new(scene)) {
            let split = Split::of_world(&base, &[])?;
            let started_s = cpu_s();
            let artifact = train(&split, &base, Recipe::Auto, FitOverrides::default())?;
            let trained_s = cpu_s() - started_s;
            let _ = writeln!(page, "| {scene} | {trained_s:.2} | {} |", artifact.weights.len());
        }
    }
    page.push('\n');
    Ok(())
}

/// Mean held-out distance to the fixes and mean true error (m) of a fit over the worlds.
fn mean_over(
    base: &Options,
    worlds: Worlds,
    recipe: Recipe,
    overrides: FitOverrides<'_>,
) -> anyhow::Result<(f64, f64)> {
    let (mut held_out_m, mut error_m) = (0.0, 0.0);
    for world in worlds.of(base) {
        let split = Split::of_world(&world, &[TestSet::new(1_000)])?;
        let artifact = train(&split, base, recipe, overrides)?;
        held_out_m += artifact.metadata.held_out.as_ref().map_or(f64::NAN, |found| found.mean_to_fix_m);
        let regressor = artifact.load()?;
        let (mut sum_m, mut count) = (0.0, 0.0);
        for row in &split.tests[0] {
            let (Some(drawn), Some(truth)) = (&row.observation.bounding_box(), row.truth) else { continue };
            let position = regressor.plane().to_position(regressor.regress(drawn, None).regressed);
            sum_m += distance_m(truth, position);
            count += 1.0;
        }
        error_m += sum_m / count;
    }
    Ok((held_out_m / worlds.count as f64, error_m / worlds.count as f64))
}

fn train(
    split: &Split,
    base: &Options,
    recipe: Recipe,
    overrides: FitOverrides<'_>,
) -> anyhow::Result<Artifact> {
    let options = FitOptions {
        recipe,
        seed: 1,
        epochs: None,
        image_size: split.image_size,
        gnss_error: GnssError::Known(SigmaM::new(base.gnss_sigma_m)?),
        gnss_bias_sigma_m: None,
    };
    fit_with(&split.train, &options, overrides, &mut |_| ControlFlow::Continue(()))
        .map_err(|error| anyhow::anyhow!("{error}"))
}
