//! The audit log: who changed what, when and from where.

use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder, run, simulated_csv};

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");

async fn entries(server: &TestServer, headers: &[(&str, &str)], query: &str) -> Vec<Value> {
    let page = server.send("GET", &format!("/v1/audit{query}"), headers, "").await.expect(200).json();
    page["items"].as_array().expect("items").clone()
}

#[tokio::test]
async fn every_change_has_its_entry() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let json_type = ("content-type", "application/json");
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let if_match = [json_type, ("if-match", "*")];
    server.send("PATCH", "/v1/cameras/c", &if_match, r#"{"display_name": "gate"}"#).await.expect(200);
    // A change that is refused leaves no entry.
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(409);
    let csv = [("content-type", "text/csv")];
    server.send("POST", "/v1/cameras/c/samples", &csv, simulated_csv()).await.expect(200);
    let started = server.post("/v1/cameras/c/training-runs", &json!({})).await.expect(202);
    let run_path = started.header("location").to_owned();
    server.send("POST", &format!("{run_path}/cancel"), &[], "").await;
    while matches!(
        server.get(&run_path).await.json()["state"].as_str(),
        Some("queued" | "running" | "cancelling")
    ) {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    server.send("DELETE", &run_path, &[], "").await.expect(204);
    let model = std::fs::read(MODEL).expect("a model");
    for _ in 0..2 {
        let headers = [("content-type", "application/octet-stream")];
        server.send("POST", "/v1/cameras/c/models", &headers, model.clone()).await.expect(201);
    }
    for number in [1, 2] {
        let body = json!({ "number": number }).to_string();
        server.send("PUT", "/v1/cameras/c/active-model", &[json_type], body).await.expect(200);
    }
    server.send("POST", "/v1/cameras/c/active-model/roll-back", &[], "").await.expect(200);
    server.send("DELETE", "/v1/cameras/c/models/2", &[], "").await.expect(204);
    server.send("DELETE", "/v1/cameras/c/samples?until=2000-01-01T00:00:00Z", &[], "").await.expect(200);
    server.send("DELETE", "/v1/cameras/c", &[("x-request-id", "the-last")], "").await.expect(204);

    let log = entries(&server, &[], "?camera=c").await;
    let actions: Vec<&str> = log.iter().rev().filter_map(|entry| entry["action"].as_str()).collect();
    assert_eq!(
        actions,
        [
            "camera-created",
            "camera-changed",
            "run-started",
            "run-cancelled",
            "run-deleted",
            "model-imported",
            "model-imported",
            "model-activated",
            "model-activated",
            "model-rolled-back",
            "model-deleted",
            "samples-deleted",
            "camera-deleted",
        ]
    );
    assert_eq!((&log[0]["actor"], &log[0]["address"]), (&json!("open access"), &json!("127.0.0.1")));
    assert_eq!((&log[0]["request_id"], &log[0]["camera_id"]), (&json!("the-last"), &json!("c")));
    assert_eq!((&log[1]["subject"], &log[2]["subject"]), (&json!("0 samples"), &json!("version 2")));
    let numbers: Vec<u64> = log.iter().filter_map(|entry| entry["number"].as_u64()).collect();
    assert!(numbers.windows(2).all(|pair| pair[0] > pair[1]), "newest first: {numbers:?}");
}

#[tokio::test]
async fn an_entry_names_the_key_and_pages_join_without_gaps() {
    let folder = data_folder();
    let path = folder.path().to_str().expect("UTF-8");
    let key = run(&["keys", "create", "--name", "Ada", "--role", "admin", "--data", path]).trim().to_owned();
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__AUDIT_ENTRIES", "5")]);
    let authorization = format!("Bearer {key}");
    let headers = [("authorization", authorization.as_str()), ("content-type", "application/json")];
    let first = entries(&server, &headers, "").await;
    assert_eq!((&first[0]["action"], &first[0]["actor"]), (&json!("key-created"), &json!("sightfix keys")));
    assert!(first[0]["address"].is_null() && first[0]["key_id"].is_null(), "{first:?}");
    for number in 1..=6 {
        let body = json!({ "id": format!("c{number}") }).to_string();
        server.send("POST", "/v1/cameras", &headers, body).await.expect(201);
    }
    let (mut seen, mut query) = (Vec::new(), "?limit=2".to_owned());
    loop {
        let page = server.send("GET", &format!("/v1/audit{query}"), &headers, "").await.expect(200).json();
        for entry in page["items"].as_array().expect("items") {
            assert_eq!(entry["actor"], "Ada");
            assert!(entry["key_id"].is_string() && entry["request_id"].is_string(), "{entry}");
            seen.push(entry["camera_id"].as_str().expect("a camera").to_owned());
        }
        let Some(cursor) = page["next_cursor"].as_str() else { break };
        query = format!("?limit=2&cursor={cursor}");
    }
    // The limit keeps the newest.
    assert_eq!(seen, ["c6", "c5", "c4", "c3", "c2"]);
}
