//! The same requests over REST and over gRPC: the same answers, and the same refusals by kind, message
//! and fields at fault.

use serde_json::{Value, json};
use sightfix::domain::ErrorKind;
use sightfix::exchange::{Format, write_samples};
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use sightfix::grpc::proto::evaluation_service_client::EvaluationServiceClient;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::model_service_client::ModelServiceClient;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use sightfix::grpc::proto::track_service_client::TrackServiceClient;
use sightfix::grpc::proto::training_service_client::TrainingServiceClient;
use sightfix::simulation::{Options, Scene, simulate};
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

/// The contents of a refusal, without those of its transport.
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
    let mut by_rest = Refusal {
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
    // Statuses of gRPC are headers, whose texts are shortened.
    for (rest, grpc) in by_rest.violations.iter_mut().zip(&by_grpc.violations) {
        if let Some(begin) = grpc.1.strip_suffix("...")
            && rest.1.starts_with(begin)
        {
            rest.1.clone_from(&grpc.1);
        }
    }
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

/// A world of one camera, `square`, with its samples in the server.
async fn square(server: &TestServer) -> (String, String) {
    let options = Options { samples: 300, ..Options::new(Scene::Square) };
    let world = simulate(&options);
    let size = json!({"width_px": world.image_size.width_px(), "height_px": world.image_size.height_px()});
    server.post("/v1/cameras", &json!({"id": "square", "image_size": size})).await.expect(201);
    let mut csv = Vec::new();
    write_samples(&mut csv, Format::Csv, &world.training_samples()).expect("memory can be written");
    let csv = String::from_utf8(csv).expect("UTF-8");
    let headers = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/square/samples", &headers, csv).await.expect(200);
    let (mut detections, mut fixes) =
        ("time,target_id,left,top,width,height\n".to_owned(), "time,longitude,latitude\n".to_owned());
    for sample in world.training_samples().iter().take(20) {
        let [left, top, width, height] = sample.bounding_box.sides_px();
        let at = sample.fix.position;
        detections += &format!("{},{},{left},{top},{width},{height}\n", sample.time, sample.target_id);
        fixes += &format!("{},{},{}\n", sample.time, at.longitude_deg(), at.latitude_deg());
    }
    (detections, fixes)
}

/// Changes the camera `c`.
async fn patch(server: &TestServer, change: &Value) -> Answer {
    let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
    server.send("PATCH", "/v1/cameras/c", &headers, change.to_string()).await
}

#[tokio::test]
async fn evaluations_are_the_same_and_refused_alike() {
    let both = Both::start(&[]).await;
    square(&both.server).await;
    let client = || EvaluationServiceClient::new(both.channel.clone());
    let start = |request: proto::StartEvaluationRequest| {
        let request = proto::StartEvaluationRequest { camera_id: "square".to_owned(), ..request };
        async move { client().start_evaluation(request).await.map(tonic::Response::into_inner) }
    };
    let truth_point = proto::Position { longitude_deg: Some(103.98678), latitude_deg: Some(30.628) };
    let truth = Some(proto::start_evaluation_request::Truth::TruthPoint(truth_point));
    let methods = vec!["gnss".to_owned()];

    let good = proto::StartEvaluationRequest { truth, methods: methods.clone(), ..Default::default() };
    let started = start(good.clone()).await.expect("good").evaluation.expect("an evaluation");
    let path = format!("/v1/evaluations/{}", started.id);
    let get = || {
        let request = proto::GetEvaluationRequest { evaluation_id: started.id.clone() };
        async move { client().get_evaluation(request).await.map(tonic::Response::into_inner) }
    };
    let ended = loop {
        let now = get().await.expect("there").evaluation.expect("an evaluation");
        if now.ended_at.is_some() {
            break now;
        }
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    };
    let rest = both.server.get(&path).await.expect(200).json();
    let report: Value = serde_json::from_str(ended.report_json.as_deref().expect("a report")).expect("JSON");
    assert_eq!(rest["report"], report);
    assert_eq!(rest["methods"], json!(ended.methods));
    assert_eq!(rest["seeds"].as_u64(), Some(ended.seeds.into()));

    let draft = |more: Value| {
        let mut draft = json!({"camera_id": "square", "methods": ["gnss"], "truth_point": {"longitude_deg": 103.98678, "latitude_deg": 30.628}});
        draft.as_object_mut().expect("an object").extend(more.as_object().expect("an object").clone());
        draft
    };
    let range = |from, until| {
        let at = |seconds| Some(prost_types::Timestamp { seconds, nanos: 0 });
        Some(proto::TimeRange { from: at(from), until: at(until) })
    };
    let cases = [
        (json!({"seeds": 0}), proto::StartEvaluationRequest { seeds: Some(0), ..good.clone() }),
        (json!({"test_share": 2.0}), proto::StartEvaluationRequest { test_share: Some(2.0), ..good.clone() }),
        (
            json!({"gnss_sigma_m": -1.0}),
            proto::StartEvaluationRequest { gnss_sigma_m: Some(-1.0), ..good.clone() },
        ),
        (
            json!({"methods": ["gnss", "none"]}),
            proto::StartEvaluationRequest { methods: vec!["gnss".into(), "none".into()], ..good.clone() },
        ),
        (
            json!({"train": {"from": "2026-01-02T00:00:00Z", "until": "2026-01-01T00:00:00Z"}}),
            proto::StartEvaluationRequest { train: range(1_767_312_000, 1_767_225_600), ..good },
        ),
    ];
    for (more, request) in cases {
        let rest = both.server.post("/v1/evaluations", &draft(more)).await;
        same_refusal(rest, &start(request).await.expect_err("bad"), ErrorKind::InvalidArgument);
    }

    let cancelled = proto::CancelEvaluationRequest { evaluation_id: started.id.clone() };
    let grpc = client().cancel_evaluation(cancelled).await.expect_err("it has ended");
    same_refusal(
        both.server.post(&format!("{path}/cancel"), &json!({})).await,
        &grpc,
        ErrorKind::EvaluationEnded,
    );
    let listed = client().list_evaluations(proto::ListEvaluationsRequest::default()).await.expect("a list");
    assert_eq!(listed.into_inner().evaluations[0].id, started.id);
    let deleted = proto::DeleteEvaluationRequest { evaluation_id: started.id.clone() };
    client().delete_evaluation(deleted).await.expect("deleted");
    same_refusal(
        both.server.get(&path).await,
        &get().await.expect_err("gone"),
        ErrorKind::EvaluationNotFound,
    );
}

/// The course is in both or in neither.
pub(crate) fn same_motion(rest: &Value, grpc: Option<&proto::Motion>) {
    let grpc = grpc.expect("a motion");
    let interval = |name: &str| Some([rest[name][0].as_f64()?, rest[name][1].as_f64()?]);
    let bounds = |interval: proto::Interval| [interval.low, interval.high];
    assert_eq!(rest["speed_mps"].as_f64(), Some(grpc.speed_mps));
    assert_eq!(interval("speed_interval_mps"), grpc.speed_interval_mps.map(bounds));
    assert_eq!(rest["course_deg"].as_f64(), grpc.course_deg);
    assert_eq!(interval("course_interval_deg"), grpc.course_interval_deg.map(bounds));
    assert_eq!(rest["stationary_probability"].as_f64(), Some(grpc.stationary_probability));
}

/// A receiver that goes north at 20 m/s, then stands.
#[tokio::test]
async fn speed_and_course_are_the_same_and_those_of_the_target() {
    let both = Both::start(&[]).await;
    let latest = |seconds: std::ops::Range<u32>| {
        let both = &both;
        async move {
            for second in seconds {
                let north_m = 20.0 * f64::from(second.min(40));
                let fix = json!({"longitude_deg": 103.9, "latitude_deg": 30.6 + north_m / 110_850.0, "sigma_m": 1.0});
                let time = format!("2026-01-01T00:{:02}:{:02}Z", second / 60, second % 60);
                let observations = json!({"observations": [{"time": time, "target_id": "a", "fix": fix}]});
                both.server.post("/v1/cameras/c/tracks", &observations).await.expect(200);
            }
            let rest = both.server.get("/v1/cameras/c/tracks").await.expect(200).json();
            let request = proto::ListTracksRequest { camera_id: "c".to_owned() };
            let listed = TrackServiceClient::new(both.channel.clone()).list_tracks(request).await;
            let motion = listed.expect("tracks").into_inner().tracks[0].motion.expect("a motion");
            same_motion(&rest["features"][0]["properties"], Some(&motion));
            motion
        }
    };
    let moving = latest(0..40).await;
    let speed = moving.speed_interval_mps.expect("an interval");
    assert!(speed.low < 20.0 && 20.0 < speed.high && speed.high - speed.low < 4.0, "{moving:?}");
    let course_deg = moving.course_deg.expect("it moves");
    assert!(course_deg.min(360.0 - course_deg) < 2.0 && moving.stationary_probability < 0.01, "{moving:?}");
    let standing = latest(40..100).await;
    assert_eq!(standing.speed_interval_mps.expect("an interval").low, 0.0);
    assert!(standing.course_deg.is_none() && standing.stationary_probability > 0.9, "{standing:?}");
}

#[tokio::test]
async fn tracks_and_events_are_the_same() {
    let both = Both::start(&[]).await;
    let client = || TrackServiceClient::new(both.channel.clone());
    let watched = proto::WatchCameraRequest { camera_id: "c".to_owned(), resume_after: String::new() };
    let mut events = client().watch_camera(watched).await.expect("watched").into_inner();
    for second in 0..3 {
        let fix = json!({"longitude_deg": 103.9, "latitude_deg": 30.6 + f64::from(second) * 1e-5});
        let time = format!("2026-01-01T00:00:0{second}Z");
        let observations = json!({"observations": [{"time": time, "target_id": "a", "fix": fix}]});
        both.server.post("/v1/cameras/c/tracks", &observations).await.expect(200);
    }
    let compare = |rest: &Value, grpc: &proto::TrackPoint| {
        let at = |axis: usize| rest["geometry"]["coordinates"][axis].as_f64().expect("degrees");
        let position = grpc.position.as_ref().expect("a position");
        assert!((at(0) - position.longitude_deg.expect("set")).abs() < 1e-7);
        assert!((at(1) - position.latitude_deg.expect("set")).abs() < 1e-7);
        let number = |name: &str| rest["properties"][name].as_f64();
        assert_eq!(number("r95_m"), Some(grpc.r95_m));
        assert_eq!(number("velocity_north_m_s"), Some(grpc.velocity_north_m_s));
        assert_eq!(rest["properties"]["target_id"], grpc.target_id);
        same_motion(&rest["properties"], grpc.motion.as_ref());
    };
    let rest = both.server.get("/v1/cameras/c/tracks").await.expect(200).json();
    let request = proto::ListTracksRequest { camera_id: "c".to_owned() };
    let latest = client().list_tracks(request).await.expect("tracks").into_inner().tracks;
    assert_eq!(latest.len(), 1);
    compare(&rest["features"][0], &latest[0]);
    let get = |target: &str| {
        let request = proto::GetTrackRequest { camera_id: "c".to_owned(), target_id: target.to_owned() };
        async move { client().get_track(request).await.map(tonic::Response::into_inner) }
    };
    let rest = both.server.get("/v1/cameras/c/tracks/a").await.expect(200).json();
    let history = get("a").await.expect("a history").points;
    assert_eq!(rest["features"].as_array().map(Vec::len), Some(history.len()));
    for (rest, grpc) in rest["features"].as_array().expect("features").iter().zip(&history) {
        compare(rest, grpc);
    }
    let rest = both.server.get("/v1/cameras/c/tracks/none").await;
    same_refusal(rest, &get("none").await.expect_err("not followed"), ErrorKind::TrackNotFound);

    let first = events.message().await.expect("an event").expect("an event");
    let Some(proto::watch_camera_response::Event::Track(update)) = first.event else { panic!("a track") };
    assert_eq!(update.track.expect("a track").target_id, "a");
    drop(events);
    let again = proto::WatchCameraRequest { camera_id: "c".to_owned(), resume_after: first.event_id };
    let mut events = client().watch_camera(again).await.expect("watched").into_inner();
    let second = events.message().await.expect("an event").expect("an event");
    let Some(proto::watch_camera_response::Event::Track(update)) = second.event else { panic!("a track") };
    let time = update.track.expect("a track").time.expect("a time");
    assert_eq!(time.seconds, 1_767_225_601, "the reader goes on after the event that it has seen");
    both.server.send("DELETE", "/v1/cameras/c", &[], "").await.expect(204);
    let ended = loop {
        match events.message().await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("the end is an error"),
            Err(status) => break status,
        }
    };
    let rest = both.server.get("/v1/cameras/c/events").await.expect(404).json();
    let reason = ended.get_error_details().error_info().expect("ErrorInfo").reason.clone();
    assert!(rest["type"].as_str().expect("a type").ends_with(&reason), "{rest} {reason}");
}

