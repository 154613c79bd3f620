use super::*;
use crate::domain::{RecordingBounds, RecordingPart};

const LARGE: RecordingBounds = RecordingBounds { rows: 1_000, bytes: 1_000 };

fn part(second: i64, rows: u32, content: &str) -> RecordingPart {
    RecordingPart { recorded_at: at(second), rows, content: content.as_bytes().to_vec() }
}

async fn recorded(store: &Store, camera: &CameraId) -> Vec<String> {
    let key = store.camera(camera).await.expect("stored").key;
    let parts = store.recording(key).await.expect("readable");
    parts.into_iter().map(|content| String::from_utf8(content).expect("text")).collect()
}

#[tokio::test]
async fn a_recording_keeps_its_latest_parts() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let key = store.camera(&camera).await.expect("stored").key;
    for (second, content) in [(1, "one"), (2, "two"), (3, "three")] {
        store.append_recording(key, &part(second, 10, content), LARGE).await.expect("stored");
    }
    assert_eq!(recorded(&store, &camera).await, ["one", "two", "three"]);
    let few_rows = RecordingBounds { rows: 25, ..LARGE };
    store.append_recording(key, &part(4, 10, "four"), few_rows).await.expect("stored");
    assert_eq!(recorded(&store, &camera).await, ["three", "four"]);
    let few_bytes = RecordingBounds { bytes: 8, ..LARGE };
    store.append_recording(key, &part(5, 1, "five"), few_bytes).await.expect("stored");
    assert_eq!(recorded(&store, &camera).await, ["four", "five"]);
    assert_eq!(store.retain_recordings(at(5)).await.expect("deleted"), 1);
    assert_eq!(recorded(&store, &camera).await, ["five"]);
}

#[tokio::test]
async fn a_camera_that_does_not_learn_keeps_no_recording() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let stored = store.camera(&camera).await.expect("stored");
    store.append_recording(stored.key, &part(1, 1, "one"), LARGE).await.expect("stored");
    let off = NewCamera { learn_automatically: false, ..stored.profile };
    store.replace_camera(&off, None, at(2)).await.expect("changed");
    assert_eq!(store.retain_recordings(at(0)).await.expect("deleted"), 1);
    assert!(recorded(&store, &camera).await.is_empty());
    store.delete_camera(&camera, None, at(3)).await.expect("deleted");
    store.append_recording(stored.key, &part(4, 1, "late"), LARGE).await.expect("nothing to append to");
}
