use std::collections::HashSet;

use proptest::prelude::*;

use super::*;
use crate::{Inserted, SampleFilter};
use tokio::task::JoinHandle;

pub(crate) type Call = JoinHandle<Result<Inserted>>;

pub(crate) fn call(store: &Store, camera: &CameraId, samples: Vec<Sample>) -> Call {
    let (store, camera) = (store.clone(), camera.clone());
    tokio::spawn(async move { store.insert_samples(&camera, samples, Durability::Synced).await })
}

/// Keeps groups of samples from being stored until it is dropped.
pub(crate) async fn hold(store: &Store) -> Box<dyn Send + '_> {
    on_backend!(store, store => store.hold().await)
}

/// Waits until all but the first of this number of calls are queued: they share its transaction.
async fn queued(store: &Store, calls: usize) {
    while on_backend!(store, store => store.waiting()) + 1 < calls {
        tokio::task::yield_now().await;
    }
}

/// Lets groups be stored once this number of calls is queued.
pub(crate) async fn release(store: &Store, held: Box<dyn Send + '_>, calls: usize) {
    queued(store, calls).await;
    drop(held);
}

pub(crate) async fn count(store: &Store, camera: &CameraId) -> u64 {
    store.count_samples(camera, &SampleFilter::default()).await.expect("counted")
}

#[tokio::test]
async fn callers_of_one_transaction_are_each_counted_right() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    store.insert_samples(&camera, vec![sample(0, "old")], Durability::Synced).await.expect("stored");
    let writer = hold(&store).await;
    let calls = vec![
        call(&store, &camera, vec![sample(1, "a")]),
        call(&store, &camera, vec![sample(1, "a")]),
        call(&store, &camera, vec![sample(0, "old"), sample(2, "a")]),
        call(&store, &id("none"), vec![sample(1, "a")]),
        call(&store, &camera, Vec::new()),
        call(&store, &camera, (3..1500).map(|second| sample(second, "a")).collect()),
        call(&store, &camera, vec![sample(1499, "a"), sample(1500, "a"), sample(1500, "a")]),
    ];
    release(&store, writer, calls.len()).await;
    let mut answers = Vec::new();
    for call in calls {
        answers.push(call.await.expect("no panic").map_err(|error| error.kind()));
    }
    let pair: u64 = answers[..2].iter().map(|it| it.expect("stored").accepted).sum();
    assert_eq!(pair, 1, "one of two equal samples is new");
    assert_eq!(answers[2], Ok(Inserted { accepted: 1, duplicate: 1, without_fix: 0, replaced: 0 }));
    assert_eq!(answers[3], Err(ErrorKind::CameraNotFound));
    assert_eq!(answers[4], Ok(Inserted::default()));
    assert_eq!(answers[5], Ok(Inserted { accepted: 1497, duplicate: 0, without_fix: 0, replaced: 0 }));
    assert_eq!(answers[6], Ok(Inserted { accepted: 1, duplicate: 2, without_fix: 0, replaced: 0 }));
    assert_eq!(count(&store, &camera).await, 1 + 1 + 1 + 1497 + 1);
}

#[tokio::test]
async fn a_row_that_fails_fails_only_its_caller() {
    let fixture = Fixture::new().await;
    let (store, camera) = (&fixture.store, &fixture.camera);
    fixture
        .tamper_each(
            "CREATE TRIGGER poison BEFORE INSERT ON samples WHEN NEW.target_id = 'poison' \
             BEGIN SELECT RAISE(ABORT, 'poisoned'); END",
            "ALTER TABLE samples ADD CHECK (target_id <> 'poison')",
        )
        .await;
    let writer = hold(store).await;
    let calls = vec![
        call(store, camera, vec![sample(1, "a")]),
        call(store, camera, vec![sample(2, "a"), sample(2, "poison")]),
        call(store, camera, vec![sample(3, "a"), sample(4, "a")]),
    ];
    release(store, writer, calls.len()).await;
    let mut accepted = Vec::new();
    for call in calls {
        accepted.push(
            call.await.expect("no panic").map(|inserted| inserted.accepted).map_err(|error| error.kind()),
        );
    }
    assert_eq!(accepted, [Ok(1), Err(ErrorKind::Internal), Ok(2)]);
    assert_eq!(count(store, camera).await, 3, "the failed caller's good row is not stored either");
}

