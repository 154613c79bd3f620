//! `sightfix train`

use std::path::Path;

use clap::Args;
use futures_util::StreamExt as _;

use super::progress::Progress;
use super::summary::SummaryFlags;
use super::{DataFolder, MissingData, camera_id, open_app, runtime};
use crate::app::{App, RunRequest};
use crate::config::Config;
use crate::domain::{CameraId, JobState, Recipe, RunProgress, TrainingRun};
use crate::shutdown::Shutdown;
use crate::worker;

/// Train a camera's model from its samples
#[derive(Args)]
pub(super) struct Train {
    /// The camera's id
    #[arg(long, value_name = "ID", value_parser = camera_id)]
    camera: CameraId,
    /// Recipe [default: that of the camera's profile]
    #[arg(long, value_name = "RECIPE")]
    recipe: Option<Recipe>,
    /// Seed of all randomness in the run
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Number of epochs [default: that of the recipe]
    #[arg(long, value_name = "N")]
    epochs: Option<u32>,
    #[command(flatten)]
    summary: SummaryFlags,
    #[command(flatten)]
    folder: DataFolder,
}

impl Train {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let settings = self.folder.settings(file)?;
        runtime()?.block_on(async {
            let app = open_app(&settings, "sightfix train", MissingData::Refuse).await?;
            let request = RunRequest {
                recipe: self.recipe,
                seed: self.seed,
                epochs: self.epochs,
                ..RunRequest::default()
            };
            let ended = train(&app, &settings, &self.camera, request).await;
            app.store.close().await;
            let ended = ended?;
            let outcome = ended.outcome.as_deref().unwrap_or("no outcome was recorded");
            anyhow::ensure!(ended.state == JobState::Succeeded, "{}: {outcome}", ended.state.as_str());
            let summary = self.summary.summary(None);
            summary.document(&serde_json::json!({
                "run": ended.id.to_string(),
                "model_version": ended.model_version,
                "outcome": outcome,
                "report": ended.report,
            }))?;
            summary.line(&format_args!("version {} {outcome}", ended.model_version.unwrap_or_default()))?;
            ended.report.as_ref().map_or(Ok(()), |report| summary.line(report))
        })
    }
}

/// Queues a run, starts a worker in this process (a server on the same folder may claim the run first),
/// and shows the progress until the run has ended.
pub(super) async fn train(
    app: &App,
    settings: &Config,
    camera: &CameraId,
    request: RunRequest,
) -> anyhow::Result<TrainingRun> {
    let queued = app.start_run(camera, request).await?;
    let shutdown = Shutdown::new();
    shutdown.spawn(worker::train(app.clone(), settings.training.clone(), shutdown.clone()));
    let mut progress = Progress::new("{bar:40} {pos}/{len} epochs {msg}");
    let mut latest = queued.clone();
    let mut changes = std::pin::pin!(app.watch_run(camera, queued.id).await?);
    while let Some(run) = changes.next().await {
        latest = run?;
        let RunProgress { phase, epoch, epochs, error_scale, remaining_s, .. } = &latest.progress;
        let remaining = remaining_s.map(|seconds| format!(", {seconds:.0} s left")).unwrap_or_default();
        // Before the first epoch there is nothing to count and no error scale.
        let message = match (phase.as_str(), *epoch) {
            ("", _) => latest.state.as_str().to_owned(),
            (phase, 0) => format!("{phase}{remaining}"),
            (phase, _) => format!("{phase}, Es {error_scale:.3}{remaining}"),
        };
        progress.set((*epoch).into(), (*epochs).into(), &message);
    }
    progress.finish();
    shutdown.drain_with_timeout(settings.limits.drain_time()).await;
    Ok(latest)
}
