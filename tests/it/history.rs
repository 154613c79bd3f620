//! The history of finished tracks: kept, queried on both transports, exported, deleted, and whole after a kill.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use sightfix::grpc::proto;
use sightfix::grpc::proto::history_service_client::HistoryServiceClient;

use crate::harness::{Answer, TestServer, data_folder, now, own_address};

/// A camera without a model, which follows fixes; its history is kept.
async fn create_camera(server: &TestServer, history: &Value) {
    let receivers = json!([{"receiver_id": "phone-7", "target_id": "ann"}]);
    let profile = json!({"id": "gate", "receivers": receivers, "history": history});
    server.post("/v1/cameras", &profile).await.expect(201);
}

/// A target that walks 1.1 m to the east each second.
async fn walk(server: &TestServer, target: &str, start: Timestamp, seconds: i64) {
    let fix = |second: i64| {
        let time = start + SignedDuration::from_secs(second);
        let fix =
            json!({"longitude_deg": 8.0 + 1.5e-5 * second as f64, "latitude_deg": 47.0, "sigma_m": 0.5});
        json!({"time": time.to_string(), "target_id": target, "class": "person", "fix": fix})
    };
    let observations: Vec<Value> = (0..seconds).map(fix).collect();
    server.post("/v1/cameras/gate/tracks", &json!({"observations": observations})).await.expect(200);
}

/// Ten minutes before the tests on a full minute, so that times are easy to state.
fn start() -> Timestamp {
    static START: LazyLock<Timestamp> = LazyLock::new(|| {
        let second = now().as_second() - 600;
        Timestamp::from_second(second - second.rem_euclid(60)).expect("in range")
    });
    *START
}

async fn history(server: &TestServer, query: &str) -> Answer {
    server.get(&format!("/v1/history?{query}")).await
}

async fn items(server: &TestServer, query: &str) -> Vec<Value> {
    let page = history(server, query).await.expect(200).json();
    page["items"].as_array().expect("items").clone()
}

/// A server on whose history two targets walked for 40 s, and finished when the one before it ended.
async fn with_two_walkers(folder: &std::path::Path) -> TestServer {
    let server = TestServer::start(folder);
    create_camera(&server, &json!({})).await;
    for target in ["ann", "bob"] {
        walk(&server, target, start(), 40).await;
    }
    assert!(items(&server, "camera=gate&limit=1000").await.len() < 80, "the tracks go on");
    assert!(server.terminate());
    TestServer::start(folder)
}

#[tokio::test]
async fn finished_tracks_are_kept_smoothed_and_found() {
    let folder = data_folder();
    let server = with_two_walkers(folder.path()).await;
    let all = items(&server, "camera=gate&limit=1000").await;
    assert_eq!(all.len(), 80);
    let middle = &all[40];
    assert_eq!(middle["camera_id"], "gate");
    let acceleration = &middle["acceleration"];
    assert!(acceleration["east_mps2"].as_f64().is_some_and(|it| it.abs() < 0.1), "{middle}");
    assert!(acceleration["covariance_east_m2_s4"].as_f64().is_some_and(|it| it > 0.0), "{middle}");
    let speed = middle["speed_mps"].as_f64().expect("a speed");
    assert!((speed - 1.14).abs() < 0.1, "{middle}");
    let from = start() + SignedDuration::from_secs(10);
    let to = start() + SignedDuration::from_secs(20);
    let within = format!("camera=gate&from={from}&until={to}");
    assert_eq!(items(&server, &within).await.len(), 20);
    assert_eq!(items(&server, &format!("{within}&target_id=bob")).await.len(), 10);
    assert_eq!(items(&server, &format!("{within}&receiver_id=phone-7")).await[0]["target_id"], "ann");
    assert!(items(&server, &format!("{within}&class=car")).await.is_empty());
    assert_eq!(items(&server, &format!("{within}&class=person")).await.len(), 20);
    assert!(items(&server, &format!("{within}&bbox=9,46,10,48")).await.is_empty());
    assert_eq!(items(&server, &format!("{within}&bbox=7,46,9,48")).await.len(), 20);
    let track = middle["track_id"].as_str().expect("an id").to_owned();
    assert_eq!(items(&server, &format!("camera=gate&track_id={track}")).await.len(), 40);
    let mut pages = Vec::new();
    let mut cursor = String::new();
    loop {
        let page = history(&server, &format!("camera=gate&limit=7{cursor}")).await.expect(200).json();
        pages.extend(page["items"].as_array().expect("items").clone());
        let Some(next) = page["next_cursor"].as_str() else { break };
        cursor = format!("&cursor={next}");
    }
    assert_eq!(pages, all);
}

