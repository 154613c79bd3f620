use std::time::Duration;

use super::*;
use crate::domain::{
    Actor, AuditAction, Camera, CameraChange, IdempotencyKey, JobState, NewSite, RequestHasher, RunProgress,
    SiteCameraFinding, SiteId, SiteTrainingOptions, SiteTrainingReport, TrainingRun,
};
use crate::{Claim, Heartbeat, IdempotencyRecord, NewModel, SiteCameraOutput, SiteRunEnd, SiteRunOutput};

const LEASE: Duration = Duration::from_secs(30);

fn site() -> SiteId {
    SiteId::new("yard").expect("a slug")
}

/// A store with the site `yard` and its cameras `east` and `west`.
async fn with_site() -> (Fixture, Vec<Camera>) {
    let fixture = Fixture::new().await;
    fixture.store.insert_site(&NewSite::named(site()), at(0)).await.expect("new");
    let mut cameras = Vec::new();
    for name in ["east", "west"] {
        let profile = NewCamera { site: Some(site()), ..NewCamera::named(id(name)) };
        cameras.push(fixture.store.insert_camera(&profile, at(0)).await.expect("new"));
    }
    (fixture, cameras)
}

impl Fixture {
    async fn queue_site(&self, n: u128) -> TrainingRun<SiteId> {
        let options = SiteTrainingOptions { seed: u64::MAX, from: Some(at(1)), until: None };
        self.store.insert_run(run_id(n), &site(), &options, 9, None, at(1)).await.expect("queued")
    }

    async fn claim_site(&self, second: i64) -> Claim<TrainingRun<SiteId>> {
        self.store.claim_run::<SiteId>(LEASE, at(second)).await.expect("works").expect("a run")
    }

    async fn finish_site(&self, fence: i64, end: SiteRunEnd<'_>) -> Option<TrainingRun<SiteId>> {
        self.store.finish_run::<SiteId>(run_id(1), fence, end, at(50)).await.expect("works")
    }

    async fn active(&self) -> Vec<(CameraId, u32)> {
        self.store.active_models().await.expect("known")
    }
}

fn success<'a>(cameras: &'a [Camera], metadata: &'a ModelMetadata, is_activated: bool) -> SiteRunEnd<'a> {
    let finding = |camera: &Camera| SiteCameraFinding {
        camera_id: camera.id().as_str().to_owned(),
        model_version: 0,
        samples: 20,
        held_out_m: 3.0,
        held_out_apart_m: None,
        coverage95_of_fixes: 0.95,
        comparison: "it had none".to_owned(),
    };
    let output = |camera: &'a Camera| SiteCameraOutput {
        camera: camera.id(),
        key: camera.key,
        compared_with: camera.active_model,
        model: NewModel { metadata, weights: b"weights", held_out: &[] },
    };
    let report = SiteTrainingReport {
        is_activated,
        receivers: 7,
        pairs: 70,
        disagreement_m: Some(0.2),
        disagreement_apart_m: Some(0.5),
        cameras: cameras.iter().map(finding).collect(),
    };
    let output = SiteRunOutput { report, models: cameras.iter().map(output).collect() };
    SiteRunEnd::Succeeded { output, outcome: Some("better".to_owned()) }
}

#[tokio::test]
async fn the_versions_of_all_cameras_become_active_together() {
    let (fixture, cameras) = with_site().await;
    let queued = fixture.queue_site(1).await;
    assert_eq!((queued.state, queued.attempt, queued.options.seed), (JobState::Queued, 0, u64::MAX));
    let counts = fixture.store.job_counts().await.expect("known").training;
    assert_eq!((counts.queued, counts.running), (1, 0));
    let Claim { job: run, fence, .. } = fixture.claim_site(2).await;
    assert_eq!((run.state, run.attempt, run.started_at), (JobState::Running, 1, Some(at(2))));
    assert!(fixture.store.claim_run::<SiteId>(LEASE, at(3)).await.expect("works").is_none(), "it is taken");
    let progress =
        RunProgress { phase: "final fit".to_owned(), epoch: 1, epochs: 2, ..RunProgress::default() };
    let beat = fixture.store.heartbeat_run::<SiteId>(run_id(1), fence, &progress, LEASE, at(4)).await;
    assert_eq!(beat.expect("works"), Heartbeat::Continue);
    assert_eq!(fixture.store.run(&site(), run_id(1)).await.expect("known").progress, progress);

    let metadata = metadata();
    let ended = fixture.finish_site(fence, success(&cameras, &metadata, true)).await.expect("still mine");
    assert_eq!((ended.state, ended.outcome.as_deref()), (JobState::Succeeded, Some("better")));
    let report = ended.report.expect("it is stored");
    assert_eq!(report.cameras.iter().map(|own| own.model_version).collect::<Vec<_>>(), [1, 1]);
    assert_eq!(fixture.active().await, [(id("east"), 1), (id("west"), 1)]);
    assert!(fixture.finish_site(fence, SiteRunEnd::Requeue).await.is_none(), "a run ends once");
    let log = fixture.store.audit_log(Some(&id("west")), None, 9).await.expect("known");
    assert!(log.iter().any(|entry| entry.action == AuditAction::ModelActivated), "{log:?}");
    let page = fixture.store.runs(&site(), None, 9).await.expect("a page");
    assert_eq!(page.iter().map(|run| run.id).collect::<Vec<_>>(), [run_id(1)]);
}

