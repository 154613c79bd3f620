//! `sightfix gnss-error`

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;

use super::open_file;
use crate::app::GnssErrorEstimate;
use crate::exchange::{self, FixFormat};

/// Estimate a receiver's error from many fixes at one fixed point
#[derive(Args)]
pub(super) struct GnssError {
    /// Fixes as CSV (longitude, latitude) or NMEA (GGA), told by the ending
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

impl GnssError {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let format = FixFormat::from_path(&self.file).context("the ending must be .csv, .nmea, .nma or .txt")?;
        let fixes = exchange::read_fixes(open_file(&self.file)?, format)?;
        let estimate = GnssErrorEstimate::from_fixes(fixes.map(|row| row.map(|row| row.fix)))?;
        println!("fixes              {}", estimate.fixes);
        println!(
            "mean               {:.8} {:.8} (longitude, latitude)",
            estimate.mean.longitude_deg(),
            estimate.mean.latitude_deg()
        );
        println!("east variance      {:.4} m2", estimate.east_variance_m2);
        println!("north variance     {:.4} m2", estimate.north_variance_m2);
        println!("e_gnss             {:.4} m2 per axis", estimate.e_gnss_m2);
        println!("sigma              {:.4} m per axis, for the camera's gnss_error", estimate.sigma_m);
        Ok(())
    }
}
