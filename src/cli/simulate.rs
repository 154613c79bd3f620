//! `sightfix simulate`

use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;

use crate::exchange::{self, Format};
use crate::simulation::{Options, Route, Scene, World, simulate};

/// Write a simulated world with its truth, as CSV
#[derive(Args)]
pub(super) struct Simulate {
    /// The scene: airport or square
    #[arg(value_name = "SCENE")]
    scene: Scene,
    /// Output file of the training rows
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Number of training rows
    #[arg(long, value_name = "N", default_value_t = 10_000)]
    samples: usize,
    /// Output file of the test rows: the same camera, other traverses
    #[arg(long, value_name = "FILE")]
    test_out: Option<PathBuf>,
    /// Number of test rows
    #[arg(long, value_name = "N", default_value_t = 400, requires = "test_out")]
    test_samples: usize,
    /// Route of the test targets: lines, new-line or standing
    #[arg(long, value_name = "ROUTE", default_value = "lines", value_parser = route, requires = "test_out")]
    test_route: Route,
    /// Seed of everything but the camera
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Seed of the camera's height, focal length and orientation
    #[arg(long, value_name = "N", default_value_t = 1)]
    camera_seed: u64,
    /// Number of targets; their rows are interleaved
    #[arg(long, value_name = "N", default_value_t = 1)]
    targets: usize,
    /// Standard deviation per axis of the receivers, m [default: that of the scene]
    #[arg(long, value_name = "S")]
    gnss_sigma_m: Option<f64>,
    /// Standard deviation of each edge of a box, px
    #[arg(long, value_name = "N", default_value_t = 1.0)]
    box_noise_px: f64,
    /// Relative radial displacement at the image's corner; negative for barrel distortion
    #[arg(long, value_name = "SHARE", default_value_t = -0.02, allow_negative_numbers = true)]
    lens_distortion: f64,
    /// Keep boxes truncated by the image border [default: depends on the scene]
    #[arg(long, value_name = "BOOL")]
    border_cuts: Option<bool>,
    /// Share of rows in which the target is occluded
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    occlusion: f64,
    /// Share of rows whose fix or box is an outlier
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    outliers: f64,
    /// Share of rows without a fix
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    gnss_gaps: f64,
}

impl Simulate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let base = Options::new(self.scene);
        let options = Options {
            seed: self.seed,
            camera_seed: self.camera_seed,
            samples: self.samples,
            targets: self.targets,
            gnss_sigma_m: self.gnss_sigma_m.unwrap_or(base.gnss_sigma_m),
            box_noise_px: self.box_noise_px,
            lens_distortion: self.lens_distortion,
            border_cuts: self.border_cuts.unwrap_or(base.border_cuts),
            occlusion: self.occlusion,
            outliers: self.outliers,
            gnss_gaps: self.gnss_gaps,
            ..base
        };
        check(&options)?;
        let out = create(&self.out)?;
        exchange::write_samples(out, Format::Csv, &simulate(&options).training_samples())?;
        if let Some(path) = &self.test_out {
            let test = Options { route: self.test_route, ..options.test(self.test_samples) };
            write_test(&simulate(&test), create(path)?)?;
        }
        Ok(())
    }
}

fn create(path: &Path) -> anyhow::Result<BufWriter<File>> {
    let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(BufWriter::new(file))
}

/// Writes the columns of a sample file; missing boxes and fixes are empty.
fn write_test(world: &World, mut out: impl io::Write) -> io::Result<()> {
    let columns =
        "time,target_id,left,top,width,height,longitude,latitude,class,truth_longitude,truth_latitude";
    writeln!(out, "{columns}")?;
    for row in &world.rows {
        write!(out, "{},{}", row.time, row.target_id)?;
        match row.bounding_box {
            Some(bounding_box) => {
                bounding_box.sides_px().iter().try_for_each(|side_px| write!(out, ",{side_px}"))?
            }
            None => write!(out, ",,,,")?,
        }
        match row.fix.map(|fix| fix.position) {
            Some(fix) => write!(out, ",{:.8},{:.8}", fix.longitude_deg(), fix.latitude_deg())?,
            None => write!(out, ",,")?,
        }
        writeln!(out, ",{},{:.8},{:.8}", row.class, row.truth.longitude_deg(), row.truth.latitude_deg())?;
    }
    out.flush()
}

/// Checks the ranges of the options.
fn check(options: &Options) -> anyhow::Result<()> {
    let Options { samples, targets, gnss_sigma_m, box_noise_px, lens_distortion, .. } = options;
    anyhow::ensure!((1..=10_000_000).contains(samples), "--samples must be from 1 to 10,000,000");
    anyhow::ensure!((1..=1_000).contains(targets), "--targets must be from 1 to 1,000");
    anyhow::ensure!((0.001..=1e4).contains(gnss_sigma_m), "--gnss-sigma-m must be from 0.001 to 10,000 m");
    anyhow::ensure!((0.0..=100.0).contains(box_noise_px), "--box-noise-px must be from 0 to 100");
    anyhow::ensure!((-0.3..=0.3).contains(lens_distortion), "--lens-distortion must be from -0.3 to 0.3");
    for (name, share) in
        [("occlusion", options.occlusion), ("outliers", options.outliers), ("gnss-gaps", options.gnss_gaps)]
    {
        anyhow::ensure!((0.0..=0.95).contains(&share), "--{name} must be a share from 0 to 0.95");
    }
    Ok(())
}

fn route(name: &str) -> Result<Route, String> {
    match name {
        "lines" => Ok(Route::Lines),
        "new-line" => Ok(Route::NewLine),
        "standing" => Ok(Route::Standing),
        _ => Err("must be lines, new-line or standing".to_owned()),
    }
}
