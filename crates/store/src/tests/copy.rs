use super::*;
use crate::domain::{Picture, PictureFormat};
use crate::{CopiedTable, NewModel, RunEnd, RunOutput, SampleFilter};

/// Fills a store with rows of most tables, some of them with extreme values.
async fn fill(Fixture { store, camera, .. }: &Fixture) {
    let gone = id("gone");
    store.insert_camera(&NewCamera::named(gone.clone()), at(0)).await.expect("new");
    store.delete_camera(&gone, None, at(1)).await.expect("deleted");
    let mut samples: Vec<Sample> = (0..1_203).map(|second| sample(second, "ö 'x'")).collect();
    samples[7].truth = Some(Position::new(-179.999_999_9, -1e-300).expect("a place"));
    store.insert_samples(camera, samples, Durability::Synced).await.expect("stored");
    store.insert_run(run_id(1), camera, &options(), 9, None, at(1)).await.expect("queued");
    let claim = store
        .claim_run::<CameraId>(std::time::Duration::from_secs(9), at(2))
        .await
        .expect("works")
        .expect("a run");
    let metadata = metadata();
    let model = NewModel { metadata: &metadata, weights: &[0, 1, 255], held_out: &[] };
    let end = RunEnd::Succeeded { output: RunOutput { model, activate: true }, outcome: None };
    store.finish_run::<CameraId>(run_id(1), claim.fence, end, at(3)).await.expect("works").expect("owned");
    store.set_picture(camera, Some(&picture()), at(4)).await.expect("stored");
}

fn picture() -> Picture {
    Picture::new(PictureFormat::Jpeg, vec![0xff, 0xd8, 0xff, 0, 1]).expect("a picture")
}

fn rows_of(copied: &[CopiedTable], name: &str) -> u64 {
    copied.iter().find(|table| table.name == name).expect("copied").rows
}

/// The copy is read back through the methods of a store, and copied on into a folder.
pub(crate) async fn copy_and_compare(fixture: &Fixture, target: &Home) {
    fill(fixture).await;
    let Fixture { store, camera, .. } = fixture;
    let copy = target.open().await;
    let copied = store.copy_to(&copy).await.expect("copied");
    assert_eq!(
        ["cameras", "samples", "models", "activations"].map(|name| rows_of(&copied, name)),
        [1, 1_203, 1, 1]
    );
    let (all, page) = (SampleFilter::default(), 2_000);
    assert_eq!(
        copy.samples(camera, &all, None, page).await.expect("read"),
        store.samples(camera, &all, None, page).await.expect("read")
    );
    assert_eq!(copy.picture(camera).await.expect("read"), Some(picture()));
    assert_eq!(copy.camera(camera).await.expect("known"), store.camera(camera).await.expect("known"));
    assert_eq!(copy.model_content(camera, 1).await.expect("sound").1, [0, 1, 255]);
    assert_eq!(kind(store.copy_to(&copy).await), ErrorKind::InvalidArgument, "the target is not empty");

    // Keys are never used twice, not even that of a camera which was deleted before the copy.
    let earlier = store.insert_camera(&NewCamera::named(id("next")), at(4)).await.expect("new").key;
    assert_eq!(copy.insert_camera(&NewCamera::named(id("next")), at(4)).await.expect("new").key, earlier);
    copy.insert_samples(camera, vec![sample(9_000, "a")], Durability::Synced).await.expect("stored");

    let folder = Home::Folder(Arc::new(TempDir::new().expect("a folder")));
    let back = copy.copy_to(&folder.open().await).await.expect("copied");
    assert_eq!(rows_of(&back, "samples"), 1_204);
}

#[tokio::test]
async fn a_copy_holds_the_same() {
    copy_and_compare(&Fixture::new().await, &Home::new().await).await;
}
