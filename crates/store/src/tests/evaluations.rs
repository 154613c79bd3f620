use std::time::Duration;

use super::*;
use crate::domain::{
    EvaluationId, EvaluationJob, EvaluationPlan, EvaluationProgress, JobState, Method, SigmaM, TimeRange,
    Truth,
};
use crate::{Claim, Heartbeat, JobEnd, SampleFilter};

const LEASE: Duration = Duration::from_secs(30);

/// The nth evaluation's id; ids sort by n.
fn nth(n: u128) -> EvaluationId {
    EvaluationId(Uuid::from_u128(n))
}

fn place(longitude_deg: f64) -> Position {
    Position::new(longitude_deg, 30.1 + 1e-13).expect("a place")
}

fn plan(truth: Truth) -> EvaluationPlan {
    EvaluationPlan {
        train: TimeRange::new(None, Some(at(5))).expect("a range"),
        test: TimeRange::new(Some(at(5)), Some(at(9))).expect("a range"),
        truth,
        methods: Method::list("track,gnss,paper.two_step").expect("names"),
        recipe: Recipe::Paper,
        seeds: 3,
        box_shift_px: 0.1,
        gnss_sigma: Some(SigmaM::new(2.2).expect("a sigma")),
    }
}

impl Fixture {
    async fn queue_evaluation(&self, n: u128) -> EvaluationJob {
        let plan = plan(Truth::Columns);
        self.store.insert_evaluation(nth(n), &self.camera, &plan, 9, at(1)).await.expect("queued")
    }

    async fn claim_evaluation(&self, second: i64) -> Claim<EvaluationJob> {
        self.store.claim_evaluation(LEASE, at(second)).await.expect("works").expect("an evaluation")
    }

    async fn heartbeat_evaluation(&self, fence: i64, second: i64) -> Heartbeat {
        let progress = progress();
        self.store.heartbeat_evaluation(nth(1), fence, &progress, LEASE, at(second)).await.expect("works")
    }

    async fn finish_evaluation(&self, fence: i64, end: JobEnd<String>) -> Option<EvaluationJob> {
        self.store.finish_evaluation(nth(1), fence, end, at(50)).await.expect("works")
    }

    async fn report(&self) -> Option<String> {
        self.store.evaluation_report(nth(1)).await.expect("known")
    }
}

fn progress() -> EvaluationProgress {
    EvaluationProgress { phase: "gnss, seed 2".to_owned(), steps_done: 3, steps: 7, remaining_s: Some(1.5) }
}

fn success() -> JobEnd<String> {
    JobEnd::Succeeded { output: "{\"methods\":{}}".to_owned(), outcome: None }
}

#[tokio::test]
async fn every_plan_comes_back_as_it_was() {
    let fixture = Fixture::new().await;
    let lines = vec![vec![place(120.1), place(120.3)], vec![place(1.0 / 3.0), place(0.1), place(0.2)]];
    let bare = EvaluationPlan {
        train: TimeRange::default(),
        gnss_sigma: None,
        ..plan(Truth::Point(place(1.0 / 7.0)))
    };
    for (n, plan) in (1..).zip([plan(Truth::Columns), plan(Truth::Lines(lines)), bare]) {
        let queued = fixture.store.insert_evaluation(nth(n), &fixture.camera, &plan, 9, at(1)).await;
        let queued = queued.expect("queued");
        assert_eq!((&queued.plan, queued.state, queued.attempt), (&plan, JobState::Queued, 0));
        assert_eq!(fixture.store.evaluation(nth(n)).await.expect("known"), queued);
    }
}