#[tokio::test]
async fn positions_in_a_place_are_found_and_deleted() {
    let folder = data_folder();
    let server = with_two_walkers(folder.path()).await;
    // A triangle whose bounds hold the first 20 m of the way, its sides only those from 5 to 15 m.
    let longitude_deg = |east_m: f64| 8.0 + 1.5e-5 * east_m / 1.14;
    let corner = |east_m: f64, north_m: f64| json!([longitude_deg(east_m), 47.0 + north_m / 111_195.0]);
    let ring = json!([corner(0.0, -5.0), corner(20.0, -5.0), corner(10.0, 5.0), corner(0.0, -5.0)]);
    let triangle = json!({"id": "triangle", "camera_id": "gate", "geometry": {"type": "Polygon", "coordinates": [ring]}});
    let way = json!([corner(5.0, -5.0), corner(5.0, 5.0)]);
    let line =
        json!({"id": "line", "camera_id": "gate", "geometry": {"type": "LineString", "coordinates": way}});
    for place in [&triangle, &line] {
        server.post("/v1/places", place).await.expect(201);
    }
    let inside = items(&server, "camera=gate&place=triangle&limit=1000").await;
    assert!((16..=20).contains(&inside.len()), "{}", inside.len());
    for row in &inside {
        let east_m = (row["position"]["longitude_deg"].as_f64().expect("degrees") - 8.0) / 1.5e-5 * 1.14;
        assert!((4.5..15.5).contains(&east_m), "{row}");
    }
    for query in ["camera=gate&place=line", "camera=gate&place=triangle&bbox=7,46,9,48"] {
        let problem = history(&server, query).await.expect(422).json();
        assert_eq!(problem["violations"][0]["field"], "place", "{problem}");
    }
    history(&server, "camera=gate&place=nowhere").await.expect(404);
    let mut client = HistoryServiceClient::new(server.channel().await);
    let selection = proto::HistorySelection {
        scope: of_camera("gate"),
        place_id: Some("triangle".to_owned()),
        ..Default::default()
    };
    let asked = proto::DeleteHistoryRequest { selection: Some(selection) };
    let deleted = client.delete_history(asked).await.expect("allowed").into_inner().deleted;
    assert_eq!(deleted as usize, inside.len());
    assert_eq!(items(&server, "camera=gate&limit=1000").await.len(), 80 - inside.len());
}

#[tokio::test]
async fn both_transports_give_the_same_positions_and_refuse_alike() {
    let folder = data_folder();
    let server = with_two_walkers(folder.path()).await;
    let mut client = HistoryServiceClient::new(server.channel().await);
    let selection = proto::HistorySelection { scope: of_camera("gate"), ..Default::default() };
    let request = proto::StreamHistoryRequest { selection: Some(selection.clone()) };
    let mut stream = client.stream_history(request).await.expect("accepted").into_inner();
    let mut streamed = Vec::new();
    while let Some(batch) = stream.message().await.expect("no fault") {
        streamed.extend(batch.positions);
    }
    let listed = items(&server, "camera=gate&limit=1000").await;
    let ids = |json: &Value| json["track_id"].as_str().map(str::to_owned);
    assert_eq!(
        streamed.iter().map(|row| Some(row.track_id.clone())).collect::<Vec<_>>(),
        listed.iter().map(ids).collect::<Vec<_>>()
    );
    let speed = |row: &proto::HistoryPosition| row.motion.as_ref().map(|motion| motion.speed_mps);
    assert_eq!(speed(&streamed[9]), listed[9]["speed_mps"].as_f64());
    let request =
        proto::ListHistoryRequest { selection: Some(selection.clone()), page_size: 3, ..Default::default() };
    let page = client.list_history(request).await.expect("a page").into_inner();
    assert_eq!(page.positions, streamed[..3]);
    let other = proto::HistorySelection { scope: of_camera("other"), ..Default::default() };
    let area = proto::BoundingArea { west_deg: 1.0, south_deg: 2.0, east_deg: 3.0, north_deg: 1.0 };
    let instant = |time: Timestamp| prost_types::Timestamp { seconds: time.as_second(), nanos: 0 };
    let until = instant(start() - SignedDuration::from_secs(1));
    for (query, selection) in [
        ("camera=other".to_owned(), other),
        (
            "camera=gate&bbox=1,2,3,1".to_owned(),
            proto::HistorySelection { area: Some(area), ..selection.clone() },
        ),
        (
            format!("camera=gate&from={}&until={}", start(), start() - SignedDuration::from_secs(1)),
            proto::HistorySelection { from: Some(instant(start())), until: Some(until), ..selection.clone() },
        ),
    ] {
        let request = proto::ListHistoryRequest { selection: Some(selection), ..Default::default() };
        let status = client.list_history(request).await.expect_err("refused");
        let problem = history(&server, &query).await.json();
        assert_eq!(problem["detail"], status.message(), "{query}");
    }
}

