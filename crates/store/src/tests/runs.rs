use std::time::Duration;

use super::*;
use crate::domain::{Actor, EpochReport, JobState, RunProgress, TrainingRun};
use crate::{Claim, Heartbeat, NewModel, RunEnd, RunOutput};

const LEASE: Duration = Duration::from_secs(30);

impl Fixture {
    async fn queue(&self, n: u128) -> TrainingRun<CameraId> {
        self.store.insert_run(run_id(n), &self.camera, &options(), 9, None, at(1)).await.expect("queued")
    }

    async fn claim(&self, second: i64) -> Claim<TrainingRun<CameraId>> {
        self.store.claim_run::<CameraId>(LEASE, at(second)).await.expect("works").expect("a run")
    }

    async fn heartbeat(&self, fence: i64, second: i64) -> Heartbeat {
        self.store
            .heartbeat_run::<CameraId>(run_id(1), fence, &progress(), LEASE, at(second))
            .await
            .expect("works")
    }

    async fn finish(&self, fence: i64, end: RunEnd<'_>) -> Option<TrainingRun<CameraId>> {
        self.store.finish_run::<CameraId>(run_id(1), fence, end, at(50)).await.expect("works")
    }
}

fn progress() -> RunProgress {
    RunProgress {
        phase: "final fit".to_owned(),
        epoch: 3,
        epochs: 7,
        reconstruction_error: 0.1,
        regression_error: f64::INFINITY,
        error_scale: 0.3,
        remaining_s: Some(1.5),
    }
}

fn success<'a>(metadata: &'a ModelMetadata, activate: bool) -> RunEnd<'a> {
    let model = NewModel { metadata, weights: b"weights", held_out: &[] };
    RunEnd::Succeeded { output: RunOutput { model, activate }, outcome: Some("better".to_owned()) }
}

fn report(epoch: u32, loss: f64) -> EpochReport {
    EpochReport { epoch, loss, reconstruction_error: 0.1, regression_error: 0.2, error_scale: 0.3 }
}

#[tokio::test]
async fn a_run_goes_from_queue_to_active_model() {
    let fixture = Fixture::new().await;
    let queued = fixture.queue(1).await;
    assert_eq!((queued.state, queued.attempt, queued.options), (JobState::Queued, 0, options()));
    let Claim { job: run, fence, cancel_requested } = fixture.claim(2).await;
    assert_eq!((run.state, run.attempt, run.started_at), (JobState::Running, 1, Some(at(2))));
    assert!(!cancel_requested);
    assert!(fixture.store.claim_run::<CameraId>(LEASE, at(3)).await.expect("works").is_none(), "it is taken");
    assert_eq!(fixture.heartbeat(fence, 4).await, Heartbeat::Continue);
    let seen = fixture.store.run(&fixture.camera, run_id(1)).await.expect("known");
    assert_eq!(seen.progress, progress());
    let ended = fixture.finish(fence, success(&metadata(), true)).await.expect("still mine");
    assert_eq!(
        (ended.state, ended.model_version, ended.ended_at),
        (JobState::Succeeded, Some(1), Some(at(50)))
    );
    assert_eq!(ended.outcome.as_deref(), Some("better"));
    assert_eq!(fixture.store.model(&fixture.camera, 1).await.expect("stored").run_id, Some(run_id(1)));
    assert_eq!(fixture.store.active_models().await.expect("known"), [(fixture.camera.clone(), 1)]);
    assert_eq!(fixture.heartbeat(fence, 51).await, Heartbeat::Lost);
    assert!(fixture.finish(fence, RunEnd::Requeue).await.is_none(), "a run ends once");
}

