use std::time::Duration;

use tempfile::TempDir;

use super::{FileStore, file_store, in_folder};
use crate::domain::{Durability, ErrorKind, NewCamera, Sample};
use crate::tests::group::{call, count, hold, release};
use crate::tests::{Fixture, at, kind, sample};
use crate::{Sharing, StoreLimits, StoreOptions};

#[tokio::test]
async fn a_dropped_transaction_is_rolled_back_and_releases_the_writer() {
    let (Fixture { store, camera, .. }, _folder) = in_folder().await;
    {
        let mut writer = file_store(&store).changing(Durability::Synced).await.expect("the writer");
        let mut transaction = writer.begin().await.expect("begins");
        sqlx::query("DELETE FROM cameras").execute(&mut *transaction).await.expect("deletes");
    }
    assert_eq!(
        store
            .insert_samples(&camera, vec![sample(3, "a")], Durability::Synced)
            .await
            .expect("stored")
            .accepted,
        1
    );
    assert_eq!(store.cameras(None, None, 9).await.expect("a page").len(), 1);
}

/// After some failures (a full disk, an I/O error) the database ends a transaction by itself; the
/// connection must stay usable.
#[tokio::test]
async fn the_writer_survives_a_transaction_that_ended_under_it() {
    let (fixture, _folder) = in_folder().await;
    let (store, camera) = (&fixture.store, &fixture.camera);
    fixture
        .tamper(
            "CREATE TRIGGER poison BEFORE INSERT ON samples WHEN NEW.target_id = 'poison' \
             BEGIN SELECT RAISE(ROLLBACK, 'poisoned'); END",
        )
        .await;
    for round in 0..3 {
        let writer = hold(store).await;
        let calls = vec![
            call(store, camera, vec![sample(round, "a")]),
            call(store, camera, vec![sample(round, "b"), sample(round, "poison")]),
            call(store, camera, vec![sample(round, "c")]),
        ];
        release(store, writer, calls.len()).await;
        let mut accepted = Vec::new();
        for call in calls {
            let outcome = call.await.expect("no panic");
            accepted.push(outcome.map(|inserted| inserted.accepted).map_err(|error| error.kind()));
        }
        assert_eq!(accepted, [Ok(1), Err(ErrorKind::Internal), Ok(1)]);
    }
    store
        .replace_camera(&NewCamera::named(camera.clone()), None, at(1))
        .await
        .expect("other changes work too");
    assert_eq!(count(store, camera).await, 6);
}

#[tokio::test]
async fn a_full_disk_is_reported_and_the_transaction_rolled_back() {
    let (fixture, _folder) = in_folder().await;
    let (store, camera) = (&fixture.store, &fixture.camera);
    store.insert_samples(camera, vec![sample(0, "a")], Durability::Synced).await.expect("stored");
    {
        // The limit is the connection's own, so it must be the one that stores the samples.
        let mut writer = file_store(store).changing(Durability::Relaxed).await.expect("the writer");
        let mut transaction = writer.begin().await.expect("begins");
        sqlx::raw_sql("PRAGMA max_page_count = 60").execute(&mut *transaction).await.expect("set");
        transaction.commit().await.expect("commits");
    }
    let many: Vec<Sample> = (1..20_000).map(|n| sample(n, "a")).collect();
    assert_eq!(
        kind(store.insert_samples(camera, many, Durability::Synced).await),
        ErrorKind::InsufficientStorage
    );
    assert_eq!(count(store, camera).await, 1);
    assert_eq!(
        store.insert_samples(camera, vec![sample(1, "a")], Durability::Synced).await.expect("fits").accepted,
        1
    );
}

#[tokio::test]
async fn maintenance_leaves_a_deletion_on_a_full_disk_the_space_that_was_released_for_it() {
    let folder = TempDir::new().expect("a folder");
    let reserve = folder.path().join("sightfix.reserve");
    std::fs::write(&reserve, vec![0; 1 << 20]).expect("set aside by an earlier start");
    let limits = StoreLimits { reserve_bytes: u64::MAX / 2, ..StoreLimits::default() };
    let options = StoreOptions { limits, sharing: Sharing::OneServer, ..StoreOptions::default() };
    let store = FileStore::open_with(folder.path(), options).await.expect("opens");
    let is_reserved = || reserve.exists();
    assert!(is_reserved());

    let deletion = store.deletion().await.expect("the writer");
    assert!(!is_reserved());
    let maintenance = tokio::spawn({
        let store = store.clone();
        async move { store.maintain().await }
    });
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert!(!is_reserved(), "the deletion has not ended");
    deletion.reclaim().await;
    maintenance.await.expect("no panic").expect("maintained");
    assert!(is_reserved());
}