fn of_camera(id: &str) -> Option<proto::TrackScope> {
    Some(proto::TrackScope { scope: Some(proto::track_scope::Scope::CameraId(id.to_owned())) })
}

#[tokio::test]
async fn positions_are_exported_in_all_formats() {
    let folder = data_folder();
    let server = with_two_walkers(folder.path()).await;
    let csv = history(&server, "camera=gate&format=csv").await.expect(200).text();
    assert_eq!(csv.lines().count(), 81);
    assert!(csv.starts_with("time,camera_id,site_id,track_id,target_id,class,longitude,latitude,"), "{csv}");
    let features = history(&server, "camera=gate&format=geojson").await.expect(200).json();
    let feature = &features["features"][0];
    assert_eq!(
        (&feature["geometry"]["type"], &feature["properties"]["target_id"]),
        (&json!("Point"), &json!("ann"))
    );
    let lines = history(&server, "camera=gate&format=ndjson").await.expect(200).text();
    assert_eq!(lines.lines().count(), 80);
    let columns = history(&server, "camera=gate&format=geoparquet").await.expect(200);
    assert!(columns.body.starts_with(b"PAR1") && columns.body.ends_with(b"PAR1"));
    history(&server, "camera=gate&format=shapefile").await.expect(422);
}

#[tokio::test]
async fn tracks_are_exported_as_moving_features() {
    let folder = data_folder();
    let server = with_two_walkers(folder.path()).await;
    let moving = history(&server, "camera=gate&format=moving_features").await.expect(200).json();
    let features = moving["features"].as_array().expect("features");
    assert_eq!(features.len(), 2, "{moving}");
    for (feature, target) in features.iter().zip(["ann", "bob"]) {
        assert_eq!(feature["properties"]["target_id"], target);
        let listed = items(&server, &format!("camera=gate&limit=1000&target_id={target}")).await;
        let times: Vec<Value> = listed.iter().map(|row| row["time"].clone()).collect();
        assert_eq!(feature["temporalGeometry"]["datetimes"], json!(times));
        assert_eq!(feature["geometry"]["coordinates"].as_array().map(Vec::len), Some(40));
        assert_eq!(feature["temporalProperties"][0]["r95_m"]["values"].as_array().map(Vec::len), Some(40));
    }
}

