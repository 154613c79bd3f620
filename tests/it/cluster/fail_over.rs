//! Databases that are out of reach, read-only, or continue from an earlier state than they have acknowledged.

use std::process::Stdio;
use std::time::Duration;

use serde_json::{Value, json};

use super::database::{Database, Link};
use super::{create, until_status};
use crate::harness::{Answer, TestServer, sightfix};

/// A node with leases of two seconds whose way to the database is a link.
async fn node_at(database: &Database, link: &Link) -> TestServer {
    let mut command = sightfix();
    command.args(["serve", "--listen", "127.0.0.1:0", "--database", &database.url(Some(link.port))]);
    command.env("SIGHTFIX_NODE_LEASE_S", "2").stdout(Stdio::null());
    tokio::task::spawn_blocking(|| TestServer::run(command)).await.expect("it starts")
}

async fn send(server: &TestServer, key: &str, method: &str, path: &str, body: &Value) -> Answer {
    let bearer = format!("Bearer {key}");
    let headers = [("authorization", &*bearer), ("content-type", "application/json")];
    server.send(method, path, &headers, if body.is_null() { String::new() } else { body.to_string() }).await
}

/// Id and secret of a new key.
async fn create_key(server: &TestServer, admin: &str, role: &str) -> (String, String) {
    let created =
        send(server, admin, "POST", "/v1/keys", &json!({"name": role, "role": role})).await.expect(201);
    let text = |value: &Value| value.as_str().unwrap_or_else(|| panic!("{}", created.text())).to_owned();
    (text(&created.json()["id"]), text(&created.json()["secret"]))
}

