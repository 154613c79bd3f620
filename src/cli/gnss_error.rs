//! `sightfix gnss-error`

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;

use super::files;
use super::rejected_rows::print_reasons;
use super::summary::SummaryFlags;
use crate::app::GnssErrorEstimate;
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::TimeBounds;
use crate::exchange::{self, FixFormat};

/// Estimate a receiver's error from many fixes at one fixed point
#[derive(Args)]
pub(super) struct EstimateGnssError {
    /// Fixes as CSV (longitude, latitude), NMEA, GPX, gpsd reports, solutions of RTKLIB (.pos), FIT or a log of
    /// GnssLogger, by file extension, which may be followed by .gz or .zst; - is standard input
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Format if the ending does not name it: csv, nmea, gpx, gpsd, rtklib, fit or gnss_logger [default: csv for -]
    #[arg(long, value_name = "FORMAT")]
    format: Option<FixFormat>,
    #[command(flatten)]
    summary: SummaryFlags,
}

impl EstimateGnssError {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let format = files::fix_format_of(&self.file, self.format).context(
            "the extension must be .csv, .nmea, .log, .txt, .gpx, .json, .pos or .fit; or give --format",
        )?;
        let time_bounds = TimeBounds::at(Clock::system().now());
        let rows = exchange::read_fixes(files::open_input(&self.file)?, format, time_bounds)?;
        let estimate = GnssErrorEstimate::from_rows(rows, Limits::default().rejected_rows)?;
        print_reasons("", &estimate.rejected_rows, estimate.rejected);
        let (longitude_deg, latitude_deg) = (estimate.mean.longitude_deg(), estimate.mean.latitude_deg());
        let summary = self.summary.summary(None);
        summary.document(&serde_json::json!({
            "fixes": estimate.fixes,
            "rejected": estimate.rejected,
            "mean": { "longitude_deg": longitude_deg, "latitude_deg": latitude_deg },
            "east_variance_m2": estimate.east_variance_m2,
            "north_variance_m2": estimate.north_variance_m2,
            "e_gnss_m2": estimate.e_gnss_m2,
            "sigma_m": estimate.sigma_m,
        }))?;
        summary
            .line(&format_args!("fixes              {}, rejected {}", estimate.fixes, estimate.rejected))?;
        summary.line(&format_args!(
            "mean               {longitude_deg:.8} {latitude_deg:.8} (longitude, latitude)"
        ))?;
        summary.line(&format_args!("east variance      {:.4} m2", estimate.east_variance_m2))?;
        summary.line(&format_args!("north variance     {:.4} m2", estimate.north_variance_m2))?;
        summary.line(&format_args!("e_gnss             {:.4} m2 per axis", estimate.e_gnss_m2))?;
        summary.line(&format_args!(
            "sigma              {:.4} m per axis, for the camera's gnss_error",
            estimate.sigma_m
        ))
    }
}