/// The walkers are 1.14 m farther east each second.
#[tokio::test]
async fn tracks_are_exported_as_lines_of_the_mot_challenge() {
    let folder = data_folder();
    let server = with_two_walkers(folder.path()).await;
    let query = format!("camera=gate&format=mot&from={}&origin=8.0,47.0", start());
    let text = history(&server, &format!("{query}&frame_hz=1")).await.expect(200).text();
    let lines: Vec<Vec<f64>> = text.lines().map(numbers).collect();
    assert_eq!(lines.len(), 80);
    for (at, line) in lines.iter().enumerate() {
        let (frame, id) = (1 + at / 2, 1 + at % 2);
        assert_eq!(line[..7], [frame as f64, id as f64, -1.0, -1.0, -1.0, -1.0, 1.0], "{line:?}");
        assert!((line[7] - 1.1415 * (frame - 1) as f64).abs() < 0.6, "{line:?}");
        assert!(line[8].abs() < 0.3 && line[9] == 0.0, "{line:?}");
    }
    let slow = history(&server, &format!("{query}&frame_hz=0.1")).await.expect(200).text();
    assert_eq!(slow.lines().count(), 10, "one line per frame and track: {slow}");
    for (query, field) in [
        (format!("camera=gate&format=mot&from={}&frame_hz=1", start()), "origin"),
        ("camera=gate&format=mot&origin=8,47&frame_hz=1".to_owned(), "from"),
        (query.clone(), "frame_hz"),
        (format!("{query}&frame_hz=0"), "frame_hz"),
        (format!("camera=gate&format=mot&from={}&frame_hz=1&origin=8", start()), "origin"),
        ("camera=gate&format=csv&frame_hz=1".to_owned(), "frame_hz"),
    ] {
        let problem = history(&server, &query).await.expect(422).json();
        assert_eq!(problem["violations"][0]["field"], field, "{query}: {problem}");
    }
}

fn numbers(line: &str) -> Vec<f64> {
    line.split(',').map(|number| number.parse().expect("a number")).collect()
}

#[tokio::test]
async fn a_heat_map_shows_where_time_was_spent() {
    let folder = data_folder();
    let server = with_two_walkers(folder.path()).await;
    // The walk is along 47 degrees, where no cells of 7 m have their border.
    let map = history_map(&server, "camera=gate&cell_m=7").await.expect(200).json();
    let cells = map["features"].as_array().expect("cells");
    assert!((7..=8).contains(&cells.len()), "44 m in cells of 7 m: {map}");
    let seconds: f64 = cells.iter().filter_map(|cell| cell["properties"]["seconds"].as_f64()).sum();
    assert!((seconds - 78.0).abs() < 0.5, "two walks of 39 s: {seconds}");
    let visits: u64 = cells.iter().filter_map(|cell| cell["properties"]["visits"].as_u64()).sum();
    assert_eq!(visits, 2 * cells.len() as u64);
    let of_one = history_map(&server, "camera=gate&cell_m=7&target_id=ann").await.expect(200).json();
    assert_eq!(of_one["features"][2]["properties"]["visits"], 1, "{of_one}");
    for query in ["camera=gate&cell_m=0", "camera=gate&cell_m=wide"] {
        let problem = history_map(&server, query).await.expect(422).json();
        assert_eq!(problem["violations"][0]["field"], "cell_m", "{problem}");
    }
}

async fn history_map(server: &TestServer, query: &str) -> Answer {
    server.get(&format!("/v1/history/heat-map?{query}")).await
}

#[tokio::test]
async fn a_deletion_leaves_nothing_of_a_receivers_carrier() {
    let folder = data_folder();
    let server = with_two_walkers(folder.path()).await;
    let path = "/v1/history?camera=gate&receiver_id=phone-7";
    let deleted = server.send("DELETE", path, &[], "").await.expect(200).json();
    assert_eq!(deleted, json!({"deleted": 40}));
    assert_eq!(items(&server, "camera=gate&limit=1000").await.len(), 40);
    assert!(items(&server, "camera=gate&target_id=ann").await.is_empty());
    for file in files_below(&folder.path().join("archive")) {
        let content = std::fs::read(file).expect("readable");
        assert!(!content.windows(3).any(|bytes| bytes == b"ann"));
    }
}

