//! Requests of a foreign web page, opened by a person who reaches the server.

use serde_json::json;
use sightfix::grpc::proto;
use sightfix::grpc::proto::camera_service_client::CameraServiceClient;
use tonic::Code;

use crate::harness::{TestServer, data_folder};

const EVIL: &str = "http://evil.example";

async fn with_camera(settings: &[(&str, &str)]) -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start_with(folder.path(), settings);
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    (folder, server)
}

#[tokio::test]
async fn a_name_that_somebody_else_pointed_here_is_refused() {
    let (_folder, server) = with_camera(&[]).await;
    let port = server.address.port();
    for host in [format!("evil.example:{port}"), "evil.example".to_owned(), format!("192.0.2.1:{port}")] {
        let answer = server.send("GET", "/v1/cameras", &[("host", &host)], "").await.expect(421);
        let problem = answer.json();
        assert_eq!(problem["type"], "urn:sightfix:problem:host-not-allowed", "{problem}");
        assert!(problem["detail"].as_str().is_some_and(|text| text.contains("allowed_hosts")), "{problem}");
    }
    for host in [format!("localhost:{port}"), format!("127.0.0.1:{port}"), "[::1]".to_owned()] {
        server.send("GET", "/v1/cameras", &[("host", &host)], "").await.expect(200);
    }
    let endpoint = server.endpoint();
    let named = |origin: &'static str| {
        let endpoint = endpoint.clone().origin(origin.parse().expect("an origin"));
        async move {
            let channel = endpoint.connect().await.expect("a connection");
            CameraServiceClient::new(channel).list_cameras(proto::ListCamerasRequest::default()).await
        }
    };
    let refused = named(EVIL).await.expect_err("another name");
    assert_eq!(refused.code(), Code::PermissionDenied, "{refused:?}");
    named("http://localhost").await.expect("this machine");
}

#[tokio::test]
async fn configured_names_are_answered() {
    let (_folder, server) =
        with_camera(&[("SIGHTFIX_ALLOWED_HOSTS", "sight.example.org,other.example:8443")]).await;
    for (host, status) in [
        ("sight.example.org", 200),
        ("sight.example.org:443", 200),
        ("other.example", 421),
        ("other.example:8443", 200),
    ] {
        server.send("GET", "/v1/cameras", &[("host", host)], "").await.expect(status);
    }
    let headers = [("origin", "https://sight.example.org"), ("content-type", "application/json")];
    server.send("POST", "/v1/cameras", &headers, r#"{"id": "d"}"#).await.expect(201);
}

#[tokio::test]
async fn pages_of_other_origins_change_nothing() {
    let (_folder, server) = with_camera(&[]).await;
    let form = "--x\r\ncontent-disposition: form-data; name=\"detections\"; filename=\"d.csv\"\r\n\r\n\
                time,target_id,left,top,width,height\n2026-01-01T00:00:00Z,a,1,2,3,4\n\r\n\
                --x\r\ncontent-disposition: form-data; name=\"fixes\"; filename=\"f.csv\"\r\n\r\n\
                time,longitude,latitude\n2026-01-01T00:00:00Z,103.9,30.6\n\r\n--x--\r\n";
    let port = server.address.port();
    for origin in [EVIL.to_owned(), "null".to_owned(), format!("http://localhost:{}", port ^ 1)] {
        for (path, content_type, body) in [
            ("/v1/cameras/c/training-runs", "text/plain", ""),
            ("/v1/cameras/c/samples/pairings", "multipart/form-data; boundary=x", form),
            ("/v1/cameras/c/fusions", "text/plain", "{}"),
        ] {
            let headers = [("origin", origin.as_str()), ("content-type", content_type)];
            let answer = server.send("POST", path, &headers, body).await.expect(403);
            assert_eq!(answer.json()["type"], "urn:sightfix:problem:origin-not-allowed");
        }
    }
    let count = server.get("/v1/cameras/c/samples/count").await.expect(200).json();
    assert_eq!(count["count"], 0);
    let own = format!("http://{}", server.address);
    let headers = [("origin", own.as_str()), ("content-type", "multipart/form-data; boundary=x")];
    let report = server.send("POST", "/v1/cameras/c/samples/pairings", &headers, form).await.expect(200);
    assert_eq!(report.json()["accepted"], 1, "the page of the server itself may");
}

#[tokio::test]
async fn browsers_are_told_what_pages_may_do() {
    let (_folder, server) = with_camera(&[]).await;
    for path in ["/docs/", "/openapi.json", "/v1/cameras", "/v1/none"] {
        assert_eq!(server.get(path).await.header("x-content-type-options"), "nosniff", "{path}");
    }
    for path in ["/docs/", "/docs/swagger/swagger-ui-bundle.js"] {
        let page = server.get(path).await.expect(200);
        let policy = page.header("content-security-policy");
        assert!(
            policy.contains("default-src 'none'") && policy.contains("frame-ancestors 'none'"),
            "{policy}"
        );
        assert!(policy.contains("script-src 'self';"), "{policy}");
        assert_eq!(page.header("x-frame-options"), "DENY");
    }
    let page = server.get("/docs/").await.text();
    for script in page.match_indices("<script").map(|(at, _)| &page[at..]) {
        let tag = &script[..script.find('>').expect("closed")];
        assert!(tag.contains("src="), "the policy lets no script run that stands in the page: {tag}");
    }
}

#[tokio::test]
async fn names_come_back_from_csv_and_none_is_a_formula() {
    let (_folder, server) = with_camera(&[]).await;
    let names = ["=HYPERLINK(\"http://evil.example\",\"x\")", "+1", "-1", "@a", "'=b", "'plain", "-a,b"];
    let rows: Vec<String> = names
        .iter()
        .enumerate()
        .map(|(second, name)| {
            json!({
                "time": format!("2026-01-01T00:00:{second:02}Z"), "target_id": name, "class": name,
                "bounding_box": {"left_px": -1.5, "top_px": 2, "width_px": 3, "height_px": 4},
                "fix": {"longitude_deg": -103.9, "latitude_deg": -30.6},
            })
            .to_string()
        })
        .collect();
    let headers = [("content-type", "application/x-ndjson")];
    let path = "/v1/cameras/c/samples";
    let report = server.send("POST", path, &headers, rows.join("\n")).await.expect(200).json();
    assert_eq!(report["accepted"], names.len(), "{report}");

    let csv = server.send("GET", path, &[("accept", "text/csv")], "").await.expect(200).text();
    let mut reader = csv::Reader::from_reader(csv.as_bytes());
    let header = reader.headers().expect("a header").clone();
    for record in reader.records() {
        let record = record.expect("a record");
        for (column, cell) in header.iter().zip(record.iter()) {
            let is_number = cell.is_empty() || cell.parse::<f64>().is_ok();
            let is_text = matches!(column, "target_id" | "class" | "time");
            assert!(is_text || is_number, "{column} is no number: {cell}");
            assert!(!is_text || !cell.starts_with(['=', '+', '-', '@']), "{column}: {cell}");
        }
    }

    server.post("/v1/cameras", &json!({"id": "copy"})).await.expect(201);
    let headers = [("content-type", "text/csv")];
    let report = server.send("POST", "/v1/cameras/copy/samples", &headers, csv).await.expect(200).json();
    assert_eq!(report["accepted"], names.len(), "{report}");
    let copy = server.get("/v1/cameras/copy/samples").await.expect(200).json();
    let original = server.get(path).await.expect(200).json();
    assert_eq!(copy["items"], original["items"]);
}