#[tokio::test]
async fn an_evaluation_goes_from_queue_to_report() {
    let fixture = Fixture::new().await;
    fixture.queue_evaluation(1).await;
    let Claim { job, fence, cancel_requested } = fixture.claim_evaluation(2).await;
    assert_eq!((job.state, job.attempt, job.started_at), (JobState::Running, 1, Some(at(2))));
    assert!(!cancel_requested);
    assert!(fixture.store.claim_evaluation(LEASE, at(3)).await.expect("works").is_none(), "it is taken");
    assert!(
        fixture.store.claim_run::<CameraId>(LEASE, at(3)).await.expect("works").is_none(),
        "it is no training run"
    );
    assert_eq!(fixture.heartbeat_evaluation(fence, 4).await, Heartbeat::Continue);
    assert_eq!(fixture.store.evaluation(nth(1)).await.expect("known").progress, progress());
    assert_eq!(fixture.report().await, None);
    let ended = fixture.finish_evaluation(fence, success()).await.expect("still mine");
    assert_eq!((ended.state, ended.ended_at), (JobState::Succeeded, Some(at(50))));
    assert_eq!(ended.progress.remaining_s, None, "nothing is left");
    assert_eq!(fixture.report().await.as_deref(), Some("{\"methods\":{}}"));
    assert_eq!(fixture.heartbeat_evaluation(fence, 51).await, Heartbeat::Lost);
    assert!(fixture.finish_evaluation(fence, JobEnd::Requeue).await.is_none(), "it ends once");
}

#[tokio::test]
async fn a_worker_without_a_lease_cannot_store_a_report() {
    let fixture = Fixture::new().await;
    fixture.queue_evaluation(1).await;
    let old = fixture.claim_evaluation(2).await;
    assert_eq!(fixture.heartbeat_evaluation(old.fence, 3).await, Heartbeat::Continue);
    assert!(fixture.store.claim_evaluation(LEASE, at(32)).await.expect("works").is_none(), "the lease holds");
    fixture.let_leases_expire().await;
    let new = fixture.claim_evaluation(33).await;
    assert_eq!((new.job.attempt, new.fence), (2, old.fence + 1));
    assert_eq!(new.job.progress, EvaluationProgress::default(), "its progress is reset");
    assert_eq!(fixture.heartbeat_evaluation(old.fence, 34).await, Heartbeat::Lost);
    assert_eq!(fixture.store.evaluation(nth(1)).await.expect("known").progress, new.job.progress);
    assert!(fixture.finish_evaluation(old.fence, success()).await.is_none());
    assert_eq!(fixture.report().await, None);
    assert!(fixture.finish_evaluation(new.fence, success()).await.is_some());
}

#[tokio::test]
async fn what_was_cancelled_has_no_report() {
    let fixture = Fixture::new().await;
    let store = &fixture.store;
    fixture.queue_evaluation(1).await;
    let cancelled = store.cancel_evaluation(nth(1), at(5)).await.expect("cancelled");
    assert_eq!((cancelled.state, cancelled.ended_at), (JobState::Cancelled, Some(at(5))));
    assert_eq!(kind(store.cancel_evaluation(nth(1), at(6)).await), ErrorKind::EvaluationEnded);
    assert_eq!(kind(store.cancel_evaluation(nth(9), at(6)).await), ErrorKind::EvaluationNotFound);
    assert!(store.claim_evaluation(LEASE, at(7)).await.expect("works").is_none());

    fixture.queue_evaluation(2).await;
    let claim = fixture.claim_evaluation(8).await;
    assert_eq!(store.cancel_evaluation(nth(2), at(9)).await.expect("flagged").state, JobState::Cancelling);
    let beat = store.heartbeat_evaluation(nth(2), claim.fence, &progress(), LEASE, at(10)).await;
    assert_eq!(beat.expect("works"), Heartbeat::CancelRequested);
    let ended = store.finish_evaluation(nth(2), claim.fence, success(), at(11)).await.expect("works");
    assert_eq!(ended.expect("mine").state, JobState::Cancelled);
    assert_eq!(store.evaluation_report(nth(2)).await.expect("known"), None);
}