/// The site's cameras say who carries a receiver.
#[tokio::test]
async fn a_site_finds_and_deletes_a_receivers_carrier() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/sites", &json!({"id": "yard", "history": {}})).await.expect(201);
    let receivers = json!([{"receiver_id": "phone-7", "target_id": "ann"}]);
    let camera = json!({"id": "gate", "site": "yard", "receivers": receivers});
    server.post("/v1/cameras", &camera).await.expect(201);
    let fix = |second: i64| {
        let time = now() - SignedDuration::from_secs(40 - second);
        let position =
            json!({"longitude_deg": 8.0 + 1.5e-5 * second as f64, "latitude_deg": 47.0, "sigma_m": 0.5});
        json!({"time": time.to_string(), "receiver_id": "phone-7", "fix": position})
    };
    let observations: Vec<Value> = (0..40).map(fix).collect();
    server.post("/v1/cameras/gate/tracks", &json!({"observations": observations})).await.expect(200);
    assert!(server.terminate());
    let server = TestServer::start(folder.path());
    let all = items(&server, "site=yard&limit=1000").await;
    assert!(all.len() > 30 && all[0]["target_id"] == "ann", "{all:?}");
    assert_eq!(items(&server, "site=yard&limit=1000&receiver_id=phone-7").await, all);
    assert!(items(&server, "site=yard&receiver_id=phone-8").await.is_empty());
    let path = "/v1/history?site=yard&receiver_id=phone-7";
    let deleted = server.send("DELETE", path, &[], "").await.expect(200).json();
    assert_eq!(deleted, json!({ "deleted": all.len() }));
    assert!(items(&server, "site=yard").await.is_empty());
}

#[tokio::test]
async fn coarse_positions_lie_on_a_grid_and_state_its_error() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_camera(&server, &json!({"coarsen_m": 100.0})).await;
    walk(&server, "ann", start(), 40).await;
    assert!(server.terminate());
    let server = TestServer::start(folder.path());
    let rows = items(&server, "camera=gate&limit=1000").await;
    let longitudes: std::collections::BTreeSet<String> =
        rows.iter().map(|row| row["position"]["longitude_deg"].to_string()).collect();
    assert!(longitudes.len() <= 2, "46 m lie in at most two meshes: {longitudes:?}");
    let variance = rows[0]["covariance"]["east_m2"].as_f64().expect("a variance");
    assert!(variance > 833.0, "{variance}");
}