#[tokio::test]
async fn a_worker_that_lost_its_lease_can_write_nothing_more() {
    let fixture = Fixture::new().await;
    fixture.queue(1).await;
    let old = fixture.claim(2).await;
    fixture.store.append_epochs(run_id(1), old.fence, &[report(1, 9.0)]).await.expect("works");
    assert!(
        fixture.store.claim_run::<CameraId>(LEASE, at(31)).await.expect("works").is_none(),
        "the lease holds"
    );
    fixture.let_leases_expire().await;
    let new = fixture.claim(32).await;
    assert_eq!((new.job.attempt, new.fence), (2, old.fence + 1));
    assert_eq!(fixture.store.epochs(run_id(1)).await.expect("known"), [], "a new attempt, a new curve");

    assert_eq!(fixture.heartbeat(old.fence, 33).await, Heartbeat::Lost);
    fixture.store.append_epochs(run_id(1), old.fence, &[report(2, 9.0)]).await.expect("ignored");
    fixture.store.append_log(run_id(1), old.fence, at(33), "old").await.expect("ignored");
    assert!(fixture.finish(old.fence, success(&metadata(), true)).await.is_none());
    assert_eq!(fixture.store.epochs(run_id(1)).await.expect("known"), []);
    assert_eq!(fixture.store.log(run_id(1)).await.expect("known"), []);
    assert_eq!(fixture.store.models(&fixture.camera, None, 9).await.expect("a page"), []);

    assert!(fixture.finish(new.fence, success(&metadata(), false)).await.is_some());
    assert_eq!(fixture.store.active_models().await.expect("known"), [], "it was not to become active");
}

#[tokio::test]
async fn a_camera_has_one_live_run_and_the_server_a_limit() {
    let fixture = Fixture::new().await;
    fixture.queue(1).await;
    let again = fixture.store.insert_run(run_id(2), &fixture.camera, &options(), 9, None, at(1)).await;
    assert_eq!(kind(again), ErrorKind::RunLive);
    let other = id("other");
    let store = &fixture.store;
    assert_eq!(
        kind(store.insert_run(run_id(2), &other, &options(), 9, None, at(1)).await),
        ErrorKind::CameraNotFound
    );
    store.insert_camera(&NewCamera::named(other.clone()), at(0)).await.expect("new");
    assert_eq!(
        kind(store.insert_run(run_id(2), &other, &options(), 1, None, at(1)).await),
        ErrorKind::Overloaded
    );
    store.insert_run(run_id(2), &other, &options(), 2, None, at(1)).await.expect("queued");
    let (first, second) = (fixture.claim(2).await, fixture.claim(2).await);
    assert_eq!((first.job.id, second.job.id), (run_id(1), run_id(2)), "the oldest first");
    assert_eq!(kind(store.run(&other, run_id(1)).await), ErrorKind::RunNotFound);
    assert_eq!(kind(store.run(&id("none"), run_id(1)).await), ErrorKind::CameraNotFound);
    fixture
        .finish(first.fence, RunEnd::Failed { outcome: "too few samples".to_owned() })
        .await
        .expect("mine");
    fixture.queue(3).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn of_claims_at_once_one_gets_the_run() {
    let fixture = Fixture::new().await;
    fixture.queue(1).await;
    let claims: Vec<_> = (0..8)
        .map(|_| {
            let store = fixture.store.clone();
            tokio::spawn(async move { store.claim_run::<CameraId>(LEASE, at(2)).await.expect("works") })
        })
        .collect();
    let mut taken = 0;
    for claim in claims {
        taken += usize::from(claim.await.expect("no panic").is_some());
    }
    assert_eq!(taken, 1);
}

#[tokio::test]
async fn runs_of_clients_are_claimed_before_those_of_the_server_and_each_in_their_order() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let client =
        Actor { address: Some("192.0.2.7".parse().expect("an address")), ..Actor::program("client") };
    let client = store.on_behalf_of(Arc::new(client));
    store.insert_run(run_id(1), &camera, &options(), 9, None, at(1)).await.expect("queued");
    for (n, name) in [(2, "b"), (3, "a")] {
        store.insert_camera(&NewCamera::named(id(name)), at(0)).await.expect("new");
        client.insert_run(run_id(n), &id(name), &options(), 9, None, at(1)).await.expect("queued");
    }
    let mut claimed = Vec::new();
    while let Some(claim) = store.claim_run::<CameraId>(LEASE, at(2)).await.expect("works") {
        claimed.push(claim.job.id);
    }
    assert_eq!(claimed, [run_id(2), run_id(3), run_id(1)]);
}