#[tokio::test]
async fn cancelled_callers_do_not_disturb_the_others() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let writer = hold(&store).await;
    let gone = call(&store, &camera, vec![sample(1, "a")]);
    let stays = call(&store, &camera, vec![sample(2, "a")]);
    queued(&store, 2).await;
    gone.abort();
    drop(writer);
    assert_eq!(stays.await.expect("no panic").expect("stored").accepted, 1);
    assert_eq!(
        store
            .insert_samples(&camera, vec![sample(3, "a")], Durability::Synced)
            .await
            .expect("stored")
            .accepted,
        1
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn concurrent_callers_lose_and_duplicate_nothing() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    // Every key is inserted by two callers; other rows belong to a camera that is created and deleted.
    let calls: Vec<Call> = (0..2_000).map(|n| call(&store, &camera, vec![sample(n / 2, "a")])).collect();
    let short_lived = id("short-lived");
    for round in 0..20 {
        store.insert_camera(&NewCamera::named(short_lived.clone()), at(round)).await.expect("new");
        let insert = call(&store, &short_lived, vec![sample(round, "a")]);
        store.delete_camera(&short_lived, None, at(9)).await.expect("deleted");
        match insert.await.expect("no panic") {
            Ok(inserted) => assert_eq!(inserted.accepted, 1),
            Err(error) => assert_eq!(error.kind(), ErrorKind::CameraNotFound),
        }
    }
    let mut sum = Inserted::default();
    for call in calls {
        let inserted = call.await.expect("no panic").expect("stored");
        sum.accepted += inserted.accepted;
        sum.duplicate += inserted.duplicate;
    }
    assert_eq!(sum, Inserted { accepted: 1_000, duplicate: 1_000, without_fix: 0, replaced: 0 });
    assert_eq!(count(&store, &camera).await, 1_000);
}

#[tokio::test]
async fn closing_commits_what_is_queued_and_refuses_later_calls() {
    let Fixture { store, camera, folder } = Fixture::new().await;
    let writer = hold(&store).await;
    let calls: Vec<Call> = (0..50).map(|n| call(&store, &camera, vec![sample(n, "a")])).collect();
    release(&store, writer, calls.len()).await;
    store.close().await;
    store.close().await;
    for call in calls {
        assert_eq!(call.await.expect("no panic").expect("stored").accepted, 1);
    }
    assert_eq!(
        kind(store.insert_samples(&camera, vec![sample(99, "a")], Durability::Synced).await),
        ErrorKind::ShuttingDown
    );
    assert_eq!(kind(store.camera(&camera).await), ErrorKind::ShuttingDown);
    assert_eq!(kind(store.roll_back(&camera, at(1)).await), ErrorKind::ShuttingDown);
    assert_eq!(kind(store.ping().await), ErrorKind::ShuttingDown);
    if let Home::Folder(folder) = &folder {
        assert!(!folder.path().join("sightfix.db-wal").exists(), "the log was copied back into the file");
    }
    let again = folder.open().await;
    assert_eq!(count(&again, &camera).await, 50);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// Callers that share a transaction are each counted as if they were served one after another.
    #[test]
    fn sharing_a_transaction_changes_no_count(
        before in prop::collection::vec((0_i64..40, "[ab]"), 0..20),
        calls in prop::collection::vec(prop::collection::vec((0_i64..40, "[ab]"), 0..12), 1..12),
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            let Fixture { store, camera, folder: _folder } = Fixture::new().await;
            let rows = |keys: &[(i64, String)]| keys.iter().map(|(n, who)| sample(*n, who)).collect::<Vec<_>>();
            store.insert_samples(&camera, rows(&before), Durability::Synced).await.expect("stored");
            let writer = hold(&store).await;
            let tasks: Vec<Call> = calls.iter().map(|keys| call(&store, &camera, rows(keys))).collect();
            release(&store, writer, tasks.len()).await;
            let mut known: HashSet<_> = before.into_iter().collect();
            for (task, keys) in tasks.into_iter().zip(calls) {
                let asked = keys.len() as u64;
                let accepted = keys.into_iter().map(|key| u64::from(known.insert(key))).sum();
                let inserted = task.await.expect("no panic").expect("stored");
                prop_assert_eq!(inserted, Inserted { accepted, duplicate: asked - accepted, without_fix: 0, replaced: 0 });
            }
            prop_assert_eq!(count(&store, &camera).await, known.len() as u64);
            Ok(())
        })?;
    }
}
