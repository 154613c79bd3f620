//! `sightfix evaluate`

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;

use super::evaluate_site::{self, Draws};
use super::files::{self, write_text};
use super::import::{gnss_bias_sigma, image_size};
use super::output::{print_line, print_note};
use super::progress::Progress;
use super::recordings;
use super::rejected_rows::RejectedRows;
use crate::clock::{Clock, process_cpu_s};
use crate::domain::{
    Detection, GnssBiasSigma, ImageSize, Recipe, Sample, SigmaM, StoredSample, TargetId, TimeBounds,
};
use crate::evaluation::{
    EvaluateOptions, Evaluation, Method, TestRow, Truth, evaluate, plots, truth_from_geojson,
};
use crate::exchange::{self, ObservedRow, RowRules};
use crate::geo::Position;
use crate::model::FitInput;
use crate::paper_experiments::{self, RealRecording, Recordings, Worlds};

/// Largest number of seeds of one evaluation.
const MAX_SEEDS: u64 = 100;
/// Largest seed of the first draw; the known models have the seeds from a million on.
const MAX_FIRST_DRAW: u64 = 900_000;

/// Compare methods on a test file, without a server
#[derive(Args)]
pub(super) struct Evaluate {
    /// Training rows, as CSV, NDJSON or JSON, by file extension, which may be followed by .gz or .zst; - is standard input; boxes without a fix serve the geometry of the camera
    #[arg(long, value_name = "FILE", required_unless_present_any = ["paper", "site"])]
    train: Option<PathBuf>,
    /// Test rows; boxes and fixes may be empty
    #[arg(long, value_name = "FILE", required_unless_present_any = ["paper", "site"])]
    test: Option<PathBuf>,
    /// The true position of all rows [default: the columns truth_longitude and truth_latitude]
    #[arg(long, value_name = "LON,LAT", value_parser = point, allow_hyphen_values = true)]
    truth_point: Option<Position>,
    /// The true positions are on the lines of this GeoJSON file
    #[arg(long, value_name = "FILE", conflicts_with = "truth_point")]
    truth_line: Option<PathBuf>,
    /// Size of the image
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = image_size)]
    image_size: Option<ImageSize>,
    /// Standard deviation per axis of the receiver, m [default: estimated]
    #[arg(long, value_name = "S", value_parser = sigma)]
    gnss_sigma_m: Option<SigmaM>,
    /// Standard deviation per axis of the bias that all fixes have in common, m [default: the model's own
    /// prior]
    #[arg(long, value_name = "S", value_parser = gnss_bias_sigma)]
    gnss_bias_sigma_m: Option<GnssBiasSigma>,
    /// Comma-separated methods, or all
    #[arg(long, value_name = "LIST", default_value = "all", value_parser = methods)]
    methods: Methods,
    /// Number of training seeds; with --paper, number of simulated worlds per case [default: 1, or 3 with --paper]
    #[arg(long, value_name = "N", default_value_t = 1, default_value_if("paper", "true", "3"), hide_default_value = true, value_parser = clap::value_parser!(u64).range(1..=MAX_SEEDS))]
    seeds: u64,
    /// Enlarge the test boxes to the upper left by this, px
    #[arg(long, value_name = "N", default_value_t = 0.0)]
    box_shift_px: f64,
    /// Write the results as JSON; - prints them instead of the table
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write plots to this folder, as SVG
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// Run the experiments of the paper on simulated worlds instead, and print the page of results; its pictures
    /// and its long tables are written beside it
    #[arg(long, conflicts_with_all = ["train", "test"])]
    paper: bool,
    /// Seed of the first simulated world, for --paper; 1000 to 1099 were used during development
    #[arg(long, value_name = "N", requires = "paper", default_value_t = 2001)]
    first_world: u64,
    /// Folder of the real recordings, with the folders square and plaza, for --paper
    #[arg(long, value_name = "DIR", requires = "paper")]
    shared_data: Option<PathBuf>,
    /// Evaluate the world tracks of a site instead: a folder with detections_<CAMERA>.csv per camera, fixes.csv,
    /// identity.csv and truth.csv, such as `simulate site` writes
    #[arg(long, value_name = "DIR", conflicts_with_all = ["train", "test", "paper"])]
    site: Option<PathBuf>,
    /// Number of times that carriers, fixes and boxes are drawn again about the true positions, for --site [default: the
    /// recording as it is]
    #[arg(long, value_name = "N", requires = "site", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=MAX_SEEDS))]
    draws: u64,
    /// The same of the errors of the fixes alone
    #[arg(long, value_name = "N", requires = "site", conflicts_with = "draws", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=MAX_SEEDS))]
    redraws: u64,
    /// Seed of the first draw, for --site
    #[arg(long, alias = "first-redraw", value_name = "N", requires = "site", default_value_t = 1, value_parser = clap::value_parser!(u64).range(0..=MAX_FIRST_DRAW))]
    first_draw: u64,
    /// Number of known points of each camera that take part in the training, for --site: true places near the corners of the
    /// image, with an error of 0.5 m per axis
    #[arg(long, value_name = "N", requires = "site", conflicts_with = "matching", default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=4))]
    known_points: u8,
    /// Evaluate how boxes are matched with receivers instead of the world tracks, for --site: with a model that is known
    #[arg(long = "match", requires = "draws")]
    matching: bool,
    /// The same with nothing known, too, which takes minutes for each draw
    #[arg(long, requires = "matching")]
    without_model: bool,
    /// Write the page to this file, for --paper
    #[arg(long, value_name = "FILE", requires = "paper", default_value = "docs/explanation/accuracy.md")]
    out: PathBuf,
}

