//! Evaluations as jobs: their samples, the evaluation on a thread, and the report that it gives.

use std::time::Duration;

use super::job_thread::JobProgress;
use super::{Ended, Job, JobIdentity, Work, load_samples, load_unpaired};
use crate::app::{App, JobQueue};
use crate::clock::thread_cpu_s;
use crate::domain::{Error, EvaluationJob, EvaluationProgress, JobState, Observation, Result, Sample};
use crate::evaluation::{self, EvaluateOptions, ReportWithPositions, TestRow, evaluate};
use crate::model::FitInput;
use crate::store::{Claim, Heartbeat, JobEnd, SampleFilter};
use crate::telemetry::{JobMetrics, Metrics};

impl JobProgress for EvaluationProgress {
    fn take(&mut self) -> Self {
        self.clone()
    }
}

/// How an evaluation ended.
pub(super) enum Evaluated {
    Completed(Result<ReportWithPositions>),
    Cancelled,
}

impl Job for EvaluationJob {
    const NAME: &'static str = "evaluation";
    type Progress = EvaluationProgress;
    type Output = Evaluated;

    fn identity(&self) -> JobIdentity<'_> {
        JobIdentity { id: self.id.0, camera: Some(&self.camera_id), site: None, attempt: self.attempt }
    }

    fn queue(app: &App) -> &JobQueue {
        &app.evaluation_queue
    }

    fn metrics(metrics: &Metrics) -> &JobMetrics {
        &metrics.evaluations
    }

    async fn claim(app: &App, lease: Duration) -> Result<Option<Claim<Self>>> {
        app.store.claim_evaluation(lease, app.clock.now()).await
    }

    async fn prepare(app: &App, claim: &Claim<Self>) -> Result<Work<Self>> {
        let EvaluationJob { camera_id, plan, .. } = &claim.job;
        let camera = app.store.camera(camera_id).await?;
        let most = app.limits.rows_per_evaluation;
        let train_filter = SampleFilter::within(plan.train);
        let train = load_samples(app, camera_id, &train_filter, most).await?;
        let unpaired = load_unpaired(app, camera_id, &train_filter).await?;
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
            gnss_bias_sigma: camera.profile.gnss_bias_sigma,
            box_shift_px: plan.box_shift_px,
            cpu_s: thread_cpu_s,
        };
        Ok(Box::new(move |sink| {
            let mut cancelled = false;
            let evaluated = evaluate(
                FitInput { samples: &train, unpaired: &unpaired, known_points: &camera.profile.known_points },
                &test,
                &truth,
                &options,
                &mut |step: &evaluation::Progress<'_>| {
                    let flow = sink.update(|progress| {
                        *progress = EvaluationProgress {
                            phase: step.phase.to_owned(),
                            steps_done: step.done,
                            steps: step.planned,
                            remaining_s: sink.remaining_s(step.done, step.planned),
                        };
                    });
                    cancelled |= flow.is_break();
                    flow
                },
            );
            if cancelled {
                return Evaluated::Cancelled;
            }
            Evaluated::Completed(evaluated.map(|evaluation| evaluation.into_report_with_positions(&test)))
        }))
    }

    async fn record(
        app: &App,
        claim: &Claim<Self>,
        progress: EvaluationProgress,
        lease: Duration,
    ) -> Result<Heartbeat> {
        let now = app.clock.now();
        app.store.heartbeat_evaluation(claim.job.id, claim.fence, &progress, lease, now).await
    }

    async fn end(
        app: &App,
        claim: &Claim<Self>,
        ended: Ended<Self>,
        lease: Duration,
    ) -> Result<Option<JobState>> {
        let Ended { output, mut progress, shutting_down } = ended;
        let end = match output {
            Evaluated::Cancelled if shutting_down => JobEnd::Requeue,
            Evaluated::Cancelled => JobEnd::Cancelled,
            Evaluated::Completed(Ok(ReportWithPositions { report, .. })) if report.methods.is_empty() => {
                let reasons: Vec<String> =
                    report.failed.iter().map(|(method, reason)| format!("{method}: {reason}")).collect();
                JobEnd::Failed { outcome: format!("no method could run: {}", reasons.join("; ")) }
            }
            Evaluated::Completed(Ok(report)) => {
                progress.steps_done = progress.steps;
                let output = serde_json::to_string(&report).map_err(Error::fault)?;
                JobEnd::Succeeded { output, outcome: None }
            }
            Evaluated::Completed(Err(error)) => return Err(error),
        };
        if matches!(Self::record(app, claim, progress, lease).await?, Heartbeat::Lost) {
            return Ok(None);
        }
        finish(app, claim, end).await
    }

    async fn requeue(app: &App, claim: &Claim<Self>) -> Result<Option<JobState>> {
        finish(app, claim, JobEnd::Requeue).await
    }

    async fn fail(app: &App, claim: &Claim<Self>, outcome: String) -> Result<Option<JobState>> {
        finish(app, claim, JobEnd::Failed { outcome }).await
    }
}

async fn finish(app: &App, claim: &Claim<EvaluationJob>, end: JobEnd<String>) -> Result<Option<JobState>> {
    let ended = app.store.finish_evaluation(claim.job.id, claim.fence, end, app.clock.now()).await?;
    Ok(ended.map(|job| job.state))
}

fn test_row(sample: Sample) -> TestRow {
    let Sample { time, target_id, bounding_box, fix, truth, .. } = sample;
    let observation = Observation::with_fix(time, Some(target_id), Some(bounding_box), fix);
    TestRow { observation, truth }
}
