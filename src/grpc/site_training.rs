//! Training runs of sites as messages.

use super::convert::timestamp;
use super::proto;
use crate::domain::{SiteCameraFinding, SiteId, SiteTrainingReport, TrainingRun};

impl From<TrainingRun<SiteId>> for proto::SiteTrainingRun {
    fn from(run: TrainingRun<SiteId>) -> Self {
        Self {
            id: run.id.to_string(),
            site_id: run.subject.as_str().to_owned(),
            seed: run.options.seed,
            from: run.options.from.map(timestamp),
            until: run.options.until.map(timestamp),
            state: proto::TrainingRunState::from(run.state).into(),
            progress: Some(run.progress.into()),
            attempt: run.attempt,
            report: run.report.map(Into::into),
            outcome: run.outcome,
            created_at: Some(timestamp(run.created_at)),
            started_at: run.started_at.map(timestamp),
            ended_at: run.ended_at.map(timestamp),
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