/// A list as a single value of clap.
#[derive(Clone)]
struct Methods(Vec<Method>);

impl Evaluate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        if self.paper {
            return self.write_paper_page();
        }
        if let Some(folder) = &self.site {
            let only_errors = self.redraws > 0;
            let count = if only_errors { self.redraws } else { self.draws };
            let draws = Draws { count, first_seed: self.first_draw, only_errors };
            let report = if self.matching {
                evaluate_site::evaluate_matching(folder, self.image_size, &draws, self.without_model)?
                    .to_json()?
            } else {
                evaluate_site::evaluate(folder, self.image_size, &draws, usize::from(self.known_points))?
                    .to_json()?
            };
            return self.json.as_ref().map_or(Ok(()), |path| write_text(path, &report));
        }
        let (Some(train), Some(test)) = (&self.train, &self.test) else {
            anyhow::bail!("give --train and --test")
        };
        anyhow::ensure!(
            (0.0..=10_000.0).contains(&self.box_shift_px),
            "--box-shift-px must be from 0 to 10,000"
        );
        let train = read_train(train, self.image_size)?;
        let test = read_test(test, self.image_size)?;
        anyhow::ensure!(!test.is_empty(), "the test file has no usable row");
        let truth = self.truth(&test)?;
        let options = EvaluateOptions {
            methods: self.methods.0,
            default_recipe: DEFAULT_RECIPE,
            seeds: self.seeds,
            epochs: None,
            image_size: self.image_size,
            gnss_sigma: self.gnss_sigma_m,
            gnss_bias_sigma: self.gnss_bias_sigma_m,
            box_shift_px: self.box_shift_px,
            cpu_s: process_cpu_s,
        };
        let input = FitInput { samples: &train.samples, unpaired: &train.unpaired, known_points: &[] };
        let evaluation = evaluate_with_progress(input, &test, &truth, &options)?;
        if !self.json.as_deref().is_some_and(files::is_standard) {
            print_line(&format_args!("{}", evaluation.report.table().trim_end()))?;
        }
        if let Some(path) = &self.json {
            write_text(path, &evaluation.report.to_json()?)?;
        }
        if let Some(folder) = &self.plots {
            for (name, picture) in plots(&evaluation, &test, &truth) {
                write_text(&folder.join(name), &picture)?;
            }
        }
        anyhow::ensure!(!evaluation.report.methods.is_empty(), "no method could run");
        Ok(())
    }

    /// Runs the experiments of the paper; writes the page and prints it.
    fn write_paper_page(&self) -> anyhow::Result<()> {
        let recordings = match &self.shared_data {
            Some(folder) => Recordings {
                square: Some(RealRecording {
                    samples: read_train(&folder.join("square/training.csv"), None)?.samples,
                    truth: truth_line(&folder.join("square/truth_line.geojson"))?,
                }),
                plaza: recordings::plaza(&folder.join("plaza"))?,
            },
            None => Recordings::default(),
        };
        let stem = self.out.file_stem().and_then(|stem| stem.to_str()).context("--out must name a file")?;
        let folder = self.out.parent().unwrap_or(Path::new(""));
        let worlds = Worlds { first: self.first_world, count: self.seeds };
        let documents = paper_experiments::run(worlds, &recordings, stem, &mut PaperRunner)?;
        for document in &documents {
            write_text(&folder.join(&document.path), &document.text)?;
        }
        print_line(&format_args!("{}", documents.first().map_or("", |page| page.text.trim_end())))?;
        Ok(())
    }

    fn truth(&self, test: &[TestRow]) -> anyhow::Result<Truth> {
        if let Some(point) = self.truth_point {
            return Ok(Truth::Point(point));
        }
        if let Some(path) = &self.truth_line {
            return truth_line(path);
        }
        anyhow::ensure!(
            test.iter().any(|row| row.truth.is_some()),
            "the truth is missing: give columns truth_longitude and truth_latitude, --truth-point or --truth-line"
        );
        Ok(Truth::Columns)
    }
}

