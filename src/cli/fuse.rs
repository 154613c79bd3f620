//! `sightfix fuse`

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;

use super::files::{self, Output};
use super::rejected_rows::RejectedRows;
use super::summary::SummaryFlags;
use super::{DataFolder, MissingData, camera_id, open_app, runtime};
use crate::clock::Clock;
use crate::domain::{CameraId, ImageSize, TimeBounds};
use crate::exchange::{self, Format, RowRules};
use crate::fusion::two_step;
use crate::model::{Artifact, Regressor};

/// Fuse observations from a file, without a server
#[derive(Args)]
pub(super) struct Fuse {
    /// Observations as CSV, NDJSON or JSON, by file extension, which may be followed by .gz or .zst; boxes and fixes may
    /// be empty; - is standard input
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Format of the observations if the ending does not name it [default: csv for -]
    #[arg(long, value_name = "FORMAT", value_parser = files::format)]
    format: Option<Format>,
    /// Output file: CSV, NDJSON, JSON or GeoJSON, by file extension, which may be followed by .gz or .zst; - is standard
    /// output
    #[arg(long, short, value_name = "FILE")]
    out: PathBuf,
    /// Format of the output if the ending does not name it [default: csv for -]
    #[arg(long, value_name = "FORMAT", value_parser = files::format)]
    out_format: Option<Format>,
    #[command(flatten)]
    summary: SummaryFlags,
    /// The camera whose active model is used
    #[arg(long, value_name = "ID", value_parser = camera_id, required_unless_present = "model")]
    camera: Option<CameraId>,
    /// A downloaded model file to use instead; needs no data folder
    #[arg(long, value_name = "FILE", conflicts_with = "camera")]
    model: Option<PathBuf>,
    #[command(flatten)]
    folder: DataFolder,
}

/// A model with its version number, and the camera's profile as far as fusion uses it.
struct FusionModel {
    regressor: std::sync::Arc<Regressor>,
    number: u32,
    image_size: Option<ImageSize>,
    e_gnss_m2: Option<f64>,
}

impl Fuse {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let from = files::format_of(&self.file, self.format)?;
        let to = files::format_of(&self.out, self.out_format)?;
        let fusion_model = self.model(file)?;
        let rules = RowRules {
            time_bounds: TimeBounds::at(Clock::system().now()),
            image_size: fusion_model.image_size,
        };
        let rows = exchange::read_observations(files::open_input(&self.file)?, from, &rules)?;
        let cannot_write = || format!("cannot write {}", self.out.display());
        let mut out = Output::create(&self.out)?;
        let mut writer = exchange::FusedWriter::new(&mut out, to);
        let (mut answered, mut rejected) = (0_u64, RejectedRows::default());
        for row in rows {
            let row = match row? {
                Ok(row) => row,
                Err(row) => {
                    rejected.push(row);
                    continue;
                }
            };
            let model = Some((&*fusion_model.regressor, fusion_model.number));
            let fused =
                two_step::fuse(&row.observation, model, fusion_model.image_size, fusion_model.e_gnss_m2)
                    .context("the observation cannot be fused")?;
            writer.write(&fused).with_context(cannot_write)?;
            answered += 1;
        }
        writer.finish().with_context(cannot_write)?;
        out.finish().with_context(cannot_write)?;
        rejected.print("");
        let rejected = rejected.count;
        let summary = self.summary.summary(Some(&self.out));
        summary.document(&serde_json::json!({ "answered": answered, "rejected": rejected }))?;
        summary.line(&format_args!("answered {answered}, rejected {rejected}"))
    }

    fn model(&self, file: Option<&Path>) -> anyhow::Result<FusionModel> {
        if let Some(path) = &self.model {
            let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
            let regressor = std::sync::Arc::new(Artifact::from_file(&bytes)?.load()?);
            return Ok(FusionModel { regressor, number: 0, image_size: None, e_gnss_m2: None });
        }
        let id = self.camera.as_ref().context("give --camera or --model")?;
        let settings = self.folder.settings(file)?;
        runtime()?.block_on(async {
            let app = open_app(&settings, "sightfix fuse", MissingData::Refuse).await?;
            let serving = app.active_camera(id).await?;
            app.store.close().await;
            let (regressor, number) = serving.model.clone().with_context(|| {
                format!("camera {id} has no active model: train it first (sightfix train)")
            })?;
            Ok(FusionModel {
                regressor,
                number,
                image_size: serving.image_size,
                e_gnss_m2: serving.e_gnss_m2,
            })
        })
    }
}
