//! Cameras from creation to deletion.

use sightfix::grpc::proto;
use tonic::Code;

use super::server::{Server, refusal_of};

fn yard() -> proto::CameraProfile {
    proto::CameraProfile {
        display_name: "Yard".to_owned(),
        image_size: Some(proto::ImageSize { width_px: 640, height_px: 480 }),
        gnss_error: Some(proto::GnssError { sigma_m: Some(2.5) }),
        recipe: proto::Recipe::Paper.into(),
        target_classes: vec!["person".to_owned()],
        labels: [("site".to_owned(), "north".to_owned())].into(),
        receivers: vec![receiver("phone-7", "person-1", -18.35), receiver("tag", "tag", 0.0)],
        retrain_when_moved: Some(true),
        learn_automatically: Some(false),
        site: None,
        gnss_bias_sigma_m: Some(1.5),
        location: Some(proto::Position { longitude_deg: Some(103.98678), latitude_deg: Some(30.6280135) }),
        snapshot: Some(proto::SnapshotSource {
            url: "http://192.0.2.7/still.jpg".to_owned(),
            username: Some("viewer".to_owned()),
            password: None,
        }),
        history: Some(proto::HistorySettings {
            keep_days: Some(7),
            max_bytes: Some(5_000_000),
            coarsen_m: 2.5,
        }),
        known_points: vec![proto::KnownPoint {
            x_px: 320.5,
            y_px: 410.0,
            position: Some(proto::Position {
                longitude_deg: Some(103.98681),
                latitude_deg: Some(30.6280135),
            }),
            sigma_m: Some(0.5),
        }],
    }
}

fn receiver(receiver_id: &str, target_id: &str, clock_offset_s: f64) -> proto::Receiver {
    proto::Receiver {
        receiver_id: receiver_id.to_owned(),
        target_id: target_id.to_owned(),
        clock_offset_s,
        sigma_m: None,
    }
}

fn get(id: &str) -> proto::GetCameraRequest {
    proto::GetCameraRequest { camera_id: id.to_owned() }
}

#[tokio::test]
async fn a_camera_lives_from_creation_to_deletion() {
    let server = Server::start().await;
    let mut cameras = server.cameras();
    let create = proto::CreateCameraRequest { id: "yard".to_owned(), profile: Some(yard()) };
    let created = cameras.create_camera(create.clone()).await.expect("new").into_inner().camera.expect("set");
    assert_eq!(created.profile, Some(yard()));
    assert_eq!((created.revision, created.active_model, created.warnings.len()), (1, None, 0));
    let status = cameras.create_camera(create).await.expect_err("taken");
    assert_eq!(refusal_of(&status, Code::AlreadyExists, "camera-exists").1, ["id"]);

    let update = proto::UpdateCameraRequest {
        camera_id: "yard".to_owned(),
        profile: Some(proto::CameraProfile {
            display_name: "Court".to_owned(),
            receivers: vec![receiver("watch", "", 0.5)],
            ..Default::default()
        }),
        update_mask: Some(prost_types::FieldMask {
            paths: ["display_name", "image_size", "receivers"].map(Into::into).to_vec(),
        }),
        expected_revision: Some(1),
    };
    let updated = cameras.update_camera(update.clone()).await.expect("changed").into_inner().camera;
    let expected = proto::CameraProfile {
        display_name: "Court".to_owned(),
        image_size: None,
        receivers: vec![receiver("watch", "watch", 0.5)],
        ..yard()
    };
    assert_eq!(updated.as_ref().and_then(|camera| camera.profile.clone()), Some(expected));
    assert_eq!(updated.as_ref().map(|camera| (camera.revision, camera.warnings.len())), Some((2, 1)));
    let status = cameras.update_camera(update).await.expect_err("an old revision");
    refusal_of(&status, Code::Aborted, "revision-mismatch");
    let read = cameras.get_camera(get("yard")).await.expect("there").into_inner().camera;
    assert_eq!(read, updated);

    let delete = proto::DeleteCameraRequest { camera_id: "yard".to_owned(), expected_revision: Some(1) };
    let status = cameras.delete_camera(delete.clone()).await.expect_err("an old revision");
    refusal_of(&status, Code::Aborted, "revision-mismatch");
    let delete = proto::DeleteCameraRequest { expected_revision: None, ..delete };
    cameras.delete_camera(delete).await.expect("gone");
    let status = cameras.get_camera(get("yard")).await.expect_err("gone");
    refusal_of(&status, Code::NotFound, "camera-not-found");
}