#[tokio::test]
async fn pairings_are_the_same_and_refused_alike() {
    let both = Both::start(&[]).await;
    let (detections, fixes) = square(&both.server).await;
    let walker = detections.lines().nth(1).and_then(|row| row.split(',').nth(1)).expect("a row");
    let profile = json!({"receivers": [{"receiver_id": "phone", "target_id": walker}]});
    patch(&both.server, &profile).await.expect(200);
    let body = {
        let part = |name: &str, text: &str| {
            format!(
                "--x\r\ncontent-disposition: form-data; name=\"{name}\"\r\ncontent-type: text/csv\r\n\r\n{text}\r\n"
            )
        };
        part("detections", &detections) + &part("fixes", &fixes) + "--x--\r\n"
    };
    let rest_pair = |query: &str| {
        let path = format!("/v1/cameras/c/samples/pairings?keep_unpaired=true{query}");
        let body = body.clone();
        let both = &both;
        async move {
            let headers = [("content-type", "multipart/form-data; boundary=x")];
            both.server.send("POST", &path, &headers, body).await
        }
    };
    let opening = proto::PairingOpening {
        camera_id: "c".to_owned(),
        keep_unpaired: true,
        on_conflict: proto::OnConflict::Replace.into(),
        ..Default::default()
    };
    let grpc_pair = |opening: proto::PairingOpening| {
        use proto::pair_samples_request::Kind;
        // Pieces of a file need not end with its lines.
        let pieces = |text: &str, kind: fn(bytes::Bytes) -> Kind| {
            text.as_bytes().chunks(100).map(|piece| kind(piece.to_vec().into())).collect::<Vec<_>>()
        };
        let mut kinds = vec![Kind::Opening(opening)];
        kinds.extend(pieces(&detections, Kind::Detections));
        kinds.extend(pieces(&fixes, Kind::Fixes));
        let messages = kinds.into_iter().map(|kind| proto::PairSamplesRequest { kind: Some(kind) });
        let messages: Vec<_> = messages.collect();
        let mut client = SampleServiceClient::new(both.channel.clone());
        async move {
            let answer = client.pair_samples(futures_util::stream::iter(messages)).await;
            answer.map(tonic::Response::into_inner)
        }
    };
    let rest = rest_pair("").await.expect(200).json();
    let grpc = grpc_pair(opening.clone()).await.expect("good");
    let (samples, pairing) = (grpc.samples.expect("samples"), grpc.pairing.expect("counts"));
    assert_eq!(rest["accepted"].as_u64(), Some(samples.accepted), "{rest} {samples:?}");
    assert_eq!(samples.accepted, samples.replaced, "the same samples over REST were stored before");
    assert_eq!(rest["pairing"]["paired"].as_u64(), Some(pairing.paired));
    assert!(pairing.paired > 0, "{pairing:?}");
    let of_fix = &rest["pairing"]["unused_fixes"]["no_box_of_target"];
    assert_eq!(of_fix.as_u64(), Some(pairing.fixes_no_box_of_target));
    assert_eq!(
        rest["unnamed_fixes_of"]["receiver_id"],
        grpc.unnamed_fixes_of.expect("a receiver").receiver_id
    );

    let bad = proto::PairingOpening { window_s: Some(-1.0), ..opening.clone() };
    let grpc = grpc_pair(bad).await.expect_err("bad");
    same_refusal(rest_pair("&window_s=-1").await, &grpc, ErrorKind::InvalidArgument);
    let bad = proto::PairingOpening { target_id: Some(String::new()), ..opening.clone() };
    let grpc = grpc_pair(bad).await.expect_err("bad");
    same_refusal(rest_pair("&target_id=").await, &grpc, ErrorKind::InvalidArgument);
    let unknown = proto::PairingOpening { camera_id: "none".to_owned(), ..opening };
    let grpc = grpc_pair(unknown).await.expect_err("unknown");
    same_refusal(both.server.get("/v1/cameras/none").await, &grpc, ErrorKind::CameraNotFound);
}