#[tokio::test]
async fn one_returned_to_the_queue_is_claimed_at_once_and_one_deleted_never() {
    let fixture = Fixture::new().await;
    fixture.queue_evaluation(1).await;
    let first = fixture.claim_evaluation(2).await;
    let back = fixture.finish_evaluation(first.fence, JobEnd::Requeue).await.expect("mine");
    assert_eq!((back.state, back.ended_at), (JobState::Queued, None));
    let second = fixture.claim_evaluation(4).await;
    assert_eq!(second.job.attempt, 1);
    fixture.store.delete_evaluation(nth(1), at(9)).await.expect("known");
    assert_eq!(fixture.heartbeat_evaluation(second.fence, 5).await, Heartbeat::Lost);
    assert!(fixture.finish_evaluation(second.fence, success()).await.is_none());
    for gone in [
        kind(fixture.store.delete_evaluation(nth(1), at(9)).await),
        kind(fixture.store.evaluation(nth(1)).await),
        kind(fixture.store.evaluation_report(nth(1)).await),
    ] {
        assert_eq!(gone, ErrorKind::EvaluationNotFound);
    }
}

#[tokio::test]
async fn the_server_has_a_limit_and_a_camera_takes_its_own_along() {
    let fixture = Fixture::new().await;
    let (store, other) = (&fixture.store, id("other"));
    let plan = plan(Truth::Columns);
    assert_eq!(
        kind(store.insert_evaluation(nth(1), &other, &plan, 9, at(1)).await),
        ErrorKind::CameraNotFound
    );
    store.insert_camera(&NewCamera::named(other.clone()), at(0)).await.expect("new");
    for n in 1..=3 {
        fixture.queue_evaluation(n).await;
    }
    assert_eq!(kind(store.insert_evaluation(nth(4), &other, &plan, 3, at(1)).await), ErrorKind::Overloaded);
    store.insert_evaluation(nth(4), &other, &plan, 4, at(1)).await.expect("queued");

    let ids = async |camera: Option<&CameraId>, before, limit| {
        let page = store.evaluations(camera, before, limit).await.expect("a page");
        page.iter().map(|job| job.id).collect::<Vec<_>>()
    };
    assert_eq!(ids(None, None, 2).await, [4, 3].map(nth), "newest first");
    assert_eq!(ids(None, Some(nth(3)), 9).await, [2, 1].map(nth));
    assert_eq!(ids(Some(&fixture.camera), None, 9).await, [3, 2, 1].map(nth));
    assert_eq!(kind(store.evaluations(Some(&id("none")), None, 9).await), ErrorKind::CameraNotFound);

    assert_eq!(fixture.claim_evaluation(2).await.job.id, nth(1), "the oldest first");
    store.delete_camera(&fixture.camera, None, at(9)).await.expect("deleted");
    assert_eq!(ids(None, None, 9).await, [nth(4)]);
}

#[tokio::test]
async fn samples_are_found_by_their_place_and_truths_counted() {
    let fixture = Fixture::new().await;
    let store = &fixture.store;
    let samples = (0..10).map(|n| {
        let truth = (n % 3 == 0).then(|| place(120.0));
        Sample { truth, ..sample(n / 2, if n % 2 == 0 { "a" } else { "b" }) }
    });
    store.insert_samples(&fixture.camera, samples.collect(), Durability::Synced).await.expect("stored");
    let time = async |before| store.sample_time(&fixture.camera, before).await.expect("works");
    assert_eq!(time(0).await, Some(at(0)));
    assert_eq!((time(3).await, time(4).await), (Some(at(1)), Some(at(2))));
    assert_eq!((time(9).await, time(10).await), (Some(at(4)), None));
    let count = async |filter| store.count_truths(&fixture.camera, &filter).await.expect("works");
    assert_eq!(count(SampleFilter::default()).await, 4);
    let late = TimeRange::new(Some(at(3)), None).expect("a range");
    assert_eq!(count(SampleFilter::within(late)).await, 2, "the seventh and the tenth");
}
