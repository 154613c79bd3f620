//! `sightfix simulate`

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context as _;
use clap::{Args, Subcommand};

use super::files::{self, Output};
use super::simulate_site::SimulateSite;
use crate::exchange::{self, Format};
use crate::simulation::{AirportForm, Options, Route, Scene, TargetShape, World, simulate};

/// Write a simulated world with its truth
#[derive(Args)]
#[command(subcommand_negates_reqs = true, args_conflicts_with_subcommands = true)]
pub(super) struct Simulate {
    #[command(subcommand)]
    site: Option<Site>,
    /// The scene: airport or square
    #[arg(value_name = "SCENE", required = true)]
    scene: Option<Scene>,
    /// Output file of the training rows: CSV, NDJSON, JSON or GeoJSON, by file extension, which may be followed by .gz or
    /// .zst; - is standard output
    #[arg(long, value_name = "FILE", required = true)]
    out: Option<PathBuf>,
    /// Camera, ground and lines of an airport: plain, telephoto, high-tower, slope, curved-runway, step or fisheye
    #[arg(long, value_name = "FORM", default_value_t)]
    airport_form: AirportForm,
    /// Number of training rows
    #[arg(long, value_name = "N", default_value_t = 10_000)]
    samples: usize,
    /// Output file of the test rows, as CSV: the same camera, other traverses
    #[arg(long, value_name = "FILE")]
    test_out: Option<PathBuf>,
    /// Number of test rows
    #[arg(long, value_name = "N", default_value_t = 400, requires = "test_out")]
    test_samples: usize,
    /// Route of the targets: lines, new-line (parallel to them), area (between random points) or standing
    #[arg(long, value_name = "ROUTE", default_value = "lines", value_parser = route)]
    route: Route,
    /// Route of the test targets [default: that of the training targets]
    #[arg(long, value_name = "ROUTE", value_parser = route, requires = "test_out")]
    test_route: Option<Route>,
    /// Offset of new-line to the left of the lines, m [default: that of the scene]
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    new_line_offset_m: Option<f64>,
    /// Seed of everything but the camera
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Seed of the camera's height, focal length and orientation
    #[arg(long, value_name = "N", default_value_t = 1)]
    camera_seed: u64,
    /// Number of targets, each with its own receiver; their rows are interleaved
    #[arg(long, value_name = "N", default_value_t = 1)]
    targets: usize,
    /// Number of sessions of the training rows, a day apart; the test rows are one session a week later
    #[arg(long, value_name = "N", default_value_t = 1)]
    sessions: usize,
    /// Extents of the targets, m: their outline is stretched to them [default: those of the scene]
    #[arg(long, value_name = "LENGTHxWIDTHxHEIGHT", value_parser = extents)]
    target_size_m: Option<[f64; 3]>,
    /// Place of the antenna ahead and to the left of the target's middle, m [default: that of the scene]
    #[arg(long, value_name = "AHEAD,LEFT", value_parser = antenna, allow_hyphen_values = true)]
    antenna_m: Option<[f64; 2]>,
    /// Standard deviation per axis of the receivers, m [default: that of the scene]
    #[arg(long, value_name = "S")]
    gnss_sigma_m: Option<f64>,
    /// Time constant of the receivers' error beside a white part of 0.13 m, s [default: that of the scene]
    #[arg(long, value_name = "S")]
    gnss_time_constant_s: Option<f64>,
    /// Standard deviation per axis of an additional error that each receiver keeps for a session, m
    #[arg(long, value_name = "S", default_value_t = 0.0)]
    gnss_bias_sigma_m: f64,
    /// Standard deviation of each edge of a box, px
    #[arg(long, value_name = "N", default_value_t = 1.0)]
    box_noise_px: f64,
    /// Relative radial displacement at the image's corner; negative for barrel distortion
    #[arg(long, value_name = "SHARE", default_value_t = -0.02, allow_negative_numbers = true)]
    lens_distortion: f64,
    /// Keep boxes truncated by the image border [default: depends on the scene]
    #[arg(long, value_name = "BOOL")]
    border_cuts: Option<bool>,
    /// Leave truncated boxes out of the training rows, but not out of the test rows
    #[arg(long)]
    train_without_cut_boxes: bool,
    /// Share of rows in which the target is occluded
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    occlusion: f64,
    /// Share of rows whose fix or box is an outlier
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    outliers: f64,
    /// Share of rows whose fix is wrong by --gross-fix-error-m
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    gross_fixes: f64,
    /// Size of those errors, m
    #[arg(long, value_name = "M", default_value_t = 1_000.0)]
    gross_fix_error_m: f64,
    /// Share of rows without a fix
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    gnss_gaps: f64,
    /// Mean time after which the tracker loses a target and gives it the id of another one that it lost, s
    /// [default: ids never change]
    #[arg(long, value_name = "S")]
    tracker_id_lifetime_s: Option<f64>,
}