#[tokio::test]
async fn a_cancelled_run_stores_no_model() {
    let fixture = Fixture::new().await;
    let store = &fixture.store;
    fixture.queue(1).await;
    let cancelled = store.cancel_run(&fixture.camera, run_id(1), at(5)).await.expect("cancelled");
    assert_eq!((cancelled.state, cancelled.ended_at), (JobState::Cancelled, Some(at(5))));
    assert_eq!(kind(store.cancel_run(&fixture.camera, run_id(1), at(6)).await), ErrorKind::RunEnded);
    assert_eq!(kind(store.cancel_run(&fixture.camera, run_id(9), at(6)).await), ErrorKind::RunNotFound);
    assert!(store.claim_run::<CameraId>(LEASE, at(7)).await.expect("works").is_none());

    fixture.queue(2).await;
    let claim = fixture.claim(8).await;
    let flagged = store.cancel_run(&fixture.camera, run_id(2), at(9)).await.expect("flagged");
    assert_eq!(flagged.state, JobState::Cancelling);
    let beat = store.heartbeat_run::<CameraId>(run_id(2), claim.fence, &progress(), LEASE, at(10)).await;
    assert_eq!(beat.expect("works"), Heartbeat::CancelRequested);
    fixture.let_leases_expire().await;
    let taken_over = fixture.claim(100).await;
    assert!(taken_over.cancel_requested, "the request outlives the worker");
    let ended =
        store.finish_run::<CameraId>(run_id(2), taken_over.fence, success(&metadata(), true), at(101)).await;
    assert_eq!(ended.expect("works").expect("mine").state, JobState::Cancelled);
    assert_eq!(store.models(&fixture.camera, None, 9).await.expect("a page"), []);
}

#[tokio::test]
async fn a_run_returned_to_the_queue_is_claimed_at_once_and_the_attempt_does_not_count() {
    let fixture = Fixture::new().await;
    fixture.queue(1).await;
    let first = fixture.claim(2).await;
    fixture.store.append_log(run_id(1), first.fence, at(3), "before").await.expect("works");
    let back = fixture.finish(first.fence, RunEnd::Requeue).await.expect("mine");
    assert_eq!((back.state, back.ended_at), (JobState::Queued, None));
    let second = fixture.claim(4).await;
    assert_eq!((second.job.attempt, second.job.progress), (1, RunProgress::default()));
    assert_eq!(fixture.store.log(run_id(1)).await.expect("known"), [(at(3), "before".to_owned())]);
}

#[tokio::test]
async fn curve_and_log_are_stored_within_limits() {
    let fixture = Fixture::new().await;
    let store = &fixture.store;
    fixture.queue(1).await;
    let fence = fixture.claim(2).await.fence;
    let curve: Vec<EpochReport> = (1..=20).map(|epoch| report(epoch, 1.0 / f64::from(epoch))).collect();
    store.append_epochs(run_id(1), fence, &curve[..12]).await.expect("works");
    store.append_epochs(run_id(1), fence, &curve[10..]).await.expect("overlaps");
    assert_eq!(store.epochs(run_id(1)).await.expect("known"), curve);
    store.append_epochs(run_id(1), fence, &[report(21, f64::NAN)]).await.expect("works");
    assert!(store.epochs(run_id(1)).await.expect("known")[20].loss.is_nan(), "a diverged fit can be seen");

    let long = "ö".repeat(3_000);
    for n in 0..1_005 {
        store.append_log(run_id(1), fence, at(n), &format!("{n} {long}")).await.expect("works");
    }
    let log = store.log(run_id(1)).await.expect("known");
    assert_eq!(log.len(), 1_000);
    assert!(log[0].1.starts_with("5 ö") && log[0].0 == at(5));
    assert!(log.iter().all(|(_, line)| line.len() <= 4_000));
    assert_eq!(kind(store.log(run_id(9)).await), ErrorKind::RunNotFound);
    assert_eq!(kind(store.epochs(run_id(9)).await), ErrorKind::RunNotFound);
}

