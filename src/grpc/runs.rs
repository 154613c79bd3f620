//! Training runs as messages, whether their subject is a camera or a site.

use super::convert::timestamp;
use super::proto;
use super::proto::training_run::{Findings, Subject};
use crate::domain::{
    CameraId, CandidateFinding, JobState, RunProgress, SiteCameraFinding, SiteId, SiteTrainingReport,
    TrainingReport, TrainingRun, TrainingSubject,
};

impl From<TrainingRun<CameraId>> for proto::TrainingRun {
    fn from(run: TrainingRun<CameraId>) -> Self {
        message(run, |camera, options, report| Self {
            subject: Some(Subject::CameraId(camera.as_str().to_owned())),
            recipe: proto::Recipe::from(options.recipe).into(),
            seed: options.seed,
            epochs: options.epochs,
            from: options.from.map(timestamp),
            until: options.until.map(timestamp),
            findings: report.map(|report| Findings::Report(report.into())),
            ..Self::default()
        })
    }
}

impl From<TrainingRun<SiteId>> for proto::TrainingRun {
    fn from(run: TrainingRun<SiteId>) -> Self {
        message(run, |site, options, report| Self {
            subject: Some(Subject::SiteId(site.as_str().to_owned())),
            seed: options.seed,
            from: options.from.map(timestamp),
            until: options.until.map(timestamp),
            findings: report.map(|report| Findings::SiteReport(report.into())),
            ..Self::default()
        })
    }
}

/// The message of a run; `own` sets the fields that depend on the kind of its subject.
fn message<S: TrainingSubject>(
    run: TrainingRun<S>,
    own: impl FnOnce(S, S::Options, Option<S::Report>) -> proto::TrainingRun,
) -> proto::TrainingRun {
    proto::TrainingRun {
        id: run.id.to_string(),
        state: proto::TrainingRunState::from(run.state).into(),
        progress: Some(run.progress.into()),
        attempt: run.attempt,
        model_version: run.model_version,
        outcome: run.outcome,
        created_at: Some(timestamp(run.created_at)),
        started_at: run.started_at.map(timestamp),
        ended_at: run.ended_at.map(timestamp),
        ..own(run.subject, run.options, run.report)
    }
}

impl From<TrainingReport> for proto::TrainingReport {
    fn from(report: TrainingReport) -> Self {
        let text = report.to_string();
        Self {
            candidates: report.candidates.into_iter().map(Into::into).collect(),
            advice: report.advice,
            text,
        }
    }
}

impl From<CandidateFinding> for proto::CandidateFinding {
    fn from(finding: CandidateFinding) -> Self {
        Self {
            candidate: finding.candidate,
            weight: finding.weight,
            held_out_miss_m: finding.held_out_miss_m,
            coverage95_of_fixes: finding.coverage95_of_fixes,
            summary: finding.summary,
        }
    }
}

impl From<JobState> for proto::TrainingRunState {
    fn from(state: JobState) -> Self {
        match state {
            JobState::Queued => Self::Queued,
            JobState::Running => Self::Running,
            JobState::Cancelling => Self::Cancelling,
            JobState::Succeeded => Self::Succeeded,
            JobState::Failed => Self::Failed,
            JobState::Cancelled => Self::Cancelled,
        }
    }
}

impl From<RunProgress> for proto::TrainingProgress {
    fn from(progress: RunProgress) -> Self {
        Self {
            phase: progress.phase,
            epoch: progress.epoch,
            epochs: progress.epochs,
            reconstruction_error: progress.reconstruction_error,
            regression_error: progress.regression_error,
            error_scale: progress.error_scale,
            remaining_s: progress.remaining_s,
        }
    }
}

impl From<SiteTrainingReport> for proto::SiteTrainingReport {
    fn from(report: SiteTrainingReport) -> Self {
        let text = report.to_string();
        Self {
            is_activated: report.is_activated,
            receivers: report.receivers,
            pairs: report.pairs,
            disagreement_m: report.disagreement_m,
            disagreement_apart_m: report.disagreement_apart_m,
            cameras: report.cameras.into_iter().map(Into::into).collect(),
            text,
        }
    }
}

impl From<SiteCameraFinding> for proto::SiteCameraFinding {
    fn from(finding: SiteCameraFinding) -> Self {
        Self {
            camera_id: finding.camera_id,
            model_version: finding.model_version,
            samples: finding.samples,
            held_out_m: finding.held_out_m,
            held_out_apart_m: finding.held_out_apart_m,
            coverage95_of_fixes: finding.coverage95_of_fixes,
            comparison: finding.comparison,
        }
    }
}
