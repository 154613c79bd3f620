//! The same requests over REST and over gRPC: the same answers, and the same refusals by kind, message
//! and fields at fault.

use serde_json::{Value, json};
use sightfix::domain::ErrorKind;
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::model_service_client::ModelServiceClient;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use sightfix::grpc::proto::training_service_client::TrainingServiceClient;
use sightfix::status;
use tonic::Status;
use tonic::transport::Channel;
use tonic_types::StatusExt as _;

use crate::harness::{Answer, TestServer, data_folder};

/// One server, reached both ways.
struct Both {
    server: TestServer,
    channel: Channel,
    _folder: tempfile::TempDir,
}

impl Both {
    /// With a camera `c` of 640 x 480 px.
    async fn start(settings: &[(&str, &str)]) -> Self {
        let folder = data_folder();
        let server = TestServer::start_with(folder.path(), settings);
        let profile = json!({"id": "c", "image_size": {"width_px": 640, "height_px": 480}});
        server.post("/v1/cameras", &profile).await.expect(201);
        Self { channel: server.channel().await, server, _folder: folder }
    }

    async fn rest_fuse(&self, camera: &str, observations: &[Value]) -> Answer {
        let path = format!("/v1/cameras/{camera}/fusions");
        self.server.post(&path, &json!({"observations": observations})).await
    }

    async fn grpc_fuse(&self, camera: &str, observations: &[Value]) -> Result<proto::FuseResponse, Status> {
        let observations = observations.iter().map(observation).collect();
        let request = proto::FuseRequest { camera_id: camera.to_owned(), observations };
        let answer = FusionServiceClient::new(self.channel.clone()).fuse(request).await;
        answer.map(tonic::Response::into_inner)
    }
}

/// An observation of REST as gRPC has it.
fn observation(json: &Value) -> proto::Observation {
    let number = |name: &str| json.pointer(name).and_then(Value::as_f64);
    let time: jiff::Timestamp = json["time"].as_str().expect("a time").parse().expect("RFC 3339");
    proto::Observation {
        time: Some(prost_types::Timestamp { seconds: time.as_second(), nanos: time.subsec_nanosecond() }),
        target_id: json["target_id"].as_str().map(str::to_owned),
        bounding_box: json.get("bounding_box").map(|_| proto::BoundingBox {
            left_px: number("/bounding_box/left_px"),
            top_px: number("/bounding_box/top_px"),
            width_px: number("/bounding_box/width_px"),
            height_px: number("/bounding_box/height_px"),
        }),
        fix: json.get("fix").map(|_| proto::Fix {
            longitude_deg: number("/fix/longitude_deg"),
            latitude_deg: number("/fix/latitude_deg"),
            sigma_m: number("/fix/sigma_m"),
        }),
    }
}

/// What a refusal says, without what belongs to its transport.
#[derive(Debug, PartialEq)]
struct Refusal {
    reason: String,
    message: String,
    violations: Vec<(String, String)>,
}

/// Holds both refusals to the row of the table and to each other.
#[track_caller]
fn same_refusal(rest: Answer, grpc: &Status, kind: ErrorKind) {
    same_refusal_but_for(rest, grpc, kind, |field| field);
}

/// The same where the interfaces name a field differently: `rest_name` makes gRPC's that of REST.
#[track_caller]
fn same_refusal_but_for(rest: Answer, grpc: &Status, kind: ErrorKind, rest_name: fn(&str) -> &str) {
    let row = status::of(kind);
    let problem = rest.expect(row.http).json();
    let violations = problem["violations"].as_array().into_iter().flatten();
    let text = |value: &Value| value.as_str().expect("text").to_owned();
    let by_rest = Refusal {
        reason: text(&problem["type"]).trim_start_matches(status::PROBLEM_TYPE_PREFIX).to_owned(),
        message: text(&problem["detail"]),
        violations: violations.map(|at| (text(&at["field"]), text(&at["message"]))).collect(),
    };
    assert_eq!(grpc.code() as i32, row.grpc, "{grpc:?}");
    let details = grpc.get_error_details();
    let fields = details.bad_request().into_iter().flat_map(|bad| &bad.field_violations);
    let by_grpc = Refusal {
        reason: details.error_info().expect("ErrorInfo").reason.clone(),
        message: match fields.clone().next() {
            Some(first) => grpc.message().replacen(&first.field, rest_name(&first.field), 1),
            None => grpc.message().to_owned(),
        },
        violations: fields.map(|at| (rest_name(&at.field).to_owned(), at.description.clone())).collect(),
    };
    assert_eq!(by_rest, by_grpc);
    assert_eq!(by_rest.reason, row.slug);
}

fn good() -> Value {
    json!({
        "time": "2026-01-01T00:00:00.25Z", "target_id": "a",
        "fix": {"longitude_deg": 103.9, "latitude_deg": 30.6, "sigma_m": 2.5},
    })
}

