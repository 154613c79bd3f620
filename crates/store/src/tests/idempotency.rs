use super::*;
use crate::domain::IdempotencyKey;
use crate::{IdempotencyRecord, StoreLimits};

const DAY_S: i64 = 86_400;

async fn open(limits: StoreLimits) -> (Home, Store) {
    let home = Home::new().await;
    let options = StoreOptions { limits, ..StoreOptions::default() };
    let store = Store::open_at(&home.location(), options).await.expect("opens");
    store.insert_camera(&NewCamera::named(id("square")), at(0)).await.expect("new");
    (home, store)
}

/// The run that is there after run `n` was asked for under a key; a new one is cancelled at once.
async fn ask(store: &Store, n: u128, key: &str, second: i64) -> RunId {
    let record =
        IdempotencyRecord { key: IdempotencyKey::new(key).expect("a key"), digest: [key.as_bytes()[0]; 32] };
    let camera = id("square");
    let run =
        store.insert_run(run_id(n), &camera, &options(), 9, Some(&record), at(second)).await.expect("a run");
    if run.id == run_id(n) {
        store.cancel_run(&camera, run.id, at(second)).await.expect("queued");
    }
    run.id
}

#[tokio::test]
async fn a_clock_that_was_ahead_takes_no_stored_answer_away() {
    let (_home, store) = open(StoreLimits { idempotency_key_s: 86_400, ..StoreLimits::default() }).await;
    assert_eq!(ask(&store, 1, "tonight", 0).await, run_id(1));
    assert_eq!(ask(&store, 2, "other", 400 * DAY_S).await, run_id(2));
    assert_eq!(ask(&store, 3, "tonight", 1).await, run_id(1));
}

#[tokio::test]
async fn an_answer_that_has_expired_gives_way_to_the_next_under_its_key() {
    let (_home, store) = open(StoreLimits { idempotency_key_s: 0, ..StoreLimits::default() }).await;
    assert_eq!(ask(&store, 1, "tonight", 0).await, run_id(1));
    assert_eq!(ask(&store, 2, "tonight", 1).await, run_id(2));
}
