use super::*;
use crate::domain::{Durability, HeldOutSampleError, ModelVersion};
use crate::{NewModel, RunEnd, RunOutput};

async fn active(store: &Store, camera: &CameraId) -> Option<u32> {
    store.camera(camera).await.expect("known").active_model
}

#[tokio::test]
async fn versions_count_up_and_come_back_whole() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let weights: Vec<u8> = (0..=255).cycle().take(70_000).collect();
    for number in 1..=5 {
        let made = store.insert_model(&camera, &metadata(), &weights, at(number)).await.expect("stored");
        let expected = ModelVersion {
            camera_id: camera.clone(),
            number: u32::try_from(number).expect("small"),
            run_id: None,
            created_at: at(number),
            weights_bytes: 70_000,
            metadata: metadata(),
        };
        assert_eq!(made, expected);
        assert_eq!(store.model(&camera, made.number).await.expect("known"), expected);
    }
    assert_eq!(store.model_content(&camera, 3).await.expect("known"), (metadata(), weights.clone()));
    let numbers = |page: Vec<ModelVersion>| page.iter().map(|model| model.number).collect::<Vec<_>>();
    assert_eq!(numbers(store.models(&camera, None, 3).await.expect("a page")), [5, 4, 3]);
    assert_eq!(numbers(store.models(&camera, Some(3), 3).await.expect("a page")), [2, 1]);
    assert_eq!(active(&store, &camera).await, None, "an import does not answer by itself");
    assert_eq!(kind(store.model(&camera, 6).await), ErrorKind::ModelNotFound);
    assert_eq!(kind(store.model_content(&camera, 6).await), ErrorKind::ModelNotFound);
    assert_eq!(kind(store.model(&id("none"), 1).await), ErrorKind::CameraNotFound);
    assert_eq!(
        kind(store.insert_model(&id("none"), &metadata(), b"", at(1)).await),
        ErrorKind::CameraNotFound
    );
}

#[tokio::test]
async fn rolling_back_walks_through_what_was_active() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    for _ in 0..3 {
        store.insert_model(&camera, &metadata(), b"w", at(1)).await.expect("stored");
    }
    assert_eq!(kind(store.roll_back(&camera, at(2)).await), ErrorKind::NoModel);
    assert_eq!(kind(store.activate_model(&camera, 4, at(2)).await), ErrorKind::ModelNotFound);
    for number in [1, 2, 2, 3, 1] {
        let camera = store.activate_model(&camera, number, at(2)).await.expect("active");
        assert_eq!(camera.active_model, Some(number));
    }
    assert_eq!(store.active_models().await.expect("known"), [(camera.clone(), 1)]);
    for expected in [3, 2] {
        let camera = store.roll_back(&camera, at(3)).await.expect("back");
        assert_eq!(camera.active_model, Some(expected));
    }
    store.activate_model(&camera, 3, at(4)).await.expect("active");
    for expected in [2, 1] {
        assert_eq!(store.roll_back(&camera, at(5)).await.expect("back").active_model, Some(expected));
    }
    assert_eq!(kind(store.roll_back(&camera, at(6)).await), ErrorKind::NoEarlierModel);
    assert_eq!(active(&store, &camera).await, Some(1), "a refused roll back changes nothing");
}

#[tokio::test]
async fn metadata_that_could_not_be_read_again_is_not_stored() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let broken = ModelMetadata { error_scale: f64::NAN, ..metadata() };
    assert_eq!(kind(store.insert_model(&camera, &broken, b"w", at(1)).await), ErrorKind::Internal);
    assert_eq!(store.models(&camera, None, 9).await.expect("a page"), []);
}

#[tokio::test]
async fn a_changed_row_does_not_match_its_checksum() {
    let fixture = Fixture::new().await;
    let Fixture { store, camera, .. } = &fixture;
    store.insert_model(camera, &metadata(), b"weights", at(1)).await.expect("stored");
    assert_eq!(store.model_content(camera, 1).await.expect("sound").1, b"weights");
    fixture
        .tamper_each(
            "UPDATE models SET weights = x'77656967687471'",
            "UPDATE models SET weights = '\\x77656967687471'",
        )
        .await;
    assert_eq!(kind(store.model_content(camera, 1).await), ErrorKind::ModelUnusable);
    for damage in [
        "UPDATE models SET metadata = replace(metadata, '120.5', '120.6')",
        "UPDATE models SET metadata = '{'",
    ] {
        fixture.tamper(damage).await;
        assert_eq!(kind(store.model_content(camera, 1).await), ErrorKind::ModelUnusable, "{damage}");
    }
}

#[tokio::test]
async fn held_out_errors_come_back_with_their_samples_while_those_are_stored() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    store.insert_samples(&camera, vec![sample(1, "a")], Durability::default()).await.expect("stored");
    let error = |second: i64, distance_m: f64| HeldOutSampleError {
        time: at(second),
        target_id: target("a"),
        distance_m,
    };
    let held_out = [error(1, 2.5), error(2, 3.5)];
    let metadata = metadata();
    let model = NewModel { metadata: &metadata, weights: b"w", held_out: &held_out };
    store.insert_run(run_id(1), &camera, &options(), 9, None, at(1)).await.expect("queued");
    let claim = store
        .claim_run::<CameraId>(std::time::Duration::from_secs(9), at(2))
        .await
        .expect("works")
        .expect("a run");
    let end = RunEnd::Succeeded { output: RunOutput { model, activate: true }, outcome: None };
    store.finish_run::<CameraId>(run_id(1), claim.fence, end, at(3)).await.expect("works").expect("owned");
    let stored = store.held_out_errors(&camera, 1).await.expect("read");
    assert_eq!(stored.iter().map(|stored| stored.error.clone()).collect::<Vec<_>>(), held_out);
    let expected = sample(1, "a");
    assert_eq!(stored[0].sample, Some((expected.bounding_box, expected.fix.position)));
    assert_eq!(stored[1].sample, None);
}
