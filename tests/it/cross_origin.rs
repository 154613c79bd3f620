//! Pages of other origins: none by default, exactly those of the setting otherwise.

use serde_json::json;

use crate::harness::{TestServer, data_folder, run};

const PAGE: &str = "https://maps.example.org";

fn preflight(origin: &str) -> [(&str, &str); 3] {
    [
        ("origin", origin),
        ("access-control-request-method", "POST"),
        ("access-control-request-headers", "authorization,content-type,idempotency-key"),
    ]
}

#[tokio::test]
async fn no_page_of_another_origin_is_let_in_by_default() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let answer = server.send("OPTIONS", "/v1/cameras", &preflight(PAGE), "").await;
    assert!(answer.headers.get("access-control-allow-origin").is_none());
    let answer = server.send("GET", "/v1/cameras", &[("origin", PAGE)], "").await.expect(200);
    assert!(answer.headers.get("access-control-allow-origin").is_none());
    let headers = [("origin", PAGE), ("content-type", "application/json")];
    server.send("POST", "/v1/cameras", &headers, r#"{"id":"c"}"#).await.expect(403);
}

#[tokio::test]
async fn a_page_of_a_listed_origin_uses_the_interface_with_a_key() {
    let folder = data_folder();
    let data = folder.path().to_str().expect("UTF-8");
    let key = run(&["keys", "create", "--name", "page", "--role", "operator", "--data", data]);
    let key = format!("Bearer {}", key.trim());
    let origins = format!("{PAGE},http://localhost:3000");
    let server = TestServer::start_with(folder.path(), &[("SIGHTFIX_CORS_ORIGINS", &origins)]);

    // A browser asks without the key.
    let allowed = server.send("OPTIONS", "/v1/cameras", &preflight(PAGE), "").await.expect(200);
    assert_eq!(allowed.header("access-control-allow-origin"), PAGE);
    assert!(allowed.header("access-control-allow-methods").contains("PATCH"));
    for header in ["authorization", "content-type", "idempotency-key", "last-event-id", "if-match"] {
        assert!(allowed.header("access-control-allow-headers").contains(header), "{header}");
    }
    assert!(allowed.headers.get("access-control-allow-credentials").is_none(), "cookies stay at home");

    let headers = [("origin", PAGE), ("authorization", &*key), ("content-type", "application/json")];
    let created =
        server.send("POST", "/v1/cameras", &headers, json!({"id": "c"}).to_string()).await.expect(201);
    assert_eq!(created.header("access-control-allow-origin"), PAGE);
    assert!(created.header("access-control-expose-headers").contains("location"));
    assert!(
        created
            .headers
            .get_all("vary")
            .iter()
            .any(|value| value.as_bytes().windows(6).any(|it| it == b"origin"))
    );
    // It can read why it is refused.
    let refused = server.send("GET", "/v1/cameras", &[("origin", PAGE)], "").await.expect(401);
    assert_eq!(refused.header("access-control-allow-origin"), PAGE);
    assert_eq!(refused.json()["type"], "urn:sightfix:problem:unauthenticated");

    for origin in
        ["https://maps.example.org.evil.example", "http://maps.example.org", "https://example.org", "null"]
    {
        let answer = server.send("OPTIONS", "/v1/cameras", &preflight(origin), "").await;
        assert!(answer.headers.get("access-control-allow-origin").is_none(), "{origin}");
        let headers = [("origin", origin), ("authorization", &*key), ("content-type", "application/json")];
        server.send("POST", "/v1/cameras", &headers, r#"{"id":"d"}"#).await.expect(403);
    }
}

#[test]
fn what_is_no_origin_is_no_setting() {
    for origin in
        ["*", "maps.example.org", "https://maps.example.org/", "https://maps.example.org/x", "ftp://a"]
    {
        let output = crate::harness::sightfix()
            .args(["config"])
            .env("SIGHTFIX_CORS_ORIGINS", origin)
            .output()
            .expect("the binary runs");
        assert!(!output.status.success(), "{origin}");
        assert!(String::from_utf8_lossy(&output.stderr).contains("cors_origins"), "{origin}");
    }
}
