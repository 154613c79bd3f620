use std::path::Path;

use tempfile::TempDir;

use super::{file_store, in_folder};
use crate::domain::{Durability, NewCamera};
use crate::tests::{Fixture, at, id, metadata, options, run_id, sample};
use crate::{SampleFilter, Store};

/// A copy of what a process killed now would leave on the disk.
fn crashed_copy(folder: &Path) -> TempDir {
    let copy = TempDir::new().expect("a folder");
    for name in ["sightfix.db", "sightfix.db-wal"] {
        std::fs::copy(folder.join(name), copy.path().join(name)).expect("copied");
    }
    copy
}

async fn refusal(folder: &Path) -> String {
    match Store::open(folder).await {
        Ok(_) => panic!("opens"),
        Err(error) => error.to_string(),
    }
}

#[tokio::test]
async fn a_crash_keeps_all_that_was_acknowledged() {
    let (Fixture { store, camera, .. }, folder) = in_folder().await;
    store
        .insert_samples(&camera, (0..3_000).map(|n| sample(n, "a")).collect(), Durability::Synced)
        .await
        .expect("stored");
    store.insert_model(&camera, &metadata(), b"weights", at(1)).await.expect("stored");
    store.activate_model(&camera, 1, at(2)).await.expect("active");
    store.insert_run(run_id(1), &camera, &options(), 9, None, at(3)).await.expect("queued");
    let copy = crashed_copy(folder.path());
    drop(store);
    for folder in [copy.path(), folder.path()] {
        let store = Store::open(folder).await.expect("opens");
        assert_eq!(store.count_samples(&camera, &SampleFilter::default()).await.expect("counted"), 3_000);
        assert_eq!(store.camera(&camera).await.expect("known").active_model, Some(1));
        assert_eq!(store.model_content(&camera, 1).await.expect("known").1, b"weights");
        assert!(store.run(&camera, run_id(1)).await.is_ok());
    }
}

#[tokio::test]
async fn what_cannot_be_opened_says_why() {
    let folder = TempDir::new().expect("a folder");
    std::fs::write(folder.path().join("sightfix.db"), vec![b'x'; 5_000]).expect("written");
    let text = refusal(folder.path()).await;
    assert!(text.contains("is not a database"), "{text}");

    let folder = TempDir::new().expect("a folder");
    std::fs::write(folder.path().join("file"), "").expect("written");
    let text = refusal(&folder.path().join("file").join("below")).await;
    assert!(text.contains("cannot make the folder"), "{text}");

    let (fixture, folder) = in_folder().await;
    fixture.tamper("INSERT INTO _sqlx_migrations VALUES (9000, 'later', '', 1, x'00', 0)").await;
    fixture.store.close().await;
    let text = refusal(folder.path()).await;
    assert!(text.contains("newer version") && text.contains("9000"), "{text}");
}

/// The superuser may write anywhere; then there is nothing to see.
#[cfg(unix)]
#[tokio::test]
async fn a_folder_that_cannot_be_written_is_named() {
    use std::os::unix::fs::PermissionsExt;
    let folder = TempDir::new().expect("a folder");
    std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o500)).expect("set");
    if std::fs::write(folder.path().join("probe"), "").is_err() {
        let text = refusal(folder.path()).await;
        assert!(text.contains("cannot be opened for writing"), "{text}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn several_may_open_one_file_at_once_and_write_side_by_side() {
    let folder = TempDir::new().expect("a folder");
    let path = folder.path().to_owned();
    let opened: Vec<_> = (0..6)
        .map(|_| {
            let path = path.clone();
            tokio::spawn(async move { Store::open(&path).await })
        })
        .collect();
    let mut stores = Vec::new();
    for store in opened {
        stores.push(store.await.expect("no panic").expect("opens"));
    }
    stores[0].insert_camera(&NewCamera::named(id("square")), at(0)).await.expect("new");
    let writing: Vec<_> = stores
        .iter()
        .cloned()
        .enumerate()
        .map(|(index, store)| {
            tokio::spawn(async move {
                for n in 0..20 {
                    let one = sample(n, &format!("target-{index}"));
                    store.insert_samples(&id("square"), vec![one], Durability::Synced).await.expect("stored");
                }
            })
        })
        .collect();
    for task in writing {
        task.await.expect("no panic");
    }
    let count = stores[5].count_samples(&id("square"), &SampleFilter::default()).await.expect("counted");
    assert_eq!(count, 120);
}

#[tokio::test]
async fn an_open_store_answers() {
    let (fixture, _folder) = in_folder().await;
    fixture.store.ping().await.expect("answers");
}

#[tokio::test]
async fn slow_reads_do_not_keep_a_health_check_waiting() {
    let (fixture, _folder) = in_folder().await;
    let store = file_store(&fixture.store);
    let mut held = Vec::new();
    while let Some(reader) = store.readers().try_acquire() {
        held.push(reader);
    }
    while held.len() < store.readers().options().get_max_connections() as usize {
        held.push(store.readers().acquire().await.expect("a reader"));
    }
    store.ping().await.expect("a connection of its own");
}
