//! The resource `/v1/sites`, and the cameras of a site.

use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::grpc::proto::site_service_client::SiteServiceClient;
use tonic::Code;
use tonic_types::StatusExt as _;

use crate::harness::{TestServer, data_folder, run, simulated_csv};
use crate::live_client::channel;

const JSON: (&str, &str) = ("content-type", "application/merge-patch+json");

#[tokio::test]
async fn a_site_is_created_read_changed_and_deleted() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__SITES", "2")]);
    let draft = json!({
        "id": "harbour", "display_name": "Harbour", "labels": {"city": "Tallinn"},
        "origin": {"longitude_deg": 24.7453, "latitude_deg": 59.4371},
    });
    let created = server.post("/v1/sites", &draft).await.expect(201);
    assert_eq!(created.header("location"), "/v1/sites/harbour");
    let etag = created.header("etag").to_owned();
    let site = created.json();
    for (name, value) in draft.as_object().expect("fields") {
        assert_eq!(&site[name], value, "{name}");
    }
    assert_eq!((&site["cameras"], &site["revision"]), (&json!(0), &json!(1)));
    let known = server.send("GET", "/v1/sites/harbour", &[("if-none-match", &etag)], "").await;
    assert!(known.expect(304).body.is_empty());

    let patch = |if_match: &str, change: Value| {
        let headers = [JSON, ("if-match", if_match)].map(|(name, value)| (name, value.to_owned()));
        let server = &server;
        async move {
            let headers: Vec<(&str, &str)> = headers.iter().map(|(name, value)| (*name, &**value)).collect();
            server.send("PATCH", "/v1/sites/harbour", &headers, change.to_string()).await
        }
    };
    let changed =
        patch(&etag, json!({"labels": {"city": null, "zone": "3"}, "origin": null})).await.expect(200);
    let site = changed.json();
    assert_eq!((&site["labels"], site.get("origin")), (&json!({"zone": "3"}), None));
    assert_eq!((&site["display_name"], &site["revision"]), (&json!("Harbour"), &json!(2)));
    patch(&etag, json!({"display_name": "late"})).await.expect(412);
    patch("*", json!({"cameras": 5})).await.expect(422);
    let wrong =
        patch("*", json!({"origin": {"longitude_deg": 200, "latitude_deg": 0}})).await.expect(422).json();
    assert_eq!(wrong["violations"][0]["field"], "origin.longitude_deg");
    server.send("PATCH", "/v1/sites/harbour", &[JSON], "{}").await.expect(428);

    server.post("/v1/sites", &json!({"id": "harbour"})).await.expect(409);
    server.post("/v1/sites", &json!({"id": "airfield"})).await.expect(201);
    let full = server.post("/v1/sites", &json!({"id": "market"})).await.expect(507).json();
    assert!(full["detail"].as_str().expect("text").contains("limits.sites is 2"), "{full}");
    let page = server.get("/v1/sites?limit=1").await.expect(200).json();
    assert_eq!(page["items"][0]["id"], "airfield");
    let cursor = page["next_cursor"].as_str().expect("a second page");
    let page = server.get(&format!("/v1/sites?cursor={cursor}")).await.expect(200).json();
    assert_eq!(
        (page["items"].as_array().map(Vec::len), &page["items"][0]["id"]),
        (Some(1), &json!("harbour"))
    );

    server.send("DELETE", "/v1/sites/harbour", &[("if-match", &etag)], "").await.expect(412);
    server.send("DELETE", "/v1/sites/harbour", &[], "").await.expect(204);
    for path in ["/v1/sites/harbour", "/v1/sites/harbour/tracks", "/v1/sites/No%20Slug"] {
        let missing = server.get(path).await.expect(404).json();
        assert_eq!(missing["type"], "urn:sightfix:problem:site-not-found", "{path}");
    }

    let log = server.get("/v1/audit").await.expect(200).json();
    let entries = log["items"].as_array().expect("items").iter();
    let actions: Vec<(&str, &str)> = entries
        .rev()
        .filter_map(|entry| Some((entry["action"].as_str()?, entry["subject"].as_str()?)))
        .collect();
    let expected = [
        ("site-created", "site harbour"),
        ("site-changed", "site harbour, revision 2"),
        ("site-created", "site airfield"),
        ("site-deleted", "site harbour"),
    ];
    assert_eq!(actions, expected, "refused changes leave no entry");
}