/// Worlds of more than one camera.
#[derive(Subcommand)]
enum Site {
    Site(SimulateSite),
}

impl Simulate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        if let Some(Site::Site(command)) = self.site {
            return command.run();
        }
        let (Some(scene), Some(out)) = (self.scene, &self.out) else {
            anyhow::bail!("give the scene and --out")
        };
        let base = Options::new(scene);
        let target_shape = self.target_shape(scene);
        let options = Options {
            airport_form: self.airport_form,
            seed: self.seed,
            camera_seed: self.camera_seed,
            samples: self.samples,
            route: self.route,
            new_line_offset_m: self.new_line_offset_m,
            targets: self.targets,
            sessions: self.sessions,
            target_shape,
            gnss_sigma_m: self.gnss_sigma_m.unwrap_or(base.gnss_sigma_m),
            gnss_time_constant_s: self.gnss_time_constant_s,
            gnss_bias_sigma_m: self.gnss_bias_sigma_m,
            box_noise_px: self.box_noise_px,
            lens_distortion: self.lens_distortion,
            border_cuts: self.border_cuts.unwrap_or(base.border_cuts),
            without_cut_boxes: self.train_without_cut_boxes,
            occlusion: self.occlusion,
            outliers: self.outliers,
            gross_fixes: self.gross_fixes,
            gross_fix_error_m: self.gross_fix_error_m,
            gnss_gaps: self.gnss_gaps,
            tracker_id_lifetime_s: self.tracker_id_lifetime_s,
            ..base
        };
        check(&options)?;
        let format = files::format_of(out, None)?;
        if let Some(path) = &self.test_out {
            let is_csv = files::format_of(path, None)? == Format::Csv;
            anyhow::ensure!(
                is_csv,
                "{}: the test rows are written as CSV: the extension must be .csv",
                path.display()
            );
        }
        let mut file = Output::create(out)?;
        exchange::write_samples(&mut file, format, &simulate(&options).training_samples())?;
        file.finish().with_context(|| format!("cannot write {}", out.display()))?;
        if let Some(path) = &self.test_out {
            let test =
                Options { route: self.test_route.unwrap_or(self.route), ..options.test(self.test_samples) };
            let mut file = Output::create(path)?;
            write_test(&simulate(&test), &mut file)
                .and_then(|()| file.finish())
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }

    /// The scene's shape with the extents and the antenna that were given; `None` for neither.
    fn target_shape(&self, scene: Scene) -> Option<TargetShape> {
        let nominal = scene.nominal_shape();
        let TargetShape { length_m, width_m, height_m, antenna_ahead_m, antenna_left_m } = nominal;
        (self.target_size_m.is_some() || self.antenna_m.is_some()).then(|| {
            let [length_m, width_m, height_m] = self.target_size_m.unwrap_or([length_m, width_m, height_m]);
            let [antenna_ahead_m, antenna_left_m] =
                self.antenna_m.unwrap_or([antenna_ahead_m, antenna_left_m]);
            TargetShape { length_m, width_m, height_m, antenna_ahead_m, antenna_left_m }
        })
    }
}

/// Writes the columns of a sample file; missing boxes and fixes are empty.
fn write_test(world: &World, out: &mut impl Write) -> io::Result<()> {
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
    Ok(())
}

