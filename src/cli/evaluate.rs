//! `sightfix evaluate`

mod paper;

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;

use super::import::image_size;
use super::progress::Progress;
use super::{format_of, open_file};
use crate::clock::{Clock, process_cpu_s as cpu_s};
use crate::domain::{ImageSize, Recipe, Sample, SigmaM, TargetId, TimeBounds};
use crate::evaluation::{EvaluateOptions, Evaluation, Method, TestRow, Truth, evaluate, plots};
use crate::exchange::{self, ObservedRow, RowRules};
use crate::geo::Position;

/// Most seeds of one evaluation.
const MOST_SEEDS: u64 = 100;

/// Try methods side by side on a test file, without a server
#[derive(Args)]
pub(super) struct Evaluate {
    /// Rows to learn from, as CSV, NDJSON or JSON
    #[arg(long, value_name = "FILE", required_unless_present = "paper")]
    train: Option<PathBuf>,
    /// Rows to be told and judged; boxes and fixes may be empty
    #[arg(long, value_name = "FILE", required_unless_present = "paper")]
    test: Option<PathBuf>,
    /// The truth is this point; else the columns truth_longitude and truth_latitude
    #[arg(long, value_name = "LON,LAT", value_parser = point, allow_negative_numbers = true)]
    truth_point: Option<Position>,
    /// The truth is the nearest point of the lines in this GeoJSON file
    #[arg(long, value_name = "FILE", conflicts_with = "truth_point")]
    truth_line: Option<PathBuf>,
    /// Size of the image
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = image_size)]
    image_size: Option<ImageSize>,
    /// Standard deviation per axis of the receiver, m; else estimated
    #[arg(long, value_name = "S", value_parser = sigma)]
    gnss_sigma_m: Option<SigmaM>,
    /// Methods with commas between, or all
    #[arg(long, value_name = "LIST", default_value = "all", value_parser = methods)]
    methods: Methods,
    /// Seeds from 1 to this, their spread beside the mean; with --paper, simulated worlds of each case
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=MOST_SEEDS))]
    seeds: u64,
    /// Test boxes grow to the upper left by this, px
    #[arg(long, value_name = "N", default_value_t = 0.0)]
    box_shift_px: f64,
    /// Where the figures go, as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Folder where pictures go, as SVG
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// Run the paper's experiments on simulated worlds instead, and print the page of figures
    #[arg(long, conflicts_with_all = ["train", "test"])]
    paper: bool,
    /// Seed of the first simulated world, for --paper; 1000 to 1099 were looked at during development
    #[arg(long, value_name = "N", requires = "paper", default_value_t = 2001)]
    first_world: u64,
    /// Folder of the real recordings, for --paper
    #[arg(long, value_name = "DIR", requires = "paper")]
    shared_data: Option<PathBuf>,
    /// Where the page goes, for --paper
    #[arg(long, value_name = "FILE", requires = "paper", default_value = "docs/accuracy.md")]
    out: PathBuf,
}

/// A list that clap takes for one value.
#[derive(Clone)]
struct Methods(Vec<Method>);

impl Evaluate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        if self.paper {
            return paper::run(self.shared_data.as_deref(), &self.out, self.first_world, self.seeds.max(3));
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
            box_shift_px: self.box_shift_px,
            cpu_s,
        };
        let evaluation = evaluate_aloud(&train, &test, &truth, &options)?;
        print!("{}", evaluation.report.table());
        if let Some(path) = &self.json {
            std::fs::write(path, evaluation.report.to_json()?)
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
        if let Some(folder) = &self.plots {
            std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
            for (name, picture) in plots(&evaluation, &test, &truth) {
                std::fs::write(folder.join(name), picture)?;
            }
        }
        anyhow::ensure!(!evaluation.report.methods.is_empty(), "no method could run");
        Ok(())
    }

    fn truth(&self, test: &[TestRow]) -> anyhow::Result<Truth> {
        if let Some(point) = self.truth_point {
            return Ok(Truth::Point(point));
        }
        if let Some(path) = &self.truth_line {
            let text =
                std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
            return Ok(Truth::from_geojson(&text)?);
        }
        anyhow::ensure!(
            test.iter().any(|row| row.truth.is_some()),
            "where is the truth? Give columns truth_longitude and truth_latitude, --truth-point or --truth-line"
        );
        Ok(Truth::Columns)
    }
}

/// What tracks stand on, and what a camera is learnt by if nothing is said.
const DEFAULT_RECIPE: Recipe = Recipe::Auto;

/// Evaluates and shows on standard error what is being done.
fn evaluate_aloud(
    train: &[Sample],
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

/// The rows that have box and fix; the others teach nothing and are counted.
fn read_train(path: &Path, image_size: Option<ImageSize>) -> anyhow::Result<Vec<Sample>> {
    let rows = read(path, image_size)?;
    let all = rows.len();
    let samples: Vec<Sample> = rows.into_iter().filter_map(sample).collect();
    if samples.len() < all {
        eprintln!("{}: {} rows without box or fix are left out", path.display(), all - samples.len());
    }
    Ok(samples)
}

fn sample(row: ObservedRow) -> Option<Sample> {
    let ObservedRow { observation, class, score, truth } = row;
    Some(Sample {
        time: observation.time,
        target_id: observation.target_id.or_else(|| TargetId::new("target").ok())?,
        bounding_box: observation.bounding_box?,
        fix: observation.fix?,
        class,
        score,
        truth,
    })
}

fn read_test(path: &Path, image_size: Option<ImageSize>) -> anyhow::Result<Vec<TestRow>> {
    let test_row = |row: ObservedRow| TestRow { observation: row.observation, truth: row.truth };
    Ok(read(path, image_size)?.into_iter().map(test_row).collect())
}

/// All rows but those at fault, which are named on standard error.
fn read(path: &Path, image_size: Option<ImageSize>) -> anyhow::Result<Vec<ObservedRow>> {
    let rules = RowRules { time_bounds: TimeBounds::at(Clock::system().now()), image_size };
    let mut rows = Vec::new();
    let mut faults = 0_u64;
    for row in exchange::read_observations(open_file(path)?, format_of(path)?, &rules)? {
        match row.with_context(|| format!("cannot read {}", path.display()))? {
            Ok(row) => rows.push(row),
            Err(fault) => {
                faults += 1;
                if faults <= 20 {
                    eprintln!("{}: line {}: {}: {}", path.display(), fault.line, fault.field, fault.reason);
                }
            }
        }
    }
    if faults > 20 {
        eprintln!("{}: and {} rows more were left out", path.display(), faults - 20);
    }
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
