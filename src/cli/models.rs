//! `sightfix models`

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use bytes::Bytes;
use clap::{Args, Subcommand};

use super::files::Output;
use super::{DataFolder, MissingData, camera_id, open_app, runtime};
use crate::domain::{CameraId, ModelFormat};
use crate::model::Artifact;

/// Write a camera's model versions to files
#[derive(Args)]
pub(super) struct Models {
    #[command(subcommand)]
    command: ModelsCommand,
}

#[derive(Subcommand)]
enum ModelsCommand {
    /// Write a model version to a file: safetensors for sightfix, ONNX for other runtimes
    Export(Export),
}

#[derive(Args)]
struct Export {
    /// The camera's id
    #[arg(long, value_name = "ID", value_parser = camera_id, required_unless_present = "model")]
    camera: Option<CameraId>,
    /// Number of the version [default: the active one]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    number: Option<u32>,
    /// A downloaded model file to convert instead; needs no data folder
    #[arg(long, value_name = "FILE", conflicts_with_all = ["camera", "number"])]
    model: Option<PathBuf>,
    /// safetensors or onnx [default: by the file's ending]
    #[arg(long, value_name = "FORMAT")]
    format: Option<ModelFormat>,
    /// Output file; - is standard output
    #[arg(long, short, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    folder: DataFolder,
}

impl Models {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        match self.command {
            ModelsCommand::Export(command) => command.run(file),
        }
    }
}

impl Export {
    fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let by_ending = || self.out.extension()?.to_str()?.parse().ok();
        let format = self.format.or_else(by_ending);
        let format =
            format.context("--format must be safetensors or onnx, as the file's ending is neither")?;
        let content = match &self.model {
            Some(path) => converted(path, format)?,
            None => self.stored(file, format)?,
        };
        let mut out = Output::create(&self.out)?;
        let cannot_write = || format!("cannot write {}", self.out.display());
        std::io::Write::write_all(&mut out, &content).with_context(cannot_write)?;
        out.finish().with_context(cannot_write)
    }

    /// A version of a data folder.
    fn stored(&self, file: Option<&Path>, format: ModelFormat) -> anyhow::Result<Bytes> {
        let settings = self.folder.settings(file)?;
        let camera = self.camera.as_ref().context("--camera or --model is needed")?;
        runtime()?.block_on(async {
            let app = open_app(&settings, "sightfix models", MissingData::Refuse).await?;
            let content = async {
                let number = match self.number {
                    Some(number) => number,
                    None => app.models().active(camera).await?.number,
                };
                app.models().download(camera, number, format).await
            }
            .await;
            app.close().await;
            Ok(content?)
        })
    }
}

fn converted(path: &Path, format: ModelFormat) -> anyhow::Result<Bytes> {
    let file = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let artifact = Artifact::from_file(&file).with_context(|| path.display().to_string())?;
    Ok(match format {
        ModelFormat::Safetensors => file.into(),
        ModelFormat::Onnx => artifact.to_onnx()?,
    })
}
