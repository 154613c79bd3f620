//! Training runs as jobs: what those of cameras and of sites have in common.

use std::time::Duration;

use super::job_thread::{JobProgress, ProgressSink};
use super::{Ended, Job, JobIdentity, Work};
use crate::app::{App, JobQueue, Trainable};
use crate::domain::{EpochReport, Error, JobState, Result, RunProgress, TrainingRun};
use crate::model::{FitError, FitEvent};
use crate::store::{Claim, Heartbeat, JobEnd};
use crate::telemetry::{JobMetrics, Metrics};

/// The reports of a fit since the last call.
#[derive(Debug, Clone, Default)]
pub(super) struct Update {
    pub(super) progress: RunProgress,
    pub(super) epochs: Vec<EpochReport>,
    pub(super) notes: Vec<String>,
}

impl JobProgress for Update {
    fn take(&mut self) -> Self {
        let progress = self.progress.clone();
        std::mem::replace(self, Self { progress, ..Self::default() })
    }
}

impl Update {
    /// Notes that the fit is done. A recipe may do less than planned: the chosen candidate has no network, for one.
    pub(super) fn complete(&mut self) {
        self.progress.epoch = self.progress.epochs;
        self.progress.remaining_s = Some(0.0);
    }
}

/// The parts that differ between the training of a camera and of a site.
pub(super) trait Trained: Trainable {
    /// Name of its runs in the log.
    const NAME: &'static str;
    /// The fitted models with their samples.
    type Fitted: Send + 'static;

    fn identity(run: &TrainingRun<Self>) -> JobIdentity<'_>;

    /// Reads the samples; the fit then runs on a thread.
    fn prepare(
        app: &App,
        claim: &Claim<TrainingRun<Self>>,
    ) -> impl Future<Output = Result<Work<TrainingRun<Self>>>> + Send;

    /// Stores the curve and the lines of the log, if runs of the subject have them.
    fn record_details(
        app: &App,
        claim: &Claim<TrainingRun<Self>>,
        update: &Update,
    ) -> impl Future<Output = Result<()>> + Send;

    /// Finishes a run whose fit has succeeded.
    fn succeed(
        app: &App,
        claim: &Claim<TrainingRun<Self>>,
        fitted: Self::Fitted,
    ) -> impl Future<Output = Result<Option<JobState>>> + Send;
}

impl<S: Trained> Job for TrainingRun<S> {
    const NAME: &'static str = S::NAME;
    type Progress = Update;
    type Output = std::result::Result<S::Fitted, FitError>;

    fn identity(&self) -> JobIdentity<'_> {
        S::identity(self)
    }

    fn queue(app: &App) -> &JobQueue {
        S::queue(&app.training_queues)
    }

    fn metrics(metrics: &Metrics) -> &JobMetrics {
        &metrics.training_runs
    }

    async fn claim(app: &App, lease: Duration) -> Result<Option<Claim<Self>>> {
        app.store.claim_run(lease, app.clock.now()).await
    }

    async fn prepare(app: &App, claim: &Claim<Self>) -> Result<Work<Self>> {
        S::prepare(app, claim).await
    }

    async fn record(app: &App, claim: &Claim<Self>, update: Update, lease: Duration) -> Result<Heartbeat> {
        S::record_details(app, claim, &update).await?;
        let (run, now) = (claim.job.id, app.clock.now());
        app.store.heartbeat_run::<S>(run, claim.fence, &update.progress, lease, now).await
    }

    async fn end(
        app: &App,
        claim: &Claim<Self>,
        ended: Ended<Self>,
        lease: Duration,
    ) -> Result<Option<JobState>> {
        let Ended { output, mut progress, shutting_down } = ended;
        if output.is_ok() {
            progress.complete();
        }
        if matches!(Self::record(app, claim, progress, lease).await?, Heartbeat::Lost) {
            return Ok(None);
        }
        match output {
            Ok(fitted) => S::succeed(app, claim, fitted).await,
            Err(FitError::Cancelled) if shutting_down => Self::requeue(app, claim).await,
            Err(FitError::Cancelled) => finish(app, claim, "cancelled", JobEnd::Cancelled).await,
            Err(FitError::Unusable(error)) => {
                let outcome = error.to_string();
                finish(app, claim, &outcome.clone(), JobEnd::Failed { outcome }).await
            }
            Err(FitError::Fault(error)) => Err(Error::fault(error)),
        }
    }

    async fn requeue(app: &App, claim: &Claim<Self>) -> Result<Option<JobState>> {
        finish(app, claim, "returned to the queue: the server shuts down", JobEnd::Requeue).await
    }

    async fn fail(app: &App, claim: &Claim<Self>, outcome: String) -> Result<Option<JobState>> {
        let end = JobEnd::Failed { outcome };
        let ended = app.store.finish_run::<S>(claim.job.id, claim.fence, end, app.clock.now()).await?;
        Ok(ended.map(|run| run.state))
    }
}

/// Ends the run with a line in its log.
pub(super) async fn finish<S: Trained>(
    app: &App,
    claim: &Claim<TrainingRun<S>>,
    line: &str,
    end: JobEnd<S::Output<'_>>,
) -> Result<Option<JobState>> {
    let update = Update { notes: vec![line.to_owned()], ..Update::default() };
    S::record_details(app, claim, &update).await?;
    let ended = app.store.finish_run::<S>(claim.job.id, claim.fence, end, app.clock.now()).await?;
    Ok(ended.map(|run| run.state))
}

/// Tells an observer of the job what a fit reports.
pub(super) fn report(sink: &ProgressSink<Update>, event: FitEvent<'_>) -> std::ops::ControlFlow<()> {
    sink.update(|update| match event {
        FitEvent::Progress(progress) => {
            update.progress.clone_from(progress);
            update.progress.remaining_s = sink.remaining_s(progress.epoch, progress.epochs);
        }
        FitEvent::Epoch(report) => update.epochs.push(*report),
        FitEvent::HeldOut(_) => {}
        FitEvent::Note(line) => update.notes.push(line.to_owned()),
    })
}
