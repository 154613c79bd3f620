//! `sightfix import`

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use clap::Args;

use super::exit_code::TooManyRejected;
use super::layout::LayoutFlags;
use super::progress::Progress;
use super::rejected_rows;
use super::summary::{Summary, SummaryFlags};
use super::{DataFolder, MissingData, camera_id, files, open_app, runtime, site_id, target_id};
use crate::app::{App, ImportOptions, ImportReport};
use crate::domain::{
    CameraId, Error, ErrorKind, GnssBiasSigma, ImageSize, NewCamera, NewSite, OnConflict, SiteId, TargetId,
};
use crate::exchange::{CsvLayout, Format};
use crate::geo::Position;

/// Import samples from a file into a camera
#[derive(Args)]
pub(super) struct Import {
    /// Samples as CSV, NDJSON or JSON, by file extension, which may be followed by .gz or .zst; - is standard input;
    /// longitude and latitude may be empty together: a box
    /// without a fix
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The camera's id
    #[arg(long, value_name = "ID", value_parser = camera_id)]
    camera: CameraId,
    /// Create the camera if it does not exist
    #[arg(long)]
    create: bool,
    /// Size of the camera's image, for --create
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = image_size, requires = "create")]
    image_size: Option<ImageSize>,
    /// Rough position of the camera itself, degrees, for --create: fixes that are far from it are told
    #[arg(
        long, value_name = "LONGITUDE,LATITUDE", value_parser = location, requires = "create", allow_hyphen_values = true
    )]
    location: Option<Position>,
    /// Standard deviation per axis of the bias that all fixes have in common, m, for --create [default: the
    /// model's own prior]
    #[arg(long, value_name = "S", value_parser = gnss_bias_sigma, requires = "create")]
    gnss_bias_sigma_m: Option<GnssBiasSigma>,
    /// Site of the camera, for --create; it is created, too, if it does not exist
    #[arg(long, value_name = "ID", value_parser = site_id, requires = "create")]
    site: Option<SiteId>,
    /// Let each sample replace a stored one of the same target and time
    #[arg(long)]
    replace: bool,
    /// The target of rows that name none
    #[arg(long, value_name = "ID", value_parser = target_id)]
    target_id: Option<TargetId>,
    /// Format of the file if its ending does not name it: csv, ndjson or json [default: csv for -]
    #[arg(long, value_name = "FORMAT", value_parser = files::format)]
    format: Option<Format>,
    /// Largest share of rejected rows that counts as success; with more, the accepted rows stay and the exit code is 5
    #[arg(long, value_name = "SHARE", default_value_t = 0.05, value_parser = share)]
    max_rejected: f64,
    #[command(flatten)]
    summary: SummaryFlags,
    #[command(flatten)]
    layout: LayoutFlags,
    #[command(flatten)]
    folder: DataFolder,
}

impl Import {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let settings = self.folder.settings(file)?;
        let format = files::format_of(&self.file, self.format)?;
        let (stored, bytes) = files::open_stored(&self.file)?;
        let progress = Progress::new("{bar:40} {bytes}/{total_bytes}");
        let stored = ProgressReader { source: stored, read: 0, bytes: bytes.unwrap_or(0), progress };
        let source = files::decoded(&self.file, stored)?;
        let missing = if self.create { MissingData::Create } else { MissingData::Refuse };
        let report = runtime()?.block_on(async {
            let app = open_app(&settings, "sightfix import", missing).await?;
            if self.create {
                self.create_camera(&app).await?;
            }
            let layout = CsvLayout { target_id: self.target_id.clone(), ..self.layout.to_layout() };
            let on_conflict = if self.replace { OnConflict::Replace } else { OnConflict::Keep };
            let options = ImportOptions { on_conflict, ..ImportOptions::default() };
            let report = app.samples().import_file(&self.camera, source, (format, layout), options).await;
            app.store.close().await;
            anyhow::Ok(report?)
        })?;
        print(&report, &self.summary.summary(None))?;
        anyhow::ensure!(
            report.accepted + report.duplicate > 0 || report.rejected == 0,
            "every row was rejected"
        );
        let rows = (report.accepted + report.duplicate + report.rejected).max(1);
        let share = report.rejected as f64 / rows as f64;
        if share > self.max_rejected {
            let (rejected, percent) = (report.rejected, 100.0 * share);
            let message =
                format!("{rejected} of {rows} rows ({percent:.0} %) were rejected; the others are stored");
            return Err(TooManyRejected(message).into());
        }
        Ok(())
    }
}

