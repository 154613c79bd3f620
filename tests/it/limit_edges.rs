//! Limits of work, each with what is just allowed and what is one too many.

use std::time::Duration;

use serde_json::{Value, json};
use sightfix::clock::{Clock, Randomness};
use sightfix::config::Config;
use sightfix::server::Server;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::harness::{Answer, TestServer, data_folder, simulated_csv};

/// A server with a camera and 600 samples of it.
async fn trained_on(folder: &std::path::Path, settings: &[(&str, &str)]) -> TestServer {
    let server = TestServer::start_with(folder, settings);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let headers = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/c/samples", &headers, simulated_csv()).await.expect(200);
    server
}

#[tokio::test]
async fn a_training_run_takes_so_many_of_the_latest_samples() {
    for (limit, taken) in [("600", "600 samples and"), ("599", "599 samples and")] {
        let folder = data_folder();
        let server = trained_on(folder.path(), &[("SIGHTFIX_LIMITS__SAMPLES_PER_RUN", limit)]).await;
        let run = server.train("c", &json!({"recipe": "projective", "epochs": 2})).await;
        let id = run["id"].as_str().expect("an id");
        let log = server.get(&format!("/v1/cameras/c/training-runs/{id}/log")).await.expect(200).text();
        assert!(log.contains(taken), "{limit}: {log}");
    }
}

#[tokio::test]
async fn targets_beyond_the_limit_of_a_camera_are_refused() {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__TRACKS_PER_CAMERA", "2")]);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let follow = async |target: &str| -> Answer {
        let fix = json!({"longitude_deg": 24.7453, "latitude_deg": 59.4371});
        let observation = json!({"time": "2026-01-01T00:00:00Z", "target_id": target, "fix": fix});
        server.post("/v1/cameras/c/tracks", &json!({"observations": [observation]})).await
    };
    follow("a").await.expect(200);
    follow("b").await.expect(200);
    let third: Value = follow("c").await.json();
    assert!(third.to_string().contains("overloaded"), "{third}");
    follow("b").await.expect(200);
}

/// The answer to one request over a connection of its own.
async fn exchange(mut stream: TcpStream, request: String) -> String {
    stream.write_all(request.as_bytes()).await.expect("the server reads");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.expect("an answer");
    answer
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn imports_in_two_parts_wait_for_a_place() {
    let folder = data_folder();
    let mut config = Config { data: folder.path().to_owned(), ..Config::default() };
    config.listen.set_port(0);
    config.limits.pairings = 1;
    let server = Server::bind(config, Clock::system(), Randomness::seeded(1)).await.expect("a free port");
    let (address, app, shutdown) =
        (server.address().expect("an address"), server.app().clone(), server.shutdown());
    let camera = sightfix::domain::CameraId::new("c").expect("a slug");
    app.cameras().create(sightfix::domain::NewCamera::named(camera)).await.expect("a new camera");
    let serving = tokio::spawn(server.run());
    let request = two_parts(
        "",
        "time,target_id,left,top,width,height\n2026-01-01T00:00:00Z,a,1,2,3,4\n",
        "time,target_id,longitude,latitude\n2026-01-01T00:00:00Z,a,24.7,59.4\n",
    );
    let place = app.pairings.try_acquire().expect("one place");
    assert!(app.pairings.try_acquire().is_err(), "and no other");
    let stream = TcpStream::connect(address).await.expect("the server listens");
    let waiting = tokio::spawn(exchange(stream, request));
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert!(!waiting.is_finished(), "it waits");
    drop(place);
    let answer = waiting.await.expect("no panic");
    assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("\"accepted\":1"), "{answer}");
    shutdown.drain();
    serving.await.expect("no panic").expect("an orderly end");
}

/// A request of two parts, for [`exchange`].
fn two_parts(query: &str, detections: &str, fixes: &str) -> String {
    let part = |name: &str, content: &str| {
        format!(
            "--b\r\ncontent-disposition: form-data; name=\"{name}\"\r\ncontent-type: text/csv\r\n\r\n{content}\r\n"
        )
    };
    let body = part("detections", detections) + &part("fixes", fixes) + "--b--\r\n";
    format!(
        "POST /v1/cameras/c/samples/pairings{query} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\
         content-type: multipart/form-data; boundary=b\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    )
}

#[tokio::test]
async fn matching_takes_so_many_tracklets_and_receivers() {
    let detections = |trackers: u32| {
        let mut csv = "time,target_id,left,top,width,height\n".to_owned();
        for second in 0..30 {
            for tracker in 0..trackers {
                csv += &format!("2026-01-01T00:00:{second:02}Z,t{tracker},{},2,30,60\n", second * 10);
            }
        }
        csv
    };
    let fixes = |receivers: u32| {
        let mut csv = "time,receiver_id,longitude,latitude\n".to_owned();
        for second in 0..30 {
            for receiver in 0..receivers {
                csv += &format!("2026-01-01T00:00:{second:02}Z,r{receiver},24.7{second:02},59.4\n");
            }
        }
        csv
    };
    let folder = data_folder();
    // Two tracklets and two receivers of 30 fixes, which stand still but for the first: 120 comparisons.
    let settings = [
        ("SIGHTFIX_LIMITS__MATCH_TRACKLETS", "2"),
        ("SIGHTFIX_LIMITS__MATCH_RECEIVERS", "2"),
        ("SIGHTFIX_LIMITS__MATCH_COMPARISONS", "120"),
    ];
    let server = TestServer::start_with(folder.path(), &settings);
    let camera = json!({"id": "c", "image_size": {"width_px": 1920, "height_px": 1080}});
    server.post("/v1/cameras", &camera).await.expect(201);
    let offsets = "?match=true&clock_window_s=1";
    for (query, trackers, receivers, is_refused) in [
        ("?match=true", 2, 2, false),
        ("?match=true", 3, 2, true),
        ("?match=true", 2, 3, true),
        (offsets, 2, 2, true),
        (offsets, 1, 1, true),
    ] {
        let stream = TcpStream::connect(server.address).await.expect("the server listens");
        let request = two_parts(query, &detections(trackers), &fixes(receivers));
        let answer = exchange(stream, request).await;
        assert_eq!(answer.contains("problem:too-large"), is_refused, "{trackers}, {receivers}: {answer}");
        assert_eq!(answer.contains("smaller clock_window_s"), query == offsets, "{answer}");
    }
}

#[tokio::test]
async fn keys_have_their_limit_and_those_that_were_revoked_give_way() {
    let folder = data_folder();
    let settings = [("SIGHTFIX_LIMITS__KEYS", "2")];
    let key = crate::harness::run(&["keys", "generate"]).trim().to_owned();
    let server =
        TestServer::start_with(folder.path(), &[&settings[..], &[("SIGHTFIX_ADMIN_KEY", &*key)]].concat());
    let bearer = format!("Bearer {key}");
    let headers = [("authorization", &*bearer), ("content-type", "application/json")];
    let create = async || server.send("POST", "/v1/keys", &headers, r#"{"name":"n","role":"viewer"}"#).await;
    let second = create().await.expect(201).json();
    create().await.expect(507);
    let path = format!("/v1/keys/{}", second["id"].as_str().expect("an id"));
    let revoked = server.send("DELETE", &path, &headers, "").await;
    assert!(revoked.status.is_success(), "{}", revoked.text());
    create().await.expect(201);
    create().await.expect(507);
}
