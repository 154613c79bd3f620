use std::collections::BTreeMap;

use super::*;
use crate::domain::{
    Camera, ClockOffset, GnssBiasSigma, GnssError, HistorySettings, ImageSize, KnownPoint, Receiver,
    ReceiverId, Receivers, Revision, SampleCount, SigmaM, SnapshotSource, TargetClass,
};
use crate::{CameraVersion, ChangeMark, SampleFilter};

/// A profile in which every field says something.
fn full(name: &str) -> NewCamera {
    NewCamera {
        id: id(name),
        display_name: "North \"gate\" – 2".to_owned(),
        image_size: Some(ImageSize::new(1920, 1080).expect("a size")),
        gnss_error: GnssError::Known(SigmaM::new(2.7).expect("a sigma")),
        location: Some(Position::new(103.98678, -30.6280135).expect("a position")),
        gnss_bias_sigma: Some(GnssBiasSigma::new(1.3).expect("a sigma")),
        recipe: Recipe::Projective,
        target_classes: vec![
            TargetClass::new("person").expect("a class"),
            TargetClass::new("a\"b").expect("a class"),
        ],
        labels: [("site".to_owned(), "ö\\\"".to_owned())].into(),
        receivers: Receivers::new([
            Receiver::named(ReceiverId::new("a \"b\"").expect("a name")),
            Receiver {
                receiver_id: ReceiverId::new("phone-7").expect("a name"),
                target_id: target("person-1"),
                clock_offset: ClockOffset::from_seconds(-18.000_001).expect("within a day"),
                sigma: Some(SigmaM::new(0.02).expect("a sigma")),
            },
        ])
        .expect("two receivers"),
        retrain_when_moved: true,
        learn_automatically: false,
        site: None,
        snapshot: Some(
            SnapshotSource::new("http://192.0.2.7/", Some("viewer".to_owned()), Some("s3cret".to_owned()))
                .expect("an address"),
        ),
        history: Some(HistorySettings::new(7, 5_000_000, 2.5).expect("in range")),
        known_points: vec![KnownPoint {
            image_px: [512.25, 640.0],
            position: Position::new(103.98679, -30.6280135).expect("a position"),
            sigma_m: SigmaM::new(0.2).expect("a sigma"),
        }],
    }
}

#[tokio::test]
async fn a_profile_is_read_as_it_was_stored() {
    let Fixture { store, folder: _folder, .. } = Fixture::new().await;
    let made = store.insert_camera(&full("gate"), at(5)).await.expect("new");
    let expected = Camera {
        key: made.key,
        profile: full("gate"),
        revision: Revision(1),
        created_at: at(5),
        updated_at: at(5),
        active_model: None,
        samples: SampleCount::default(),
    };
    assert_eq!(made, expected);
    assert_eq!(store.camera(&id("gate")).await.expect("known"), expected);
    assert_eq!(kind(store.insert_camera(&full("gate"), at(6)).await), ErrorKind::CameraExists);
    assert_eq!(kind(store.camera(&id("none")).await), ErrorKind::CameraNotFound);
}

#[tokio::test]
async fn pages_hold_every_camera_once_in_order() {
    let Fixture { store, folder: _folder, .. } = Fixture::new().await;
    for name in ["a", "zz", "m-2", "m"] {
        store.insert_camera(&full(name), at(1)).await.expect("new");
    }
    let mut seen: Vec<CameraId> = Vec::new();
    loop {
        let page = store.cameras(None, seen.last(), 2).await.expect("a page");
        if page.is_empty() {
            break;
        }
        assert!(page.len() <= 2);
        seen.extend(page.iter().map(|camera| camera.id().clone()));
    }
    assert_eq!(seen, ["a", "m", "m-2", "square", "zz"].map(id));
}

#[tokio::test]
async fn a_change_needs_the_revision_it_was_made_from() {
    let Fixture { store, folder: _folder, .. } = Fixture::new().await;
    let changed =
        store.replace_camera(&full("square"), Some(Revision(1).into()), at(7)).await.expect("current");
    assert_eq!((changed.revision, changed.created_at, changed.updated_at), (Revision(2), at(0), at(7)));
    assert_eq!(changed.profile, full("square"));
    let stale = store.replace_camera(&full("square"), Some(Revision(1).into()), at(8)).await;
    assert_eq!(kind(stale), ErrorKind::RevisionMismatch);
    assert_eq!(
        kind(store.delete_camera(&id("square"), Some(Revision(1).into()), at(9)).await),
        ErrorKind::RevisionMismatch
    );
    let forced = store.replace_camera(&full("square"), None, at(9)).await.expect("unconditional");
    assert_eq!(forced.revision, Revision(3));
    assert_eq!(kind(store.replace_camera(&full("none"), None, at(9)).await), ErrorKind::CameraNotFound);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn one_of_several_concurrent_changes_of_one_revision_succeeds() {
    let Fixture { store, folder: _folder, .. } = Fixture::new().await;
    let attempts: Vec<_> = (0..8)
        .map(|_| {
            let store = store.clone();
            tokio::spawn(async move {
                store.replace_camera(&full("square"), Some(Revision(1).into()), at(7)).await
            })
        })
        .collect();
    let mut winners = 0;
    for attempt in attempts {
        match attempt.await.expect("no panic") {
            Ok(_) => winners += 1,
            Err(error) => assert_eq!(error.kind(), ErrorKind::RevisionMismatch),
        }
    }
    assert_eq!(winners, 1);
}

#[tokio::test]
async fn deleting_a_camera_deletes_its_rows_and_frees_its_id() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    store
        .insert_samples(&camera, vec![sample(1, "a"), sample(2, "a")], Durability::Synced)
        .await
        .expect("stored");
    store.insert_model(&camera, &metadata(), b"w", at(1)).await.expect("stored");
    store.activate_model(&camera, 1, at(2)).await.expect("active");
    store.insert_run(run_id(1), &camera, &options(), 9, None, at(3)).await.expect("queued");
    assert_eq!(kind(store.delete_camera(&camera, None, at(9)).await), ErrorKind::RunLive);
    store.cancel_run(&camera, run_id(1), at(4)).await.expect("cancelled");

    store.delete_camera(&camera, Some(Revision(1).into()), at(9)).await.expect("deleted");
    assert_eq!(kind(store.camera(&camera).await), ErrorKind::CameraNotFound);
    assert_eq!(
        kind(store.insert_samples(&camera, vec![sample(1, "a")], Durability::Synced).await),
        ErrorKind::CameraNotFound
    );
    assert_eq!(kind(store.log(run_id(1)).await), ErrorKind::RunNotFound);
    assert_eq!(store.active_models().await.expect("none"), []);
    assert_eq!(kind(store.delete_camera(&camera, None, at(9)).await), ErrorKind::CameraNotFound);

    store.insert_camera(&NewCamera::named(camera.clone()), at(5)).await.expect("new again");
    assert_eq!(store.count_samples(&camera, &SampleFilter::default()).await.expect("counted"), 0);
    assert_eq!(kind(store.model(&camera, 1).await), ErrorKind::ModelNotFound);
    assert_eq!(kind(store.roll_back(&camera, at(6)).await), ErrorKind::NoModel);
}