#[tokio::test]
async fn cameras_belong_to_sites() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let unknown = server.post("/v1/cameras", &json!({"id": "a", "site": "square"})).await.expect(422).json();
    assert_eq!(unknown["violations"][0]["field"], "site");
    server.get("/v1/cameras/a").await.expect(404);
    server.post("/v1/sites", &json!({"id": "square"})).await.expect(201);
    for camera in
        [json!({"id": "a", "site": "square"}), json!({"id": "b"}), json!({"id": "c", "site": "square"})]
    {
        server.post("/v1/cameras", &camera).await.expect(201);
    }
    let ids = |page: &Value| {
        let items = page["items"].as_array().expect("items").iter();
        items.map(|camera| camera["id"].as_str().expect("an id").to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(ids(&server.get("/v1/cameras?site=square").await.expect(200).json()), ["a", "c"]);
    let page = server.get("/v1/cameras?site=square&limit=1").await.expect(200).json();
    let cursor = page["next_cursor"].as_str().expect("a second page");
    let page =
        server.get(&format!("/v1/cameras?site=square&limit=1&cursor={cursor}")).await.expect(200).json();
    assert_eq!(ids(&page), ["c"]);
    server.get("/v1/cameras?site=none").await.expect(404);
    assert_eq!(server.get("/v1/sites/square").await.expect(200).json()["cameras"], 2);

    let headers = [JSON, ("if-match", "*")];
    let change = |camera: &str, change: Value| {
        let (server, path) = (&server, format!("/v1/cameras/{camera}"));
        async move { server.send("PATCH", &path, &headers, change.to_string()).await }
    };
    assert_eq!(change("b", json!({"site": "square"})).await.expect(200).json()["site"], "square");
    let kept = change("b", json!({"display_name": "B"})).await.expect(200).json();
    assert_eq!(kept["site"], "square", "what is left out stays");
    assert_eq!(
        change("b", json!({"site": "none"})).await.expect(422).json()["violations"][0]["field"],
        "site"
    );
    let refused = server.send("DELETE", "/v1/sites/square", &[], "").await.expect(409).json();
    assert!(refused["detail"].as_str().expect("text").contains("3 camera(s)"), "{refused}");
    server.send("DELETE", "/v1/cameras/a", &[], "").await.expect(204);
    for camera in ["b", "c"] {
        assert_eq!(change(camera, json!({"site": null})).await.expect(200).json().get("site"), None);
    }
    server.send("DELETE", "/v1/sites/square", &[], "").await.expect(204);
}

#[tokio::test]
async fn sites_by_grpc_are_those_by_rest_and_refused_alike() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let channel = channel(&server).await;
    let sites = || SiteServiceClient::new(channel.clone());
    let cameras = || CameraServiceClient::new(channel.clone());
    let reason =
        |status: &tonic::Status| status.get_error_details().error_info().expect("ErrorInfo").reason.clone();

    let origin = proto::Position { longitude_deg: Some(24.7), latitude_deg: Some(59.4) };
    let profile = proto::SiteProfile { origin: Some(origin), ..Default::default() };
    let request = proto::CreateSiteRequest { id: "square".to_owned(), profile: Some(profile) };
    let created = sites().create_site(request.clone()).await.expect("new").into_inner().site.expect("a site");
    let by_rest = server.get("/v1/sites/square").await.expect(200).json();
    assert_eq!(by_rest["origin"], json!({"longitude_deg": 24.7, "latitude_deg": 59.4}));
    assert_eq!((by_rest["revision"].as_u64(), created.revision), (Some(1), 1));
    let taken = sites().create_site(request).await.expect_err("taken");
    assert_eq!((taken.code(), reason(&taken)), (Code::AlreadyExists, "site-exists".to_owned()));

    let camera = |site: &str| proto::CameraProfile { site: Some(site.to_owned()), ..Default::default() };
    let create =
        |id: &str, site: &str| proto::CreateCameraRequest { id: id.to_owned(), profile: Some(camera(site)) };
    cameras().create_camera(create("a", "square")).await.expect("new");
    let unknown = cameras().create_camera(create("b", "none")).await.expect_err("unknown");
    let details = unknown.get_error_details();
    assert_eq!(details.bad_request().expect("BadRequest").field_violations[0].field, "profile.site");
    let request = proto::ListCamerasRequest { site_id: "square".to_owned(), ..Default::default() };
    assert_eq!(cameras().list_cameras(request).await.expect("a page").into_inner().cameras.len(), 1);

    let request = proto::DeleteSiteRequest { site_id: "square".to_owned(), expected_revision: None };
    let in_use = sites().delete_site(request.clone()).await.expect_err("it has a camera");
    assert_eq!((in_use.code(), reason(&in_use)), (Code::FailedPrecondition, "site-in-use".to_owned()));
    let profile = proto::CameraProfile::default();
    let mask = prost_types::FieldMask { paths: vec!["site".to_owned()] };
    let update = proto::UpdateCameraRequest {
        camera_id: "a".to_owned(),
        profile: Some(profile),
        update_mask: Some(mask),
        expected_revision: None,
    };
    cameras().update_camera(update).await.expect("taken out of its site");

    let profile = proto::SiteProfile { display_name: "Square".to_owned(), ..Default::default() };
    let update = |expected_revision| proto::UpdateSiteRequest {
        site_id: "square".to_owned(),
        profile: Some(profile.clone()),
        update_mask: None,
        expected_revision,
    };
    let changed =
        sites().update_site(update(Some(1))).await.expect("changed").into_inner().site.expect("a site");
    let profile = changed.profile.expect("a profile");
    assert_eq!((profile.display_name.as_str(), profile.origin), ("Square", Some(origin)));
    let stale = sites().update_site(update(Some(1))).await.expect_err("stale");
    assert_eq!((stale.code(), reason(&stale)), (Code::Aborted, "revision-mismatch".to_owned()));
    let listed = sites().list_sites(proto::ListSitesRequest::default()).await.expect("a page").into_inner();
    assert_eq!((listed.sites.len(), listed.next_page_token.as_str()), (1, ""));
    sites().delete_site(request).await.expect("gone");
    let request = proto::GetSiteRequest { site_id: "square".to_owned() };
    let missing = sites().get_site(request).await.expect_err("gone");
    assert_eq!((missing.code(), reason(&missing)), (Code::NotFound, "site-not-found".to_owned()));
    let request = proto::WatchTracksRequest { site_id: "square".to_owned(), resume_after: "soon".to_owned() };
    let wrong = sites().watch_tracks(request).await.expect_err("no id");
    assert_eq!(
        wrong.get_error_details().bad_request().expect("one").field_violations[0].field,
        "resume_after"
    );
}

#[tokio::test]
async fn an_import_creates_a_camera_in_its_site_which_a_running_server_sees() {
    let folder = data_folder();
    let file = folder.path().join("training.csv");
    std::fs::write(&file, simulated_csv()).expect("a file");
    let data = folder.path().join("data");
    let server = TestServer::start(&data);
    let (file, data) = (file.to_str().expect("UTF-8"), data.to_str().expect("UTF-8"));
    run(&["import", file, "--camera", "gate", "--create", "--site", "square", "--data", data]);
    run(&["import", file, "--camera", "yard", "--create", "--site", "square", "--data", data]);
    assert_eq!(server.get("/v1/cameras/gate").await.expect(200).json()["site"], "square");
    assert_eq!(server.get("/v1/sites/square").await.expect(200).json()["cameras"], 2);
    assert_eq!(server.get("/v1/sites/square/tracks").await.expect(200).json()["items"], json!([]));
}