/// The status of a request that is sent again and again until it is none of these.
async fn status_after(server: &TestServer, key: &str, path: &str, statuses: &[u16]) -> u16 {
    let mut seen = 0;
    for _ in 0..800 {
        seen = send(server, key, "GET", path, &Value::Null).await.status.as_u16();
        if !statuses.contains(&seen) {
            return seen;
        }
        tokio::time::sleep(Duration::from_millis(25)).await;
    }
    seen
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_node_that_is_cut_off_takes_no_key_that_others_may_have_revoked() {
    let database = Database::start().await;
    let links = [Link::to(database.address()).await, Link::to(database.address()).await];
    let nodes = [node_at(&database, &links[0]).await, node_at(&database, &links[1]).await];
    let (_, admin) = create_key(&nodes[0], "none", "admin").await;
    let (id, key) = create_key(&nodes[0], &admin, "viewer").await;
    // Nothing of the database is asked for: only the key decides.
    let path = "/v1/server";
    assert_eq!(status_after(&nodes[1], &key, path, &[401]).await, 200, "known to every node");
    links[0].cut();
    send(&nodes[1], &admin, "DELETE", &format!("/v1/keys/{id}"), &Value::Null).await.expect(204);
    assert_eq!(send(&nodes[1], &key, "GET", path, &Value::Null).await.status, 401);
    assert_eq!(
        status_after(&nodes[0], &key, path, &[200]).await,
        503,
        "it cannot know whether the key works"
    );
    nodes[0].get("/livez").await.expect(200);
    nodes[0].get("/readyz").await.expect(503);
    links[0].mend();
    assert_eq!(status_after(&nodes[0], &key, path, &[503]).await, 401);
    assert_eq!(status_after(&nodes[0], &admin, path, &[503]).await, 200);
}

/// A node without any key cannot know, once it is cut off, whether another one has created the first.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn a_balancer_that_accepts_and_closes_is_no_fault_of_the_server() {
    let database = Database::start().await;
    let link = Link::to(database.address()).await;
    let node = node_at(&database, &link).await;
    create(&node, &json!({"id": "yard"})).await;
    node.get("/readyz").await.expect(200);
    link.close();
    for _ in 0..30 {
        let answers = [
            node.get("/readyz").await,
            node.get("/v1/cameras/yard/samples").await,
            node.post("/v1/cameras", &json!({"id": "gate"})).await,
        ];
        for answer in answers {
            assert_eq!(answer.status, 503, "{}", answer.text());
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert_eq!(
        status_after(&node, "none", "/v1/server", &[200]).await,
        503,
        "another may have created a key"
    );
    let mut command = sightfix();
    command.args(["serve", "--listen", "127.0.0.1:0", "--database", &database.url(Some(link.port))]);
    let refused =
        tokio::task::spawn_blocking(move || command.output()).await.expect("no panic").expect("it runs");
    assert_eq!(refused.status.code(), Some(3), "{}", String::from_utf8_lossy(&refused.stderr));
    link.mend();
    until_status(&node, "/readyz", 200).await;
    node.post("/v1/cameras", &json!({"id": "gate"})).await.expect(201);
}

/// The standby has not received what was acknowledged last; then its numbers of transactions, keys and revisions are given
/// out again.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs PostgreSQL: .ci/postgres"]
async fn after_an_asynchronous_fail_over_a_node_answers_from_the_history_that_is_left() {
    let mut primary = Database::start().await;
    let mut link = Link::to(primary.address()).await;
    let node = node_at(&primary, &link).await;
    let (_, admin) = create_key(&node, "none", "admin").await;
    let (kept_id, kept) = create_key(&node, &admin, "viewer").await;
    let (lost_id, lost) = create_key(&node, &admin, "viewer").await;
    send(&node, &admin, "POST", "/v1/cameras", &json!({"id": "yard"})).await.expect(201);
    let standby = primary.standby().await;
    standby.stop_receiving().await;

    // Acknowledged, and not received.
    let small = json!({"image_size": {"width_px": 640, "height_px": 480}});
    let patch = ("content-type", "application/merge-patch+json");
    let bearer = format!("Bearer {admin}");
    let changed = node
        .send(
            "PATCH",
            "/v1/cameras/yard",
            &[patch, ("authorization", &*bearer), ("if-match", "*")],
            small.to_string(),
        )
        .await;
    changed.expect(200);
    send(&node, &admin, "POST", "/v1/cameras", &json!({"id": "gate"})).await.expect(201);
    send(&node, &admin, "DELETE", &format!("/v1/keys/{lost_id}"), &Value::Null).await.expect(204);
    let fix = json!({"time": "2026-01-01T00:00:00Z", "fix": {"longitude_deg": 8.0, "latitude_deg": 47.0}});
    send(&node, &admin, "POST", "/v1/cameras/gate/fusions", &fix).await.expect(200);
    primary.kill();

    // A standby takes no changes: not ready, tried again.
    link.lead_to(standby.address());
    until_status(&node, "/readyz", 503).await;
    let refused = send(&node, &admin, "POST", "/v1/cameras", &json!({"id": "dock"})).await;
    assert_eq!(refused.status, 503, "{}", refused.text());
    let mut command = sightfix();
    command.args(["serve", "--listen", "127.0.0.1:0", "--database", &standby.url(None)]);
    let start =
        tokio::task::spawn_blocking(move || command.output()).await.expect("no panic").expect("it runs");
    assert_eq!(start.status.code(), Some(3), "{}", String::from_utf8_lossy(&start.stderr));

    standby.promote().await;
    // As another node would: as many keys, as many revoked, and the same latest one as before.
    let revoke = format!("UPDATE api_keys SET revoked_at_us = 1 WHERE id = '{kept_id}'");
    standby.sql(&revoke).expect("revoked");
    let change = "UPDATE cameras SET revision = revision + 1, \
        profile = jsonb_set(profile::jsonb, '{image_size_px}', '[1920, 1080]')::text";
    standby.sql(change).expect("changed");
    let ready = until_status(&node, "/readyz", 200).await;
    assert_eq!(ready.text(), "ready\n", "nobody without a key learns more");
    let gate = "/v1/cameras/gate/tracks";
    assert_eq!(status_after(&node, &admin, gate, &[200, 503]).await, 404, "the camera is lost");
    assert_eq!(status_after(&node, &kept, "/v1/server", &[200, 503]).await, 401, "revoked in this history");
    assert_eq!(status_after(&node, &lost, "/v1/server", &[401, 503]).await, 200, "its revocation is lost");
    assert_eq!(status_after(&node, &admin, "/readyz", &[503]).await, 200, "everything was read again");
    // The box is outside of the image that was acknowledged and lost, and would be refused for that first.
    let boxed = json!({"time": "2026-01-01T00:00:00Z", "fix": {"longitude_deg": 8.0, "latitude_deg": 47.0},
        "bounding_box": {"left_px": 1000, "top_px": 800, "width_px": 60, "height_px": 120}});
    let fused = send(&node, &admin, "POST", "/v1/cameras/yard/fusions", &boxed).await.expect(409);
    assert_eq!(fused.json()["type"], "urn:sightfix:problem:no-model");

    let readiness = send(&node, &admin, "GET", "/readyz", &Value::Null).await.expect(200).text();
    assert!(readiness.contains("degraded: database: its history changed"), "{readiness}");
    let metrics = send(&node, &admin, "GET", "/metrics", &Value::Null).await.expect(200).text();
    assert!(metrics.contains("sightfix_database_history_breaks_total 1"), "{metrics}");
    assert_eq!(node.log_lines("the history of the database has changed").len(), 1);
}