#[tokio::test]
async fn receivers_are_the_same_and_refused_alike() {
    let both = Both::start(&[]).await;
    let client = || CameraServiceClient::new(both.channel.clone());
    let update = |receivers: Vec<proto::Receiver>| {
        let request = proto::UpdateCameraRequest {
            camera_id: "c".to_owned(),
            profile: Some(proto::CameraProfile { receivers, ..Default::default() }),
            ..Default::default()
        };
        async move { client().update_camera(request).await.map(tonic::Response::into_inner) }
    };
    let receiver = |id: &str, clock_offset_s: f64| proto::Receiver {
        receiver_id: id.to_owned(),
        target_id: "walker".to_owned(),
        clock_offset_s,
        sigma_m: Some(0.02),
    };
    let stored = update(vec![receiver("phone", -0.35)]).await.expect("good").camera.expect("a camera");
    let rest = both.server.get("/v1/cameras/c").await.expect(200).json();
    let profile = stored.profile.expect("a profile");
    assert_eq!(rest["receivers"][0]["receiver_id"], profile.receivers[0].receiver_id);
    assert_eq!(rest["receivers"][0]["target_id"], "walker");
    assert_eq!(rest["receivers"][0]["clock_offset_s"], -0.35);
    assert_eq!((&rest["receivers"][0]["sigma_m"], profile.receivers[0].sigma_m), (&json!(0.02), Some(0.02)));
    for (id, offset_s) in [("phone", 1e9), ("", 0.0)] {
        let given = json!({"receiver_id": id, "target_id": "walker", "clock_offset_s": offset_s});
        let rest = patch(&both.server, &json!({"receivers": [given]})).await;
        let grpc = update(vec![receiver(id, offset_s)]).await.expect_err("bad");
        same_refusal_but_for(rest, &grpc, ErrorKind::InvalidArgument, |field| {
            field.strip_prefix("profile.").unwrap_or(field)
        });
    }
}