#[tokio::test]
async fn nothing_is_stored_if_a_camera_is_another_than_the_run_has_read() {
    let metadata = metadata();
    let (fixture, cameras) = with_site().await;
    fixture.queue_site(1).await;
    let fence = fixture.claim_site(2).await.fence;
    let version = fixture.store.insert_model(&id("west"), &metadata, b"other", at(3)).await.expect("stored");
    fixture.store.activate_model(&id("west"), version.number, at(3)).await.expect("activated");
    let ended = fixture.finish_site(fence, success(&cameras, &metadata, true)).await.expect("still mine");
    let outcome = ended.outcome.expect("a reason");
    assert!(ended.state == JobState::Failed && outcome.contains("west became active"), "{outcome}");
    assert!(ended.report.is_none());
    assert_eq!(fixture.store.models(&id("east"), None, 9).await.expect("a page"), []);
    assert_eq!(fixture.active().await, [(id("west"), 1)]);

    let (fixture, cameras) = with_site().await;
    fixture.queue_site(1).await;
    let fence = fixture.claim_site(2).await.fence;
    let left = CameraChange { site: Some(None), ..CameraChange::default() }.apply(cameras[0].profile.clone());
    fixture.store.replace_camera(&left.expect("valid"), None, at(3)).await.expect("changed");
    let ended = fixture.finish_site(fence, success(&cameras, &metadata, true)).await.expect("still mine");
    assert!(ended.state == JobState::Failed && fixture.active().await.is_empty(), "{:?}", ended.outcome);

    let (fixture, cameras) = with_site().await;
    fixture.queue_site(1).await;
    let fence = fixture.claim_site(2).await.fence;
    fixture.store.delete_camera(&id("east"), None, at(3)).await.expect("deleted");
    let ended = fixture.finish_site(fence, success(&cameras, &metadata, true)).await.expect("still mine");
    assert!(ended.state == JobState::Failed && fixture.active().await.is_empty(), "{:?}", ended.outcome);
}

#[tokio::test]
async fn a_worker_that_lost_its_lease_or_was_cancelled_activates_nothing() {
    let metadata = metadata();
    let (fixture, cameras) = with_site().await;
    fixture.queue_site(1).await;
    let old = fixture.claim_site(2).await;
    fixture.let_leases_expire().await;
    let new = fixture.claim_site(33).await;
    assert_eq!((new.job.attempt, new.fence), (2, old.fence + 1));
    assert!(fixture.finish_site(old.fence, success(&cameras, &metadata, true)).await.is_none());
    assert!(fixture.active().await.is_empty());
    let cancelling = fixture.store.cancel_run(&site(), run_id(1), at(34)).await.expect("live");
    assert_eq!(cancelling.state, JobState::Cancelling);
    let ended = fixture.finish_site(new.fence, success(&cameras, &metadata, true)).await.expect("mine");
    assert_eq!(ended.state, JobState::Cancelled);
    assert!(fixture.active().await.is_empty() && ended.report.is_none());
    let again = fixture.store.cancel_run(&site(), run_id(1), at(51)).await;
    assert_eq!(kind(again), ErrorKind::RunEnded);
}

#[tokio::test]
async fn a_site_has_one_live_run_and_a_repeated_request_gets_it() {
    let (fixture, _) = with_site().await;
    let store = fixture.store.on_behalf_of(Arc::new(Actor::program("test")));
    let options = SiteTrainingOptions::default();
    let hasher = RequestHasher::default();
    hasher.update(b"the request");
    let key = IdempotencyKey::new("tonight").expect("a key");
    let record = IdempotencyRecord { key, digest: hasher.digest() };
    let first = store.insert_run(run_id(1), &site(), &options, 9, Some(&record), at(1)).await;
    let again = store.insert_run(run_id(2), &site(), &options, 9, Some(&record), at(2)).await;
    assert_eq!(first.expect("queued"), again.expect("the first"));
    let other = store.insert_run(run_id(2), &site(), &options, 9, None, at(2)).await;
    assert_eq!(kind(other), ErrorKind::RunLive);
    let nowhere = SiteId::new("nowhere").expect("a slug");
    assert_eq!(
        kind(store.insert_run(run_id(2), &nowhere, &options, 9, None, at(2)).await),
        ErrorKind::SiteNotFound
    );
    assert_eq!(kind(store.run(&site(), run_id(7)).await), ErrorKind::RunNotFound);
    store.cancel_run(&site(), run_id(1), at(3)).await.expect("queued");
    assert_eq!(
        kind(store.insert_run(run_id(2), &site(), &options, 0, None, at(3)).await),
        ErrorKind::Overloaded
    );
}
