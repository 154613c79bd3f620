//! `sightfix gnss-error`

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;

use super::open_file;
use super::output::{print_line, print_note};
use crate::app::GnssErrorEstimate;
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::TimeBounds;
use crate::exchange::{self, FixFormat};

/// Estimate a receiver's error from many fixes at one fixed point
#[derive(Args)]
pub(super) struct EstimateGnssError {
    /// Fixes as CSV (longitude, latitude), NMEA (GGA), GPX or gpsd reports, by file extension
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

impl EstimateGnssError {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let format = FixFormat::from_path(&self.file)
            .context("the extension must be .csv, .nmea, .log, .txt, .gpx or .json")?;
        let time_bounds = TimeBounds::at(Clock::system().now());
        let rows = exchange::read_fixes(open_file(&self.file)?, format, time_bounds)?;
        let estimate = GnssErrorEstimate::from_rows(rows, Limits::default().rejected_rows)?;
        for row in &estimate.rejected_rows {
            print_note(format_args!("line {}: {}: {}", row.line, row.field, row.reason));
        }
        print_line(&format_args!("fixes              {}, rejected {}", estimate.fixes, estimate.rejected))?;
        print_line(&format_args!(
            "mean               {:.8} {:.8} (longitude, latitude)",
            estimate.mean.longitude_deg(),
            estimate.mean.latitude_deg()
        ))?;
        print_line(&format_args!("east variance      {:.4} m2", estimate.east_variance_m2))?;
        print_line(&format_args!("north variance     {:.4} m2", estimate.north_variance_m2))?;
        print_line(&format_args!("e_gnss             {:.4} m2 per axis", estimate.e_gnss_m2))?;
        print_line(&format_args!(
            "sigma              {:.4} m per axis, for the camera's gnss_error",
            estimate.sigma_m
        ))?;
        Ok(())
    }
}
