//! `sightfix train`

use std::path::Path;

use clap::Args;
use futures_util::{Stream, StreamExt as _};

use super::progress::Progress;
use super::summary::SummaryFlags;
use super::{DataFolder, MissingData, camera_id, open_app, runtime, site_id};
use crate::app::{App, RunRequest, SiteRunRequest, Trainable};
use crate::config::{Config, Workers};
use crate::domain::{CameraId, JobState, Recipe, Result, RunProgress, SiteId, TrainingRun};
use crate::shutdown::Shutdown;
use crate::worker;

/// Train a camera's model from its samples, or those of all cameras of a site together
#[derive(Args)]
pub(super) struct Train {
    /// The camera's id
    #[arg(long, value_name = "ID", value_parser = camera_id, required_unless_present = "site")]
    camera: Option<CameraId>,
    /// The site's id: its cameras are trained together, and their versions become active together or not at all
    #[arg(long, value_name = "ID", value_parser = site_id, conflicts_with_all = ["camera", "recipe", "epochs"])]
    site: Option<SiteId>,
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
            let ended = match (&self.camera, &self.site) {
                (Some(camera), _) => self.train_camera(&app, &settings, camera).await,
                (None, Some(site)) => self.train_site(&app, &settings, site).await,
                (None, None) => Err(anyhow::anyhow!("name a camera or a site")),
            };
            app.store.close().await;
            ended
        })
    }

    async fn train_camera(&self, app: &App, settings: &Config, camera: &CameraId) -> anyhow::Result<()> {
        let request =
            RunRequest { recipe: self.recipe, seed: self.seed, epochs: self.epochs, ..RunRequest::default() };
        let ended = train(app, settings, (camera, request), worker::train).await?;
        let outcome = succeeded(ended.state, ended.outcome.as_deref())?;
        let summary = self.summary.summary(None);
        summary.document(&serde_json::json!({
            "run": ended.id.to_string(),
            "model_version": ended.model_version,
            "outcome": outcome,
            "report": ended.report,
        }))?;
        summary.line(&format_args!("version {} {outcome}", ended.model_version.unwrap_or_default()))?;
        ended.report.as_ref().map_or(Ok(()), |report| summary.line(report))
    }

    async fn train_site(&self, app: &App, settings: &Config, site: &SiteId) -> anyhow::Result<()> {
        let request = SiteRunRequest { seed: self.seed, ..SiteRunRequest::default() };
        let ended = train(app, settings, (site, request), worker::train_sites).await?;
        let outcome = succeeded(ended.state, ended.outcome.as_deref())?;
        let summary = self.summary.summary(None);
        summary.document(&serde_json::json!({
            "run": ended.id.to_string(),
            "outcome": outcome,
            "report": ended.report,
        }))?;
        summary.line(&outcome)?;
        ended.report.as_ref().map_or(Ok(()), |report| summary.line(report))
    }
}

/// The outcome of a run that has succeeded; an error for any other.
fn succeeded(state: JobState, outcome: Option<&str>) -> anyhow::Result<&str> {
    let outcome = outcome.unwrap_or("no outcome was recorded");
    anyhow::ensure!(state == JobState::Succeeded, "{}: {outcome}", state.as_str());
    Ok(outcome)
}

/// Queues a run, starts a worker in this process (a server on the same folder may claim the run first),
/// and shows the progress until the run has ended.
async fn train<S: Trainable, W: Future<Output = ()> + Send + 'static>(
    app: &App,
    settings: &Config,
    (subject, request): (&S, S::RunRequest),
    work: impl FnOnce(App, Workers, Shutdown) -> W,
) -> anyhow::Result<TrainingRun<S>> {
    let queued = app.training().start(subject, request, None).await?;
    let shutdown = Shutdown::new();
    shutdown.spawn(work(app.clone(), settings.training.clone(), shutdown.clone()));
    let changes = app.training().watch(subject, queued.id).await?;
    let latest = watched(queued, changes).await?;
    shutdown.drain_with_timeout(settings.limits.drain_time()).await;
    Ok(latest)
}

/// Shows the progress of a run until it has ended.
async fn watched<S: Trainable>(
    queued: TrainingRun<S>,
    changes: impl Stream<Item = Result<TrainingRun<S>>>,
) -> anyhow::Result<TrainingRun<S>> {
    let mut bar = Progress::new("{bar:40} {pos}/{len} epochs {msg}");
    let mut latest = queued;
    let mut changes = std::pin::pin!(changes);
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
        bar.set((*epoch).into(), (*epochs).into(), &message);
    }
    bar.finish();
    Ok(latest)
}