/// The good observation with one place changed.
fn changed(place: &str, value: Value) -> Value {
    let mut changed = good();
    let (parents, name) = place.rsplit_once('/').expect("a place");
    changed
        .pointer_mut(parents)
        .and_then(Value::as_object_mut)
        .expect("an object")
        .insert(name.to_owned(), value);
    changed
}

fn with_box(side: &str, side_px: f64) -> Value {
    let mut sides = json!({"left_px": 10.0, "top_px": 10.0, "width_px": 20.0, "height_px": 40.0});
    sides[side] = side_px.into();
    changed("/bounding_box", sides)
}

#[tokio::test]
async fn a_good_batch_gets_the_same_positions() {
    let both = Both::start(&[]).await;
    let batch = [good(), changed("/fix/latitude_deg", json!(-89.9)), changed("/target_id", json!("é"))];
    let rest = both.rest_fuse("c", &batch).await.expect(200).json();
    let grpc = both.grpc_fuse("c", &batch).await.expect("good");
    assert_eq!(rest["items"].as_array().expect("items").len(), grpc.fusions.len());
    for (rest, grpc) in rest["items"].as_array().expect("items").iter().zip(&grpc.fusions) {
        let number = |name: &str| rest.pointer(name).and_then(Value::as_f64);
        let fused = grpc.fused.as_ref().expect("a position");
        assert_eq!(number("/fused/longitude_deg"), fused.longitude_deg);
        assert_eq!(number("/fused/latitude_deg"), fused.latitude_deg);
        assert_eq!(number("/r95_m"), Some(grpc.r95_m));
        assert_eq!(number("/e_gnss_m2"), grpc.e_gnss_m2);
        assert_eq!(number("/confidence_gnss"), Some(grpc.confidence_gnss));
        assert_eq!(rest["target_id"].as_str(), grpc.target_id.as_deref());
    }
}

#[tokio::test]
async fn bad_batches_are_refused_alike() {
    let both = Both::start(&[("SIGHTFIX_LIMITS__BATCH_OBSERVATIONS", "40")]).await;
    let neither = json!({"time": "2026-01-01T00:00:00Z"});
    let batches = [
        vec![changed("/fix/latitude_deg", json!(91))],
        vec![changed("/fix/longitude_deg", json!(-181))],
        vec![changed("/fix/sigma_m", json!(0))],
        vec![changed("/target_id", json!(""))],
        vec![changed("/target_id", json!("x".repeat(129)))],
        vec![changed("/time", json!("2999-01-01T00:00:00Z"))],
        vec![with_box("width_px", 0.0)],
        vec![with_box("left_px", 5_000.0)],
        vec![with_box("height_px", -1.0)],
        vec![neither.clone()],
        vec![
            good(),
            neither.clone(),
            good(),
            with_box("top_px", 1e30),
            changed("/fix/latitude_deg", json!(99)),
        ],
        vec![neither; 30],
        Vec::new(),
    ];
    for batch in batches {
        let rest = both.rest_fuse("c", &batch).await;
        let grpc = both.grpc_fuse("c", &batch).await.expect_err("bad");
        same_refusal(rest, &grpc, ErrorKind::InvalidArgument);
    }
    for (batch, camera, kind) in [
        (vec![good(); 41], "c", ErrorKind::TooLarge),
        (vec![good()], "none", ErrorKind::CameraNotFound),
        (vec![good()], "No Slug", ErrorKind::CameraNotFound),
        (vec![with_box("left_px", 10.0)], "c", ErrorKind::NoModel),
    ] {
        let rest = both.rest_fuse(&camera.replace(' ', "%20"), &batch).await;
        let grpc = both.grpc_fuse(camera, &batch).await.expect_err("bad");
        same_refusal(rest, &grpc, kind);
    }
}