/// Checks the ranges of the options.
fn check(options: &Options) -> anyhow::Result<()> {
    let Options { samples, targets, sessions, gnss_sigma_m, box_noise_px, lens_distortion, .. } = options;
    anyhow::ensure!((1..=10_000_000).contains(samples), "--samples must be from 1 to 10,000,000");
    anyhow::ensure!((1..=1_000).contains(targets), "--targets must be from 1 to 1,000");
    anyhow::ensure!((1..=7).contains(sessions), "--sessions must be from 1 to 7");
    anyhow::ensure!((0.001..=1e4).contains(gnss_sigma_m), "--gnss-sigma-m must be from 0.001 to 10,000 m");
    anyhow::ensure!((0.0..=100.0).contains(box_noise_px), "--box-noise-px must be from 0 to 100");
    anyhow::ensure!((-0.3..=0.3).contains(lens_distortion), "--lens-distortion must be from -0.3 to 0.3");
    anyhow::ensure!(
        options.gnss_time_constant_s.is_none_or(|constant_s| (0.1..=1e6).contains(&constant_s)),
        "--gnss-time-constant-s must be from 0.1 to 1,000,000 s"
    );
    anyhow::ensure!(
        (0.0..=1e4).contains(&options.gnss_bias_sigma_m),
        "--gnss-bias-sigma-m must be from 0 to 10,000 m"
    );
    anyhow::ensure!(
        options.new_line_offset_m.is_none_or(|offset_m| offset_m.abs() <= 1_000.0),
        "--new-line-offset-m must be from -1,000 to 1,000 m"
    );
    anyhow::ensure!(
        (0.0..=1e7).contains(&options.gross_fix_error_m),
        "--gross-fix-error-m must be from 0 to 10,000,000 m"
    );
    anyhow::ensure!(
        options.tracker_id_lifetime_s.is_none_or(|lifetime_s| (1.0..=1e6).contains(&lifetime_s)),
        "--tracker-id-lifetime-s must be from 1 to 1,000,000 s"
    );
    for (name, share) in [
        ("occlusion", options.occlusion),
        ("outliers", options.outliers),
        ("gross-fixes", options.gross_fixes),
        ("gnss-gaps", options.gnss_gaps),
    ] {
        anyhow::ensure!((0.0..=0.95).contains(&share), "--{name} must be a share from 0 to 0.95");
    }
    options.target_shape.as_ref().map_or(Ok(()), check_shape)
}

fn check_shape(shape: &TargetShape) -> anyhow::Result<()> {
    let TargetShape { length_m, width_m, height_m, antenna_ahead_m, antenna_left_m } = *shape;
    anyhow::ensure!(
        [length_m, width_m, height_m].iter().all(|extent_m| (0.1..=500.0).contains(extent_m)),
        "--target-size-m must be from 0.1 to 500 m each way"
    );
    anyhow::ensure!(
        antenna_ahead_m.abs() <= 0.5 * length_m && antenna_left_m.abs() <= 0.5 * width_m,
        "--antenna-m must be within the target: {length_m} m long and {width_m} m wide"
    );
    Ok(())
}

fn extents(text: &str) -> Result<[f64; 3], String> {
    numbers(text, 'x').ok_or_else(|| "must be three lengths in m, such as 37x34x12".to_owned())
}

fn antenna(text: &str) -> Result<[f64; 2], String> {
    numbers(text, ',').ok_or_else(|| "must be two distances in m, such as 14,0".to_owned())
}

fn numbers<const N: usize>(text: &str, separator: char) -> Option<[f64; N]> {
    let numbers: Option<Vec<f64>> = text.split(separator).map(|part| part.trim().parse().ok()).collect();
    numbers?.try_into().ok()
}

fn route(name: &str) -> Result<Route, String> {
    match name {
        "lines" => Ok(Route::Lines),
        "new-line" => Ok(Route::NewLine),
        "area" => Ok(Route::Area),
        "standing" => Ok(Route::Standing),
        _ => Err("must be lines, new-line, area or standing".to_owned()),
    }
}