#[tokio::test]
async fn cameras_come_page_by_page() {
    let server = Server::start().await;
    let mut cameras = server.cameras();
    for id in ["c", "a", "b", "d", "e"] {
        let create = proto::CreateCameraRequest { id: id.to_owned(), profile: None };
        cameras.create_camera(create).await.expect("new");
    }
    let mut pages = Vec::new();
    let mut page_token = String::new();
    loop {
        let request = proto::ListCamerasRequest { page_size: 2, page_token, ..Default::default() };
        let page = cameras.list_cameras(request).await.expect("a page").into_inner();
        pages.push(page.cameras.iter().map(|camera| camera.id.clone()).collect::<Vec<_>>().join(""));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    assert_eq!(pages, ["ab", "cd", "e"]);
    let request = proto::ListCamerasRequest { page_token: "!".to_owned(), ..Default::default() };
    let status = cameras.list_cameras(request).await.expect_err("no token");
    assert_eq!(refusal_of(&status, Code::InvalidArgument, "invalid-argument").1, ["page_token"]);
    let request = proto::ListCamerasRequest { page_size: 1_000_000, ..Default::default() };
    let status = cameras.list_cameras(request).await.expect_err("too many");
    assert_eq!(refusal_of(&status, Code::InvalidArgument, "invalid-argument").1, ["page_size"]);
}

#[tokio::test]
async fn bad_profiles_are_refused_by_the_path_of_the_field() {
    let server = Server::start().await;
    let with = |change: fn(&mut proto::CameraProfile)| {
        let mut profile = yard();
        change(&mut profile);
        profile
    };
    let long = "x".repeat(100_000);
    for (profile, field) in [
        (with(|it| it.display_name = " padded".to_owned()), "profile.display_name"),
        (with(|it| it.image_size = Some(proto::ImageSize::default())), "profile.image_size.width_px"),
        (
            with(|it| it.gnss_error = Some(proto::GnssError { sigma_m: Some(f64::NAN) })),
            "profile.gnss_error.sigma_m",
        ),
        (with(|it| it.recipe = 77), "profile.recipe"),
        (with(|it| it.receivers.push(receiver("tag", "", 0.0))), "profile.receivers[2].receiver_id"),
        (with(|it| it.receivers.push(receiver("", "a", 0.0))), "profile.receivers[2].receiver_id"),
        (with(|it| it.receivers[0].clock_offset_s = f64::NAN), "profile.receivers[0].clock_offset_s"),
        (with(|it| it.target_classes.push("person".to_owned())), "profile.target_classes[1]"),
        (with(|it| it.target_classes.push(String::new())), "profile.target_classes[1]"),
    ] {
        let create = proto::CreateCameraRequest { id: "yard".to_owned(), profile: Some(profile) };
        let status = server.cameras().create_camera(create).await.expect_err(field);
        let (message, fields) = refusal_of(&status, Code::InvalidArgument, "invalid-argument");
        assert_eq!(fields, [field]);
        assert!(message.starts_with(field), "{message}");
    }
    // A client's text must not make the answer's headers too large for it.
    let mut profile = yard();
    profile.labels.insert(long, String::new());
    let create = proto::CreateCameraRequest { id: "yard".to_owned(), profile: Some(profile) };
    let status = server.cameras().create_camera(create).await.expect_err("a long label");
    refusal_of(&status, Code::InvalidArgument, "invalid-argument");

    for id in ["", "Yard", "-yard"] {
        let create = proto::CreateCameraRequest { id: id.to_owned(), profile: None };
        let status = server.cameras().create_camera(create).await.expect_err("no slug");
        assert_eq!(refusal_of(&status, Code::InvalidArgument, "invalid-argument").1, ["id"]);
    }
    let status = server.cameras().get_camera(get("")).await.expect_err("no id");
    assert_eq!(refusal_of(&status, Code::InvalidArgument, "invalid-argument").1, ["camera_id"]);
    let status = server.cameras().get_camera(get("No Slug")).await.expect_err("no such camera");
    refusal_of(&status, Code::NotFound, "camera-not-found");
    let none = server.cameras().list_cameras(proto::ListCamerasRequest::default()).await.expect("a page");
    assert!(none.into_inner().cameras.is_empty(), "a refused camera was stored");
}