#[tokio::test]
async fn samples_are_listed_and_refused_alike() {
    let both = Both::start(&[]).await;
    let csv = "target_id,time,left,top,width,height,longitude,latitude\n\
               a,2026-01-01T00:00:00Z,1,2,3,4,103.9,30.6\n\
               b,2026-01-01T00:00:00Z,1,2,3,4,103.9,30.6\n";
    both.server.send("POST", "/v1/cameras/c/samples", &[("content-type", "text/csv")], csv).await.expect(200);
    let list = |page_token: &str, filter: Option<proto::SampleFilter>, page_size: u32| {
        let mut client = SampleServiceClient::new(both.channel.clone());
        let page_token = page_token.to_owned();
        let request = proto::ListSamplesRequest { camera_id: "c".to_owned(), filter, page_size, page_token };
        async move { client.list_samples(request).await.map(tonic::Response::into_inner) }
    };

    let first = both.server.get("/v1/cameras/c/samples?limit=1").await.expect(200).json();
    let cursor = first["next_cursor"].as_str().expect("a second page");
    let first = list("", None, 1).await.expect("good");
    assert_eq!(first.next_page_token, cursor, "one place in the list has one name");
    let second = list(cursor, None, 1).await.expect("good");
    assert_eq!(second.samples[0].target_id, "b");

    let rest = both.server.get("/v1/cameras/c/samples?cursor=bm90aGluZw").await;
    let grpc = list("bm90aGluZw", None, 1).await.expect_err("no cursor of this list");
    same_refusal_but_for(rest, &grpc, ErrorKind::InvalidArgument, |_| "cursor");

    let at = |seconds| Some(prost_types::Timestamp { seconds, nanos: 0 });
    let backwards =
        proto::SampleFilter { from: at(1_000_000_000), until: at(1_000_000_000), ..Default::default() };
    let query = "from=2001-09-09T01:46:40Z&until=2001-09-09T01:46:40Z";
    let rest = both.server.get(&format!("/v1/cameras/c/samples?{query}")).await;
    let grpc = list("", Some(backwards), 1).await.expect_err("no time is between");
    same_refusal_but_for(rest, &grpc, ErrorKind::InvalidArgument, |field| {
        field.strip_prefix("filter.").unwrap_or(field)
    });
}

#[tokio::test]
async fn cameras_are_refused_alike() {
    let both = Both::start(&[]).await;
    let client = || CameraServiceClient::new(both.channel.clone());
    let create = |id: &str| {
        let request = proto::CreateCameraRequest { id: id.to_owned(), profile: None };
        async move { client().create_camera(request).await.expect_err("refused") }
    };
    for (id, kind) in [
        ("c", ErrorKind::CameraExists),
        ("No Slug", ErrorKind::InvalidArgument),
        ("", ErrorKind::InvalidArgument),
    ] {
        let rest = both.server.post("/v1/cameras", &json!({"id": id})).await;
        same_refusal(rest, &create(id).await, kind);
    }

    let rest = both.server.get("/v1/cameras/none").await;
    let request = proto::GetCameraRequest { camera_id: "none".to_owned() };
    let grpc = client().get_camera(request).await.expect_err("unknown");
    same_refusal(rest, &grpc, ErrorKind::CameraNotFound);

    let rest = both.server.send("DELETE", "/v1/cameras/c", &[("if-match", "\"7\"")], "").await;
    let request = proto::DeleteCameraRequest { camera_id: "c".to_owned(), expected_revision: Some(7) };
    let grpc = client().delete_camera(request).await.expect_err("another revision");
    same_refusal(rest, &grpc, ErrorKind::RevisionMismatch);
}

#[tokio::test]
async fn runs_and_models_are_refused_alike() {
    let both = Both::start(&[]).await;
    let start = |request: proto::StartTrainingRunRequest| {
        let mut client = TrainingServiceClient::new(both.channel.clone());
        let request = proto::StartTrainingRunRequest { camera_id: "c".to_owned(), ..request };
        async move { client.start_training_run(request).await.expect_err("refused") }
    };
    let runs = "/v1/cameras/c/training-runs";
    let rest = both.server.post(runs, &json!({"epochs": 0})).await;
    let request = proto::StartTrainingRunRequest { epochs: Some(0), ..Default::default() };
    same_refusal(rest, &start(request).await, ErrorKind::InvalidArgument);

    let rest = both
        .server
        .post(runs, &json!({"from": "2026-01-02T00:00:00Z", "until": "2026-01-01T00:00:00Z"}))
        .await;
    let at = |seconds| Some(prost_types::Timestamp { seconds, nanos: 0 });
    let (from, until) = (at(1_767_312_000), at(1_767_225_600));
    let request = proto::StartTrainingRunRequest { from, until, ..Default::default() };
    same_refusal(rest, &start(request).await, ErrorKind::InvalidArgument);

    let rest = both.server.post(runs, &json!({})).await;
    same_refusal(rest, &start(Default::default()).await, ErrorKind::UnusableSamples);

    let id = "00000000-0000-7000-8000-000000000000";
    let rest = both.server.get(&format!("{runs}/{id}")).await;
    let request = proto::GetTrainingRunRequest { camera_id: "c".to_owned(), run_id: id.to_owned() };
    let grpc = TrainingServiceClient::new(both.channel.clone()).get_training_run(request).await;
    same_refusal(rest, &grpc.expect_err("unknown"), ErrorKind::RunNotFound);

    let rest = both.server.get("/v1/cameras/c/models/7").await;
    let request = proto::GetModelRequest { camera_id: "c".to_owned(), number: 7 };
    let grpc = ModelServiceClient::new(both.channel.clone()).get_model(request).await;
    same_refusal(rest, &grpc.expect_err("unknown"), ErrorKind::ModelNotFound);
}