#[tokio::test]
async fn pages_show_the_newest_runs_first() {
    let fixture = Fixture::new().await;
    for n in 1..=5 {
        fixture.queue(n).await;
        fixture.store.cancel_run(&fixture.camera, run_id(n), at(2)).await.expect("cancelled");
    }
    let page = fixture.store.runs(&fixture.camera, None, 3).await.expect("a page");
    assert_eq!(page.iter().map(|run| run.id).collect::<Vec<_>>(), [5, 4, 3].map(run_id));
    let page = fixture.store.runs(&fixture.camera, Some(run_id(3)), 3).await.expect("a page");
    assert_eq!(page.iter().map(|run| run.id).collect::<Vec<_>>(), [2, 1].map(run_id));
}

#[tokio::test]
async fn a_lease_that_ends_much_further_ahead_than_its_length_counts_as_expired() {
    let fixture = Fixture::new().await;
    fixture.queue(1).await;
    let ahead = fixture.claim(1).await;
    fixture.set_clock_back().await;
    let now = fixture.claim(2).await;
    assert_eq!((now.job.attempt, now.fence), (2, ahead.fence + 1));
    assert_eq!(fixture.heartbeat(ahead.fence, 3).await, Heartbeat::Lost);
    assert_eq!(fixture.heartbeat(now.fence, 3).await, Heartbeat::Continue);
    assert!(
        fixture.store.claim_run::<CameraId>(LEASE, at(4)).await.expect("works").is_none(),
        "a sound lease holds"
    );
}

/// A worker reads its clock before its statement: another one may claim or renew in between, at a later time.
#[tokio::test]
async fn a_claim_with_an_earlier_time_takes_no_live_lease() {
    let fixture = Fixture::new().await;
    fixture.queue(1).await;
    let claim = fixture.claim(10).await;
    for second in [9, 5, -40] {
        let stolen = fixture.store.claim_run::<CameraId>(LEASE, at(second)).await.expect("works");
        assert_eq!(stolen, None, "at {second} s");
    }
    assert_eq!(fixture.heartbeat(claim.fence, 20).await, Heartbeat::Continue);
    assert_eq!(fixture.store.claim_run::<CameraId>(LEASE, at(19)).await.expect("works"), None);
    let cancelled = fixture.store.cancel_run(&fixture.camera, run_id(1), at(18)).await.expect("flagged");
    assert_eq!(cancelled.state, JobState::Cancelling, "its worker ends it");
}

#[tokio::test]
async fn a_worker_with_a_longer_lease_keeps_its_run() {
    let fixture = Fixture::new().await;
    fixture.queue(1).await;
    let hour = Duration::from_secs(3_600);
    fixture.store.claim_run::<CameraId>(hour, at(2)).await.expect("works").expect("a run");
    assert!(
        fixture.store.claim_run::<CameraId>(LEASE, at(3)).await.expect("works").is_none(),
        "it is claimed"
    );
}

#[tokio::test]
async fn cancelling_a_run_without_a_live_lease_ends_it_at_once() {
    for is_set_back in [true, false] {
        let fixture = Fixture::new().await;
        fixture.queue(1).await;
        fixture.claim(1).await;
        if is_set_back {
            fixture.set_clock_back().await;
        } else {
            fixture.let_leases_expire().await;
        }
        let cancelled = fixture.store.cancel_run(&fixture.camera, run_id(1), at(2)).await.expect("cancelled");
        assert_eq!(cancelled.state, JobState::Cancelled);
        fixture.queue(2).await;
    }
}
