//! Evaluations as jobs: which samples they need, how far they have come, and the report they yield.

use std::time::Duration;

use tokio::sync::Notify;
use uuid::Uuid;

use super::aside::Said;
use super::{Ended, Job, Work, load_samples};
use crate::app::App;
use crate::clock::thread_cpu_s;
use crate::domain::{
    CameraId, Error, EvaluationJob, EvaluationProgress, JobState, Observation, Result, Sample,
};
use crate::evaluation::{EvaluateOptions, Progress, Report, TestRow, evaluate};
use crate::store::{Claim, Heartbeat, JobEnd, SampleFilter};
use crate::telemetry::Metrics;

impl Said for EvaluationProgress {
    fn take(&mut self) -> Self {
        self.clone()
    }
}

/// How an evaluation's work has ended.
pub(super) enum Evaluated {
    Whole(Result<Report>),
    BrokenOff,
}

impl Job for EvaluationJob {
    const NAME: &'static str = "evaluation";
    type Said = EvaluationProgress;
    type Yield = Evaluated;

    fn id(&self) -> Uuid {
        self.id.0
    }

    fn camera(&self) -> &CameraId {
        &self.camera_id
    }

    fn attempt(&self) -> u32 {
        self.attempt
    }

    fn bell(app: &App) -> &Notify {
        &app.evaluation_queued
    }

    fn count(metrics: &Metrics, state: JobState, time: Duration) {
        metrics.evaluations.ended(state, time);
    }

    async fn claim(app: &App, lease: Duration) -> Result<Option<Claim<Self>>> {
        app.store.claim_evaluation(lease, app.clock.now()).await
    }

    async fn prepare(app: &App, claim: &Claim<Self>) -> Result<Work<Self>> {
        let EvaluationJob { camera_id, plan, .. } = &claim.job;
        let camera = app.store.camera(camera_id).await?;
        let most = app.limits.rows_per_evaluation;
        let train = load_samples(app, camera_id, &SampleFilter::within(plan.train), most).await?;
        let test = load_samples(app, camera_id, &SampleFilter::within(plan.test), most).await?;
        let test: Vec<TestRow> = test.into_iter().map(test_row).collect();
        let truth = plan.truth.clone();
        let options = EvaluateOptions {
            methods: plan.methods.clone(),
            default_recipe: plan.recipe,
            seeds: plan.seeds.into(),
            epochs: None,
            image_size: camera.profile.image_size,
            gnss_sigma: plan.gnss_sigma,
            box_shift_px: plan.box_shift_px,
            cpu_s: thread_cpu_s,
        };
        Ok(Box::new(move |voice| {
            let mut broken_off = false;
            let evaluated = evaluate(&train, &test, &truth, &options, &mut |step: &Progress<'_>| {
                let going_on = voice.say(|progress| {
                    *progress = EvaluationProgress {
                        phase: step.phase.to_owned(),
                        steps_done: step.done,
                        steps: step.planned,
                        remaining_s: voice.remaining_s(step.done, step.planned),
                    };
                });
                broken_off |= going_on.is_break();
                going_on
            });
            if broken_off { Evaluated::BrokenOff } else { Evaluated::Whole(evaluated.map(|it| it.report)) }
        }))
    }

    async fn record(
        app: &App,
        claim: &Claim<Self>,
        said: EvaluationProgress,
        lease: Duration,
    ) -> Result<Heartbeat> {
        app.store.beat_evaluation(claim.job.id, claim.fence, &said, lease, app.clock.now()).await
    }

    async fn end(
        app: &App,
        claim: &Claim<Self>,
        ended: Ended<Self>,
        lease: Duration,
    ) -> Result<Option<JobState>> {
        let Ended { yielded, mut said, server_is_ending } = ended;
        let end = match yielded {
            Evaluated::BrokenOff if server_is_ending => JobEnd::Requeue,
            Evaluated::BrokenOff => JobEnd::Cancelled,
            Evaluated::Whole(Ok(report)) if report.methods.is_empty() => {
                let reasons: Vec<String> =
                    report.failed.iter().map(|(method, reason)| format!("{method}: {reason}")).collect();
                JobEnd::Failed { outcome: format!("no method could run: {}", reasons.join("; ")) }
            }
            Evaluated::Whole(Ok(report)) => {
                said.steps_done = said.steps;
                let yielded = serde_json::to_string(&report).map_err(Error::fault)?;
                JobEnd::Succeeded { yielded, outcome: None }
            }
            Evaluated::Whole(Err(error)) => return Err(error),
        };
        if matches!(Self::record(app, claim, said, lease).await?, Heartbeat::Lost) {
            return Ok(None);
        }
        leave(app, claim, end).await
    }

    async fn fail(app: &App, claim: &Claim<Self>, outcome: String) -> Result<Option<JobState>> {
        leave(app, claim, JobEnd::Failed { outcome }).await
    }
}

async fn leave(app: &App, claim: &Claim<EvaluationJob>, end: JobEnd<String>) -> Result<Option<JobState>> {
    let ended = app.store.finish_evaluation(claim.job.id, claim.fence, end, app.clock.now()).await?;
    Ok(ended.map(|job| job.state))
}

fn test_row(sample: Sample) -> TestRow {
    let Sample { time, target_id, bounding_box, fix, truth, .. } = sample;
    let observation =
        Observation { time, target_id: Some(target_id), bounding_box: Some(bounding_box), fix: Some(fix) };
    TestRow { observation, truth }
}