#[tokio::test]
async fn a_corrupt_row_is_a_fault_that_names_its_place() {
    let fixture = Fixture::new().await;
    fixture
        .tamper(r#"UPDATE cameras SET profile = replace(profile, '"recipe":"', '"recipe":"magic ') WHERE id = 'square'"#)
        .await;
    let error = fixture.store.camera(&fixture.camera).await.expect_err("corrupt");
    assert_eq!(error.kind(), ErrorKind::Internal);
    let text = error.to_string();
    for part in ["cameras", "profile", "id=square", "must be one of"] {
        assert!(text.contains(part), "{part} is missing in: {text}");
    }
}

/// Cameras as a process knows them that reads what has changed, by id.
#[derive(Default)]
struct Follower {
    known: BTreeMap<CameraId, CameraVersion>,
    upto: Option<ChangeMark>,
}

impl Follower {
    /// Reads the changes, and returns how many cameras were listed.
    async fn follow(&mut self, store: &Store) -> usize {
        let changes = store.camera_versions(self.upto).await.expect("read");
        match changes.deleted {
            Some(deleted) => self.known.retain(|id, version| !deleted.contains(&(id.clone(), version.key))),
            None => self.known.clear(),
        }
        let listed = changes.versions.len();
        self.known.extend(changes.versions.into_iter().map(|version| (version.id.clone(), version)));
        self.upto = changes.upto;
        let all = store.camera_versions(None).await.expect("read").versions;
        assert_eq!(self.known, all.into_iter().map(|version| (version.id.clone(), version)).collect());
        listed
    }
}

#[tokio::test]
async fn who_reads_the_changes_of_cameras_knows_all_of_them() {
    let Fixture { store, camera, folder } = Fixture::new().await;
    let mut follower = Follower::default();
    assert_eq!(follower.follow(&store).await, 1);
    for name in ["a", "b", "c"] {
        store.insert_camera(&full(name), at(1)).await.expect("new");
    }
    follower.follow(&store).await;
    assert_eq!(follower.known.len(), 4);
    store.replace_camera(&NewCamera::named(id("a")), None, at(2)).await.expect("changed");
    store.insert_model(&camera, &metadata(), b"w", at(2)).await.expect("stored");
    store.activate_model(&camera, 1, at(2)).await.expect("active");
    store.delete_camera(&id("b"), None, at(2)).await.expect("deleted");
    store.delete_camera(&id("c"), None, at(2)).await.expect("deleted");
    store.insert_camera(&full("c"), at(3)).await.expect("new under the same id");
    follower.follow(&store).await;
    assert_eq!(follower.known.keys().map(CameraId::as_str).collect::<Vec<_>>(), ["a", "c", "square"]);
    assert_eq!(follower.known[&camera].active_model, Some(1));
    assert_eq!(follower.known[&id("a")].revision, Revision(2));
    // Only a database says what has changed.
    let unchanged = follower.follow(&store).await;
    let is_database = matches!(folder, Home::Database(_));
    assert!(if is_database { unchanged <= 3 } else { unchanged == 3 }, "{unchanged}");
}

#[tokio::test]
async fn contents_of_cameras_come_in_the_order_asked_for() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    store.insert_camera(&full("a"), at(1)).await.expect("new");
    for weights in [b"one", b"two"] {
        store.insert_model(&camera, &metadata(), weights, at(1)).await.expect("stored");
    }
    store.activate_model(&camera, 2, at(2)).await.expect("active");
    let asked = [camera.clone(), id("none"), id("a")];
    let mut contents = store.camera_contents(&asked).await.expect("read").into_iter();
    let mut next = || contents.next().expect("one each");
    let square = next().expect("known");
    assert_eq!(square.camera, store.camera(&camera).await.expect("known"));
    assert_eq!(square.moved, None);
    assert_eq!(square.model.expect("active").read().expect("sound"), (metadata(), b"two".to_vec()));
    assert_eq!(next().err().expect("unknown").kind(), ErrorKind::CameraNotFound);
    let a = next().expect("known");
    assert_eq!(a.camera.profile, full("a"));
    assert!(a.model.is_none());
}
