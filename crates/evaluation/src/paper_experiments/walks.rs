//! The curve of error against the number of walks: how long to walk before a recipe is of use.

use std::collections::BTreeMap;

use super::Runner;
use super::simulated::{Worlds, walks_of};
use super::splits::{Split, TestSet, traverses};
use crate::axis::{Axes, AxisSpec};
use crate::chart::{Series, Shape, chart};
use crate::domain::{Recipe, Sample, SigmaM};
use crate::simulation::Scene;
use crate::{ErrorMetrics, EvaluateOptions, Method, Truth};

/// Numbers of walks.
pub(super) const WALKS: [usize; 6] = [1, 2, 3, 5, 10, 20];
/// Every recipe on the box alone, and the baselines.
const METHODS: &str = "homography.denied,dnn.denied,paper.denied,hybrid.denied,projective.denied,\
                       gaussian_process.denied,auto.denied";
/// The method whose coverage the table has.
pub(super) const DEFAULT: &str = "auto.denied";

/// The curves of one scene.
pub(super) struct WalkCurves {
    pub(super) scene: Scene,
    pub(super) worlds: usize,
    /// Training rows of the first world, per number of walks.
    pub(super) rows: Vec<usize>,
    /// Figures by method, one per number of walks; `None` where the method could not run on every world.
    pub(super) methods: Vec<(String, Vec<Option<ErrorMetrics>>)>,
}

impl WalkCurves {
    /// Fits every recipe to the first walks of every world.
    pub(super) fn of(scene: Scene, worlds: Worlds, runner: &mut dyn Runner) -> anyhow::Result<Self> {
        let methods = Method::list(METHODS)?;
        let mut figures: BTreeMap<(String, usize), Vec<ErrorMetrics>> = BTreeMap::new();
        let mut rows = Vec::new();
        let options = walks_of(scene, worlds);
        for world in &options {
            let split = Split::of_world(world, &[TestSet::new(400)])?;
            let evaluate_options = EvaluateOptions {
                methods: methods.clone(),
                default_recipe: Recipe::Auto,
                seeds: 1,
                epochs: None,
                image_size: split.image_size,
                gnss_sigma: Some(SigmaM::new(world.gnss_sigma_m)?),
                gnss_bias_sigma: None,
                box_shift_px: 0.0,
                cpu_s: runner.cpu_s(),
            };
            for (at, &count) in WALKS.iter().enumerate() {
                let train: Vec<Sample> = traverses(&split.train).take(count).flatten().cloned().collect();
                if rows.len() == at {
                    rows.push(train.len());
                }
                let evaluation =
                    runner.evaluate((&train).into(), &split.tests[0], &Truth::Columns, &evaluate_options)?;
                for (name, report) in evaluation.report.methods {
                    figures.entry((name, at)).or_default().push(report.metrics);
                }
            }
        }
        let curve = |method: &Method| {
            let name = method.to_string();
            let at = |at| {
                let found = figures.get(&(name.clone(), at))?;
                if found.len() == options.len() { ErrorMetrics::over_seeds(found) } else { None }
            };
            let curve = (0..WALKS.len()).map(at).collect();
            (name, curve)
        };
        Ok(Self { scene, worlds: options.len(), rows, methods: methods.iter().map(curve).collect() })
    }

    /// The curves as a picture.
    pub(super) fn picture(&self) -> String {
        let series = |(number, (name, figures)): (usize, &(String, Vec<Option<ErrorMetrics>>))| {
            let points = WALKS.iter().zip(figures);
            let points = points.filter_map(|(&walks, one)| Some([walks as f64, one.as_ref()?.mean_m]));
            Series::new(name.trim_end_matches(".denied"), number, points.collect(), Shape::Line)
        };
        let series: Vec<Series> = self.methods.iter().enumerate().map(series).collect();
        let errors_m = series.iter().flat_map(Series::points).map(|point| point[1]);
        let axes = Axes {
            across: AxisSpec::logarithmic("walks in training", WALKS.iter().map(|&walks| walks as f64)),
            upward: AxisSpec::logarithmic("mean error on the box alone, m", errors_m),
            equal_scale: false,
        };
        chart(&format!("How long to walk: {}, means of {} worlds", self.scene, self.worlds), &axes, &series)
    }
}