/// Evaluates the experiments of the paper, with progress on standard error.
struct PaperRunner;

impl paper_experiments::Runner for PaperRunner {
    fn evaluate(
        &mut self,
        train: FitInput<'_>,
        test: &[TestRow],
        truth: &Truth,
        options: &EvaluateOptions,
    ) -> anyhow::Result<Evaluation> {
        evaluate_with_progress(train, test, truth, options)
    }

    fn begin(&mut self, experiment: &str) {
        print_note(format_args!("{experiment}"));
    }

    fn cpu_s(&self) -> fn() -> f64 {
        process_cpu_s
    }
}

fn truth_line(path: &Path) -> anyhow::Result<Truth> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(truth_from_geojson(&text)?)
}

/// The recipe of tracks.
const DEFAULT_RECIPE: Recipe = Recipe::Auto;

/// Evaluates and shows the progress on standard error.
fn evaluate_with_progress(
    train: FitInput<'_>,
    test: &[TestRow],
    truth: &Truth,
    options: &EvaluateOptions,
) -> anyhow::Result<Evaluation> {
    let mut progress = Progress::new("{spinner} {pos}/{len} {msg}");
    let evaluation = evaluate(train, test, truth, options, &mut |step| {
        progress.set(step.done.into(), step.planned.into(), step.phase);
        ControlFlow::Continue(())
    });
    progress.finish();
    Ok(evaluation?)
}

/// The training rows of a file.
struct TrainingFile {
    samples: Vec<Sample>,
    unpaired: Vec<Detection>,
}

/// The rows with a box, by whether they have a fix; the number of others is reported on standard error.
fn read_train(path: &Path, image_size: Option<ImageSize>) -> anyhow::Result<TrainingFile> {
    let mut file = TrainingFile { samples: Vec::new(), unpaired: Vec::new() };
    let mut ignored = 0_u64;
    for row in read(path, image_size)? {
        match stored_sample(row) {
            Some(sample) if sample.fix.is_some() => file.samples.extend(sample.with_fix()),
            Some(sample) => file.unpaired.push(sample.into()),
            None => ignored += 1,
        }
    }
    if ignored > 0 {
        print_note(format_args!("{}: {ignored} rows without a box are ignored", path.display()));
    }
    if !file.unpaired.is_empty() {
        print_note(format_args!("{}: {} rows are boxes without a fix", path.display(), file.unpaired.len()));
    }
    Ok(file)
}

fn stored_sample(row: ObservedRow) -> Option<StoredSample> {
    let ObservedRow { observation, class, score, truth } = row;
    Some(StoredSample {
        time: observation.time(),
        target_id: observation.target_id().cloned().or_else(|| TargetId::new("target").ok())?,
        bounding_box: observation.bounding_box()?,
        fix: observation.fix(),
        class,
        score,
        truth,
    })
}

fn read_test(path: &Path, image_size: Option<ImageSize>) -> anyhow::Result<Vec<TestRow>> {
    let test_row = |row: ObservedRow| TestRow { observation: row.observation, truth: row.truth };
    Ok(read(path, image_size)?.into_iter().map(test_row).collect())
}

/// All valid rows; the others are reported on standard error.
fn read(path: &Path, image_size: Option<ImageSize>) -> anyhow::Result<Vec<ObservedRow>> {
    let rules = RowRules { time_bounds: TimeBounds::at(Clock::system().now()), image_size };
    let mut rows = Vec::new();
    let mut rejected = RejectedRows::default();
    for row in exchange::read_observations(files::open_input(path)?, files::format_of(path, None)?, &rules)? {
        match row.with_context(|| format!("cannot read {}", path.display()))? {
            Ok(row) => rows.push(row),
            Err(row) => rejected.push(row),
        }
    }
    rejected.print(&format!("{}: ", path.display()));
    Ok(rows)
}

fn methods(text: &str) -> Result<Methods, String> {
    Method::list(text).map(Methods).map_err(|error| error.to_string())
}

fn sigma(text: &str) -> Result<SigmaM, String> {
    let metres = text.parse().map_err(|_| "must be a number of metres".to_owned())?;
    SigmaM::new(metres).map_err(|error| error.to_string())
}

fn point(text: &str) -> Result<Position, String> {
    let pair = text.split_once(',').and_then(|(longitude, latitude)| {
        Some((longitude.trim().parse().ok()?, latitude.trim().parse().ok()?))
    });
    let (longitude_deg, latitude_deg) =
        pair.ok_or("must be LON,LAT in degrees, such as 103.98678,30.62801")?;
    Position::new(longitude_deg, latitude_deg).map_err(|error| error.to_string())
}
