//! The experiments of the paper, and further ones of this project, as pages of results: docs/explanation/accuracy.md with
//! its pictures, and docs/explanation/accuracy-tables.md with its figures.
//!
//! All models are fitted on training rows with the recipes unchanged; nothing is selected by test
//! results.

mod ablations;
mod cases;
mod marks;
mod page;
mod recorded;
mod scores;
mod simulated;
mod splits;
mod tables;
mod walks;

use crate::domain::{Detection, ImageSize, Sample};
use crate::model::FitInput;
use crate::simulation::Scene;
use crate::{EvaluateOptions, Evaluation, TestRow, Truth};
use cases::Experiment;
use page::{Made, Picture};
use scores::CaseScore;
use walks::WalkCurves;

pub use simulated::Worlds;

/// A recording of a real camera with a surveyed line as ground truth.
#[derive(Clone)]
pub struct RealRecording {
    /// Its samples, in order of time.
    pub samples: Vec<Sample>,
    /// The surveyed line.
    pub truth: Truth,
}

/// A real camera's training rows, and test rows of other targets with the truth.
#[derive(Clone)]
pub struct RealCamera {
    /// Name in titles.
    pub name: String,
    /// Boxes and fixes of targets with a receiver.
    pub train: Vec<Sample>,
    /// Boxes of these targets at other instants.
    pub unpaired: Vec<Detection>,
    /// Boxes of the other targets.
    pub test: Vec<TestRow>,
    /// Size of the image.
    pub image_size: Option<ImageSize>,
}

/// The recorded data, as far as they are available.
#[derive(Default)]
pub struct Recordings {
    /// One person on a square.
    pub square: Option<RealRecording>,
    /// People on a plaza, one entry per camera.
    pub plaza: Vec<RealCamera>,
}

impl Recordings {
    fn is_empty(&self) -> bool {
        self.square.is_none() && self.plaza.is_empty()
    }
}

/// A file of the results.
pub struct Document {
    /// Path relative to the folder of the page.
    pub path: String,
    /// The text of the file.
    pub text: String,
}

/// Runs evaluations and shows the progress.
pub trait Runner {
    /// Evaluates methods on training and test rows.
    ///
    /// # Errors
    /// The evaluation's own.
    fn evaluate(
        &mut self,
        train: FitInput<'_>,
        test: &[TestRow],
        truth: &Truth,
        options: &EvaluateOptions,
    ) -> anyhow::Result<Evaluation>;

    /// Reports the experiment that begins.
    fn begin(&mut self, experiment: &str);

    /// The clock that all times are taken from: CPU time of the process, s.
    fn cpu_s(&self) -> fn() -> f64;
}

/// Runs all experiments and returns the page, its pictures and its tables; `stem` is the page's file name
/// without extension. The page is the first of the documents.
///
/// # Errors
/// An evaluation or a fit that fails.
pub fn run(
    worlds: Worlds,
    recordings: &Recordings,
    stem: &str,
    runner: &mut dyn Runner,
) -> anyhow::Result<Vec<Document>> {
    let cpu_s = runner.cpu_s();
    let started_s = cpu_s();
    let mut scores: Vec<CaseScore> = Vec::new();
    let experiments = experiments(worlds, recordings)?;
    let count = experiments.len();
    for (number, experiment) in experiments.into_iter().enumerate() {
        let title = experiment.cases.first().map_or("", |case| case.title.as_str());
        runner.begin(&format!("experiment {} of {count}: {}: {title}", number + 1, experiment.group));
        scores.extend(scores::evaluate(experiment, runner)?);
    }
    let mut curves: Vec<WalkCurves> = Vec::new();
    for &scene in Scene::ALL {
        runner.begin(&format!("error against the number of walks: {scene}"));
        curves.push(WalkCurves::of(scene, worlds, runner)?);
    }
    let command = command(worlds, recordings);
    let pictures = page::pictures(&scores, &curves);
    let mut tables = tables::tables(stem, &command, &scores);
    ablations::tables(&mut tables, worlds, runner)?;
    let made = Made { worlds, command, cpu_s: cpu_s() - started_s };
    let page = page::page(stem, &made, &scores, &curves, &pictures);
    let mut documents = vec![
        Document { path: format!("{stem}.md"), text: page },
        Document { path: format!("{stem}-tables.md"), text: tables },
    ];
    let picture = |Picture { name, svg, .. }| Document { path: format!("{stem}/{name}.svg"), text: svg };
    documents.extend(pictures.into_iter().map(picture));
    Ok(documents)
}

fn experiments(worlds: Worlds, recordings: &Recordings) -> anyhow::Result<Vec<Experiment>> {
    let mut all = simulated::airport(worlds)?;
    all.extend(simulated::square(worlds)?);
    all.extend(simulated::few_traverses(worlds)?);
    if let Some(recording) = &recordings.square {
        all.extend(recorded::real_square(recording)?);
    }
    all.extend(recorded::plaza(&recordings.plaza)?);
    all.extend(simulated::training_seeds(worlds)?);
    Ok(all)
}

fn command(Worlds { first, count }: Worlds, recordings: &Recordings) -> String {
    let shared_data = if recordings.is_empty() { "" } else { " --shared-data DIR" };
    format!("sightfix evaluate --paper --seeds {count} --first-world {first}{shared_data}")
}

#[cfg(test)]
mod tests;