impl Import {
    /// Creates the camera and its site, as far as they do not exist.
    async fn create_camera(&self, app: &App) -> anyhow::Result<()> {
        if let Some(site) = &self.site {
            match app.sites().create(NewSite::named(site.clone())).await {
                Err(Error::Refused(refusal)) if refusal.kind == ErrorKind::SiteExists => {}
                created => drop(created?),
            }
        }
        let profile = NewCamera {
            image_size: self.image_size,
            location: self.location,
            gnss_bias_sigma: self.gnss_bias_sigma_m,
            site: self.site.clone(),
            ..NewCamera::named(self.camera.clone())
        };
        match app.cameras().create(profile).await {
            Err(Error::Refused(refusal)) if refusal.kind == ErrorKind::CameraExists => {
                self.check_profile(app).await
            }
            Err(error) => Err(error.into()),
            Ok(_) => Ok(()),
        }
    }

    /// Boxes of another image, or of a camera elsewhere, would be stored as if they were of this one.
    async fn check_profile(&self, app: &App) -> anyhow::Result<()> {
        let profile = app.cameras().get(&self.camera).await?.profile;
        anyhow::ensure!(
            self.site.is_none() || profile.site == self.site,
            "camera {} exists and belongs to {}; leave --site out, or change the profile",
            self.camera,
            profile.site.map_or_else(|| "no site".to_owned(), |site| format!("site {site}"))
        );
        let stored = profile.image_size;
        let Some(wanted) = self.image_size.filter(|_| stored != self.image_size) else { return Ok(()) };
        let shown = |size: ImageSize| format!("{}x{}", size.width_px(), size.height_px());
        anyhow::bail!(
            "camera {} exists with the image size {}, not {}; leave --image-size out, or change the profile",
            self.camera,
            stored.map_or_else(|| "unknown".to_owned(), shown),
            shown(wanted)
        )
    }
}

fn print(report: &ImportReport, summary: &Summary) -> anyhow::Result<()> {
    let ImportReport { accepted, without_fix, duplicate, replaced, rejected, rejected_rows, warnings } =
        report;
    summary.document(&serde_json::to_value(report)?)?;
    summary.line(&format_args!(
        "accepted {accepted} (without a fix {without_fix}), duplicate {duplicate}, rejected {rejected}"
    ))?;
    if *replaced > 0 {
        summary.line(&format_args!("replaced {replaced}"))?;
    }
    for reason in rejected_rows::reasons(rejected_rows) {
        summary.line(&reason)?;
    }
    if *rejected > rejected_rows.len() as u64 {
        summary.line(&format_args!("... and {} more", rejected - rejected_rows.len() as u64))?;
    }
    for warning in warnings {
        summary.line(&format_args!("warning: {warning}"))?;
    }
    Ok(())
}

/// A share from 0 to 1.
fn share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.0..=1.0).contains(share));
    share.ok_or_else(|| "must be a share from 0 to 1".to_owned())
}

/// A size as `1920x1080`.
pub(super) fn image_size(text: &str) -> Result<ImageSize, String> {
    let sides = text
        .split_once(['x', 'X'])
        .and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    let (width_px, height_px) = sides.ok_or("must be WIDTHxHEIGHT in pixels, such as 1920x1080")?;
    ImageSize::new(width_px, height_px).map_err(|error| error.to_string())
}

/// A position as `103.98678,30.6280135`.
fn location(text: &str) -> Result<Position, String> {
    let degrees = text
        .split_once(',')
        .and_then(|(longitude, latitude)| Some((longitude.parse().ok()?, latitude.parse().ok()?)));
    let (longitude_deg, latitude_deg) =
        degrees.ok_or("must be LONGITUDE,LATITUDE in degrees, such as 103.98678,30.6280135")?;
    Position::new(longitude_deg, latitude_deg).map_err(|error| error.to_string())
}

/// A standard deviation in metres.
pub(super) fn gnss_bias_sigma(text: &str) -> Result<GnssBiasSigma, String> {
    let sigma_m = text.parse().map_err(|_| "must be a number of metres".to_owned())?;
    GnssBiasSigma::new(sigma_m).map_err(|error| error.to_string())
}

/// A reader that shows the progress of reading.
struct ProgressReader<R> {
    source: R,
    read: u64,
    bytes: u64,
    progress: Progress,
}

impl<R: Read> Read for ProgressReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.source.read(buffer)?;
        self.read += read as u64;
        self.progress.set(self.read, self.bytes, "bytes read");
        Ok(read)
    }
}
