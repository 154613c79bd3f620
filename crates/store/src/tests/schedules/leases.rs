//! Workers that claim, renew and end a training run, one of which may be stopped for longer than its lease at any step.

use std::sync::atomic::{AtomicI64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::runtime::Runtime;

use super::{fixture, runtime};
use crate::domain::{CameraId, NewCamera, RunProgress};
use crate::tests::{Fixture, at, metadata, options, run_id};
use crate::{Heartbeat, NewModel, RunEnd, RunOutput};
use sightfix_schedules::{below, explore, explore_planted, pause};

const LEASE_S: i64 = 4;
const LEASE: Duration = Duration::from_secs(LEASE_S as u64);
const WORKERS: usize = 3;
/// A worker gives up after so many claims.
const CLAIMS: usize = 4;
/// Steps of the clock, 1 or 2 s each.
const TICKS: usize = 12;

/// An error of the workers or of the store.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Planted {
    None,
    /// A worker ends a run without showing its own fence: the stolen lease.
    FinishWithoutFence,
    /// The clock of one worker is ahead, and decides about leases.
    ClockAhead,
}

struct Case {
    fixture: Fixture,
    runtime: Runtime,
    /// Number of the run of the current schedule.
    runs: AtomicUsize,
}

/// What one schedule has seen.
#[derive(Default)]
struct Seen {
    clock: AtomicI64,
    /// The worker that claimed last, its fence, and when it last showed that it is alive.
    holder: Mutex<Option<(usize, i64, i64)>>,
    ends: AtomicUsize,
}

impl Case {
    fn new() -> Arc<Self> {
        let runtime = runtime();
        let fixture = fixture(&runtime);
        Arc::new(Self { fixture, runtime, runs: AtomicUsize::new(0) })
    }

    /// One call of the store: one step of the schedule.
    fn call<T>(&self, call: impl Future<Output = crate::domain::Result<T>>) -> T {
        self.runtime.block_on(call).expect("the store works")
    }
}

async fn worker(case: Arc<Case>, seen: Arc<Seen>, run: u128, number: usize, planted: Planted) {
    let store = &case.fixture.store;
    let ahead_s = if planted == Planted::ClockAhead && number == 0 { LEASE_S } else { 0 };
    for _ in 0..CLAIMS {
        // Between the reading of the clock and the call anything may happen.
        let now_s = seen.clock.load(Ordering::Relaxed);
        pause().await;
        let claimed = case.call(store.claim_run::<CameraId>(LEASE, at(now_s + ahead_s)));
        let Some(claim) = claimed.filter(|claim| claim.job.id == run_id(run)) else { continue };
        let before = seen.holder.lock().expect("no panic").replace((number, claim.fence, now_s));
        if let Some((_, fence, alive_s)) = before {
            assert!(fence < claim.fence, "a fence is given out twice");
            assert!(now_s >= alive_s + LEASE_S, "a live run is taken over");
        }
        if is_lost(&case, &seen, run, (number, claim.fence)).await {
            continue;
        }
        let current = || *seen.holder.lock().expect("no panic");
        let fence = match planted {
            Planted::FinishWithoutFence => current().map_or(claim.fence, |(_, fence, _)| fence),
            Planted::None | Planted::ClockAhead => claim.fence,
        };
        let metadata = metadata();
        let model = NewModel { metadata: &metadata, weights: b"weights", held_out: &[] };
        let end = match below(4) {
            0 => RunEnd::Requeue,
            1 => RunEnd::Failed { outcome: "no".to_owned() },
            _ => RunEnd::Succeeded { output: RunOutput { model, activate: true }, outcome: None },
        };
        let is_requeue = matches!(end, RunEnd::Requeue);
        let now_s = seen.clock.load(Ordering::Relaxed);
        let ended = case.call(store.finish_run::<CameraId>(run_id(run), fence, end, at(now_s)));
        if ended.is_some() {
            let holder = current().map(|(holder, ..)| holder);
            assert_eq!(holder, Some(number), "a run is ended by a worker that has lost it");
            *seen.holder.lock().expect("no panic") = None;
            seen.ends.fetch_add(usize::from(!is_requeue), Ordering::Relaxed);
        }
        pause().await;
    }
}

/// Works and renews the lease; true if it is lost, or the worker dies.
async fn is_lost(case: &Case, seen: &Seen, run: u128, (number, fence): (usize, i64)) -> bool {
    for _ in 0..below(4) {
        pause().await;
        if below(8) == 0 {
            return true;
        }
        let now_s = seen.clock.load(Ordering::Relaxed);
        pause().await;
        let progress = RunProgress::default();
        let store = &case.fixture.store;
        let beat =
            case.call(store.heartbeat_run::<CameraId>(run_id(run), fence, &progress, LEASE, at(now_s)));
        let mut holder = seen.holder.lock().expect("no panic");
        match (&mut *holder, beat) {
            (_, Heartbeat::Lost) => return true,
            (Some((holder, _, alive_s)), _) if *holder == number => *alive_s = now_s.max(*alive_s),
            (holder, _) => panic!("a lease that {holder:?} has is renewed"),
        }
    }
    pause().await;
    false
}

fn scenario(case: &Arc<Case>, planted: Planted) {
    let run = case.runs.fetch_add(1, Ordering::Relaxed) as u128 + 1;
    let (fixture, case) = (&case.fixture, Arc::clone(case));
    case.call(fixture.store.insert_run(run_id(run), &fixture.camera, &options(), 9, None, at(0)));
    let seen = Arc::new(Seen::default());
    sightfix_schedules::block_on(async {
        let workers: Vec<_> = (0..WORKERS)
            .map(|number| {
                sightfix_schedules::spawn(worker(Arc::clone(&case), Arc::clone(&seen), run, number, planted))
            })
            .collect();
        for _ in 0..TICKS {
            pause().await;
            seen.clock.fetch_add(1 + below(2) as i64, Ordering::Relaxed);
        }
        for worker in workers {
            worker.await.expect("no panic");
        }
    });
    let stored = case.call(fixture.store.run(&fixture.camera, run_id(run)));
    let ends = seen.ends.load(Ordering::Relaxed);
    assert_eq!(usize::from(stored.state.has_ended()), ends, "a run ends once: {:?}", stored.state);
    let versions = case.call(fixture.store.models(&fixture.camera, None, 9));
    assert_eq!(
        versions.iter().filter(|version| version.run_id == Some(run_id(run))).count(),
        usize::from(stored.model_version.is_some()),
        "a version belongs to a run that succeeded"
    );
    // A camera with a live run is not deleted.
    case.runtime.block_on(fixture.tamper("DELETE FROM training_runs WHERE state IN ('queued', 'running')"));
    case.call(fixture.store.delete_camera(&fixture.camera, None, at(0)));
    case.call(fixture.store.insert_camera(&NewCamera::named(fixture.camera.clone()), at(0)));
}

#[test]
fn a_run_is_ended_once_and_by_the_worker_that_has_it() {
    let case = Case::new();
    explore(move || scenario(&case, Planted::None));
}

#[test]
fn a_stolen_lease_is_found() {
    let case = Case::new();
    let found = "a run is ended by a worker that has lost it";
    explore_planted(found, move || scenario(&case, Planted::FinishWithoutFence));
}

#[test]
fn a_clock_that_takes_live_runs_is_found() {
    let case = Case::new();
    explore_planted("a live run is taken over", move || scenario(&case, Planted::ClockAhead));
}