/// With PostgreSQL a camera is its killed node's for the time of a lease.
async fn wait_for_camera(server: &TestServer) {
    while !server.get("/v1/cameras/gate/tracks").await.status.is_success() {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

/// A track that goes on after more than a minute is another track: the one before has finished.
#[tokio::test]
async fn a_kill_loses_no_finished_track_that_was_written_and_leaves_only_whole_files() {
    let folder = data_folder();
    let mut kept = 0;
    for round in 0..4 {
        let server = TestServer::start(folder.path());
        if round == 0 {
            create_camera(&server, &json!({})).await;
        }
        wait_for_camera(&server).await;
        let before = items(&server, "camera=gate&limit=1000").await.len();
        assert!(before >= kept, "{before} of {kept} positions");
        let begin = start() - SignedDuration::from_hours(24 - round);
        for track in 0..30 {
            walk(&server, "ann", begin + SignedDuration::from_secs(100 * track), 5).await;
        }
        // Some of what finished is written, and the kill comes while the rest is.
        while items(&server, "camera=gate&limit=1000").await.len() == before {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        kept = items(&server, "camera=gate&limit=1000").await.len();
        server.kill();
    }
    assert!(kept >= 20, "{kept}");
}

/// What is older than a window and a lag is written while a track lasts.
#[tokio::test]
async fn a_kill_loses_only_the_end_of_a_track_that_goes_on() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_camera(&server, &json!({})).await;
    walk(&server, "ann", start(), 300).await;
    while items(&server, "camera=gate&limit=1000").await.len() < 300 - 30 {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    server.kill();
    let server = TestServer::start(folder.path());
    let kept = items(&server, "camera=gate&limit=1000").await;
    assert!((300 - 30..300).contains(&kept.len()), "{}", kept.len());
    assert_eq!(kept[0]["time"], start().to_string());
}

#[tokio::test]
async fn a_track_that_is_written_in_windows_has_no_seams() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_camera(&server, &json!({})).await;
    walk(&server, "ann", start(), 300).await;
    assert!(server.terminate());
    let server = TestServer::start(folder.path());
    let rows = items(&server, "camera=gate&limit=1000").await;
    assert_eq!(rows.len(), 300);
    for (second, row) in rows.iter().enumerate() {
        let time = start() + SignedDuration::from_secs(second as i64);
        assert_eq!((&row["time"], &row["track_id"]), (&json!(time.to_string()), &rows[0]["track_id"]));
        assert_eq!(row["acceleration"].is_object(), second > 0, "{row}");
        let longitude_deg = row["position"]["longitude_deg"].as_f64().expect("a longitude");
        let off_m = (longitude_deg - 8.0 - 1.5e-5 * second as f64) * 76_000.0;
        assert!(off_m.abs() < 0.6, "{off_m} m off: {row}");
    }
}

#[tokio::test]
async fn bad_settings_of_a_history_are_refused_with_their_field() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    for (history, field) in [
        (json!({"keep_days": 0}), "history.keep_days"),
        (json!({"max_bytes": 1}), "history.max_bytes"),
        (json!({"coarsen_m": -1.0}), "history.coarsen_m"),
    ] {
        let problem =
            server.post("/v1/cameras", &json!({"id": "c", "history": history})).await.expect(422).json();
        assert_eq!(problem["violations"][0]["field"], field, "{problem}");
        let problem =
            server.post("/v1/sites", &json!({"id": "s", "history": history})).await.expect(422).json();
        assert_eq!(problem["violations"][0]["field"], field, "{problem}");
    }
}

/// An S3-compatible server of the test's own.
struct ObjectStore {
    process: Child,
    address: SocketAddr,
}

impl ObjectStore {
    fn start() -> Self {
        let address = own_address();
        let mut command = Command::new("moto_server");
        command.args(["-H", &address.ip().to_string(), "-p", &address.port().to_string()]);
        let process = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("moto is installed");
        while TcpStream::connect(address).is_err() {
            std::thread::sleep(Duration::from_millis(50));
        }
        Self { process, address }
    }

    fn settings(&self) -> [(&'static str, String); 6] {
        [
            ("SIGHTFIX_ARCHIVE", "s3://histories/of/gates".to_owned()),
            ("AWS_ENDPOINT_URL", format!("http://{}", self.address)),
            ("AWS_ALLOW_HTTP", "true".to_owned()),
            ("AWS_REGION", "eu-central-1".to_owned()),
            ("AWS_ACCESS_KEY_ID", "key".to_owned()),
            ("AWS_SECRET_ACCESS_KEY", "secret".to_owned()),
        ]
    }

    fn serve(&self, folder: &std::path::Path) -> TestServer {
        let settings = self.settings();
        let settings = settings.each_ref().map(|(name, value)| (*name, value.as_str()));
        TestServer::start_with(folder, &settings)
    }

    /// The answer to a request without a body or a signature, which moto does not ask for.
    fn request(&self, method: &str, path: &str) -> String {
        let mut stream = TcpStream::connect(self.address).expect("it listens");
        write!(stream, "{method} {path} HTTP/1.0\r\nHost: {}\r\n\r\n", self.address).expect("sent");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("UTF-8");
        answer
    }
}

impl Drop for ObjectStore {
    fn drop(&mut self) {
        // It may have ended.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// What cannot be written, as the bucket does not exist yet, waits.
#[tokio::test]
#[ignore = "needs moto: .ci/object-store"]
async fn a_history_in_an_object_store_waits_for_its_bucket_and_is_found_exported_and_deleted() {
    let store = ObjectStore::start();
    let folder = data_folder();
    let server = store.serve(folder.path());
    create_camera(&server, &json!({})).await;
    walk(&server, "ann", start(), 300).await;
    while server.log_lines("could not be written to the archive").is_empty() {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    store.request("PUT", "/histories");
    while items(&server, "camera=gate&limit=1000").await.len() < 300 - 30 {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    walk(&server, "bob", start(), 40).await;
    assert!(server.terminate());
    let server = store.serve(folder.path());
    assert_eq!(items(&server, "camera=gate&limit=1000").await.len(), 340);
    let csv = history(&server, "camera=gate&format=csv&target_id=bob").await.expect(200).text();
    assert_eq!(csv.lines().count(), 41);
    let objects = || store.request("GET", "/histories?list-type=2");
    assert!(objects().contains("<Key>of/gates/cameras/gate/"), "{}", objects());
    for (query, deleted) in [("&receiver_id=phone-7", 300), ("", 40)] {
        let path = format!("/v1/history?camera=gate{query}");
        let answer = server.send("DELETE", &path, &[], "").await.expect(200).json();
        assert_eq!(answer, json!({ "deleted": deleted }));
    }
    assert!(!objects().contains("<Key>"), "{}", objects());
}

fn files_below(folder: &std::path::Path) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    entries.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}
