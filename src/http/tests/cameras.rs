use super::*;

#[tokio::test]
async fn a_camera_is_made_read_changed_and_deleted() {
    let rest = Rest::new().await;
    let profile = json!({
        "id": "north-gate", "display_name": "North gate", "image_size": {"width_px": 1920, "height_px": 1080},
        "gnss_error": {"sigma_m": 2.5}, "recipe": "paper", "target_classes": ["person"], "labels": {"site": "a"},
        "receivers": [
            {"receiver_id": "phone-7", "target_id": "person-1", "clock_offset_s": -18.35},
            {"receiver_id": "tag", "target_id": "tag", "clock_offset_s": 0.0},
        ],
    });
    let made = rest.post("/v1/cameras", &profile).await.expect(201);
    assert_eq!(made.header("location"), "/v1/cameras/north-gate");
    let etag = made.header("etag").to_owned();
    let camera = made.json();
    for (name, value) in profile.as_object().expect("fields") {
        assert_eq!(&camera[name], value, "{name}");
    }
    assert_eq!(camera["warnings"], json!([]));
    let read = rest.get("/v1/cameras/north-gate").await.expect(200);
    assert_eq!((read.header("etag"), read.json()), (etag.as_str(), camera));
    let known = rest.send("GET", "/v1/cameras/north-gate", &[("if-none-match", &etag)], Body::empty()).await;
    assert!(known.expect(304).body.is_empty());

    let path = "/v1/cameras/north-gate";
    let patch = |if_match: &'static str, change: Value| {
        let headers = [("content-type", "application/merge-patch+json"), ("if-match", if_match)];
        let rest = &rest;
        async move { rest.send("PATCH", path, &headers, change.to_string()).await }
    };
    let changed = patch("\"1\"", json!({"image_size": null, "gnss_error": "unknown"})).await.expect(200);
    let changed_etag = changed.header("etag").to_owned();
    assert_ne!(changed_etag, etag);
    rest.send("GET", path, &[("if-none-match", &etag)], Body::empty()).await.expect(200);
    let camera = changed.json();
    assert_eq!((camera.get("image_size"), &camera["gnss_error"]), (None, &json!("unknown")));
    assert_eq!(camera["display_name"], "North gate", "what is left out stays");
    assert_eq!(camera["receivers"], profile["receivers"], "what is left out stays");
    assert_eq!(camera["warnings"].as_array().map(Vec::len), Some(2));

    let bare = json!({"receivers": [{"receiver_id": "b"}, {"receiver_id": "a", "clock_offset_s": 2}]});
    let expected = json!([
        {"receiver_id": "a", "target_id": "a", "clock_offset_s": 2.0},
        {"receiver_id": "b", "target_id": "b", "clock_offset_s": 0.0},
    ]);
    assert_eq!(patch("*", bare).await.expect(200).json()["receivers"], expected);
    assert_eq!(patch("*", json!({"receivers": []})).await.expect(200).json()["receivers"], json!([]));

    patch("\"1\"", json!({"recipe": "auto"})).await.problem(412, "revision-mismatch");
    patch("1", json!({"recipe": "auto"})).await.problem(412, "revision-mismatch");
    assert_eq!(patch("*", json!({"recipe": "auto"})).await.expect(200).json()["recipe"], "auto");
    let without = rest.send("PATCH", path, &[("content-type", "application/json")], "{}").await;
    assert_eq!(without.problem(428, "revision-required"), ["if-match"]);

    let stale = rest.send("DELETE", path, &[("if-match", "\"1\"")], Body::empty()).await;
    stale.problem(412, "revision-mismatch");
    assert!(rest.send("DELETE", path, &[], Body::empty()).await.expect(204).body.is_empty());
    rest.get(path).await.problem(404, "camera-not-found");
    // Another camera of the same id is not the one that was read.
    rest.post("/v1/cameras", &profile).await.expect(201);
    for known in [&etag, &changed_etag] {
        let stale = rest.send("DELETE", path, &[("if-match", known)], Body::empty()).await;
        stale.problem(412, "revision-mismatch");
        rest.send("GET", path, &[("if-none-match", known)], Body::empty()).await.expect(200);
    }
}

#[tokio::test]
async fn a_patch_merges_as_its_standard_says() {
    let rest = Rest::new().await;
    let profile = json!({
        "id": "c", "display_name": "Gate", "image_size": {"width_px": 1920, "height_px": 1080},
        "gnss_error": "unknown", "recipe": "paper", "labels": {"site": "a", "floor": "2"},
        "retrain_when_moved": true,
    });
    rest.post("/v1/cameras", &profile).await.expect(201);
    let rest = &rest;
    let patch = |change: Value| async move {
        let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
        rest.send("PATCH", "/v1/cameras/c", &headers, change.to_string()).await
    };
    let merged = patch(json!({"labels": {"floor": null, "door": "n"}, "image_size": {"height_px": 720}}));
    let merged = merged.await.expect(200).json();
    assert_eq!(merged["labels"], json!({"site": "a", "door": "n"}));
    assert_eq!(merged["image_size"], json!({"width_px": 1920, "height_px": 720}));
    let restored = patch(json!({
        "display_name": null, "recipe": null, "labels": null, "retrain_when_moved": null,
        "gnss_error": {"sigma_m": 2.0},
    }));
    let restored = restored.await.expect(200).json();
    assert_eq!((&restored["display_name"], &restored["recipe"]), (&json!("c"), &json!("auto")));
    assert_eq!((&restored["labels"], &restored["retrain_when_moved"]), (&json!({}), &json!(false)));
    assert_eq!(restored["gnss_error"], json!({"sigma_m": 2.0}));
    assert_eq!(restored["image_size"], merged["image_size"], "what is left out stays");
    for (change, field) in [
        (json!({"id": "d"}), "id"),
        (json!({"revision": 7}), "revision"),
        (json!({"image_size": {"width_px": "wide"}}), "image_size.width_px"),
        (json!(["c", "Gate"]), "body"),
        (json!(5), "body"),
    ] {
        assert_eq!(patch(change).await.problem(422, "invalid-argument"), [field]);
    }
}

#[tokio::test]
async fn bad_profiles_name_their_fields() {
    let rest = Rest::with_camera().await;
    for (profile, status, kind, field) in [
        (json!({}), 422, "invalid-argument", "id"),
        (json!({"id": 5}), 422, "invalid-argument", "id"),
        (json!({"id": "North Gate"}), 422, "invalid-argument", "id"),
        (json!({"id": "d", "name": "x"}), 422, "invalid-argument", "name"),
        (
            json!({"id": "d", "image_size": {"width_px": 0, "height_px": 1}}),
            422,
            "invalid-argument",
            "image_size.width_px",
        ),
        (json!({"id": "d", "image_size": {"width_px": 1}}), 422, "invalid-argument", "image_size.height_px"),
        (
            json!({"id": "d", "image_size": {"width_px": 1.5, "height_px": 1}}),
            422,
            "invalid-argument",
            "image_size.width_px",
        ),
        (json!({"id": "d", "gnss_error": {"sigma_m": -1}}), 422, "invalid-argument", "gnss_error.sigma_m"),
        (json!({"id": "d", "gnss_error": {"sigma_m": 1e39}}), 422, "invalid-argument", "gnss_error.sigma_m"),
        (json!({"id": "d", "recipe": "best"}), 422, "invalid-argument", "recipe"),
        (json!({"id": "d", "target_classes": ["a", ""]}), 422, "invalid-argument", "target_classes[1]"),
        (json!({"id": "d", "target_classes": ["a", "a"]}), 422, "invalid-argument", "target_classes[1]"),
        (json!({"id": "d", "receivers": [{}]}), 422, "invalid-argument", "receivers[0].receiver_id"),
        (
            json!({"id": "d", "receivers": [{"receiver_id": "a"}, {"receiver_id": "a"}]}),
            422,
            "invalid-argument",
            "receivers[1].receiver_id",
        ),
        (
            json!({"id": "d", "receivers": [{"receiver_id": "a", "target_id": ""}]}),
            422,
            "invalid-argument",
            "receivers[0].target_id",
        ),
        (
            json!({"id": "d", "receivers": [{"receiver_id": "a", "clock_offset_s": 86_401}]}),
            422,
            "invalid-argument",
            "receivers[0].clock_offset_s",
        ),
        (json!({"id": "d", "labels": {"a": 1}}), 422, "invalid-argument", "labels.a"),
        (json!({"id": "c"}), 409, "camera-exists", "id"),
    ] {
        let fields = rest.post("/v1/cameras", &profile).await.problem(status, kind);
        assert!(fields.is_empty() && kind == "camera-exists" || fields == [field], "{profile}: {fields:?}");
    }
    rest.send("POST", "/v1/cameras", &[("content-type", "application/json")], "{")
        .await
        .problem(400, "malformed-body");
    rest.send("POST", "/v1/cameras", &[("content-type", "application/json")], "")
        .await
        .problem(400, "malformed-body");
    rest.send("POST", "/v1/cameras", &[], "{}").await.problem(415, "unsupported-media-type");
    rest.get("/v1/cameras/d").await.problem(404, "camera-not-found");
    rest.get("/v1/cameras/NO%2FSLUG").await.problem(404, "camera-not-found");
}

#[tokio::test]
async fn cameras_are_listed_page_by_page() {
    let rest = Rest::new().await;
    for id in ["a", "b", "d", "c", "e"] {
        rest.post("/v1/cameras", &json!({"id": id})).await.expect(201);
    }
    let (mut seen, mut path) = (Vec::new(), "/v1/cameras?limit=2".to_owned());
    loop {
        let page = rest.get(&path).await.expect(200).json();
        let items = page["items"].as_array().expect("items");
        seen.extend(items.iter().map(|camera| camera["id"].as_str().expect("an id").to_owned()));
        let Some(cursor) = page["next_cursor"].as_str() else { break };
        assert_eq!(items.len(), 2);
        path = format!("/v1/cameras?limit=2&cursor={cursor}");
    }
    assert_eq!(seen, ["a", "b", "c", "d", "e"]);
    for (query, field) in [
        ("limit=0", "limit"),
        ("limit=1001", "limit"),
        ("limit=x", "limit"),
        ("limit=1&limit=2", "limit"),
        ("cursor=x", "cursor"),
        ("page=2", "page"),
    ] {
        let answer = rest.get(&format!("/v1/cameras?{query}")).await;
        assert_eq!(answer.problem(422, "invalid-argument"), [field], "{query}");
    }
}

#[tokio::test]
async fn a_receivers_error_is_told_from_fixes_at_one_point() {
    let rest = Rest::with_camera().await;
    let path = "/v1/cameras/c/gnss-error";
    let spread: Vec<f64> = (0..50).map(|n| f64::from(n % 7) * 1e-5).collect();
    let csv: String = spread.iter().map(|d| format!("{},{}\n", 103.9 + d, 30.6 - d)).collect();
    let response = rest.csv(path, format!("longitude,latitude\n{csv}181,30\n")).await.expect(200).json();
    assert_eq!((&response["fixes"], &response["rejected"]), (&json!(50), &json!(1)), "{response}");
    assert_eq!(response["rejected_rows"][0]["field"], "longitude");
    let fixes: Vec<Value> =
        spread.iter().map(|d| json!({"longitude_deg": 103.9 + d, "latitude_deg": 30.6 - d})).collect();
    let same = rest.post(path, &json!({"fixes": fixes})).await.expect(200).json();
    let sigma = |response: &Value| response["sigma_m"].as_f64().expect("a number");
    assert!((sigma(&response) - sigma(&same)).abs() < 1e-6 && sigma(&response) > 0.5, "{response} {same}");

    assert_eq!(rest.post(path, &json!({"fixes": []})).await.problem(422, "invalid-argument"), ["fixes"]);
    let bad = json!({"fixes": [{"longitude_deg": 1, "latitude_deg": 91}]});
    assert_eq!(rest.post(path, &bad).await.problem(422, "invalid-argument"), ["fixes"]);
    rest.csv("/v1/cameras/none/gnss-error", "").await.problem(404, "camera-not-found");
    let nmea = rest.send("POST", path, &[("content-type", "text/plain")], "$GPGGA,x\n").await;
    assert_eq!(nmea.problem(422, "invalid-argument"), ["fixes"]);
}

/// Answers requests in turn, each with its head and body if the request has its text, else with 400; the address.
async fn answering(turns: Vec<(&'static str, &'static str, Vec<u8>)>) -> String {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    tokio::spawn(async move {
        for (expected, head, body) in turns {
            let (mut stream, _) = listener.accept().await.expect("a client");
            let mut request = vec![0; 4_096];
            let length = stream.read(&mut request).await.expect("a request");
            let request = String::from_utf8_lossy(&request[..length]).into_owned();
            let head = if request.contains(expected) { head } else { "400 Bad Request" };
            let head = format!("HTTP/1.1 {head}\r\ncontent-length: {}\r\n\r\n", body.len());
            stream.write_all(&[head.as_bytes(), &body].concat()).await.expect("an answer");
        }
    });
    address.to_string()
}

const ASKS_FOR_BASIC: &str = "401 Unauthorized\r\nwww-authenticate: Basic realm=\"Camera 7\"";
const ASKS_FOR_DIGEST: &str =
    "401 Unauthorized\r\nwww-authenticate: Digest realm=\"Camera 7\", nonce=\"dcd98b7102dd2f0e\"";

/// Asks a camera with this snapshot address for a picture.
async fn fetched(snapshot: Value) -> Answer {
    let rest = Rest::with_camera().await;
    let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
    let change = json!({"snapshot": snapshot}).to_string();
    rest.send("PATCH", "/v1/cameras/c", &headers, change).await.expect(200);
    let fetched = rest.send("POST", "/v1/cameras/c/picture", &[], Body::empty()).await;
    let stored = rest.get("/v1/cameras/c/picture").await;
    assert_eq!(stored.body.is_empty(), fetched.status != StatusCode::OK, "what is fetched is stored");
    fetched
}

#[tokio::test]
async fn a_picture_is_fetched_with_a_password_that_nobody_sees() {
    let rest = Rest::with_camera().await;
    let (path, profile) = ("/v1/cameras/c/picture", "/v1/cameras/c");
    let patch = |snapshot: Value| {
        let headers = [("content-type", "application/merge-patch+json"), ("if-match", "*")];
        let (rest, body) = (&rest, json!({"snapshot": snapshot}).to_string());
        async move { rest.send("PATCH", profile, &headers, body).await }
    };
    let fetch = || rest.send("POST", path, &[], Body::empty());
    assert_eq!(fetch().await.problem(422, "invalid-argument"), ["snapshot"]);
    assert_eq!(patch(json!({"url": "rtsp://c/"})).await.problem(422, "invalid-argument"), ["snapshot.url"]);
    assert_eq!(patch(json!({"url": "http://:1/"})).await.problem(422, "invalid-argument"), ["snapshot.url"]);

    let jpeg = [b"\xff\xd8\xff".as_slice(), &[7; 1_000]].concat();
    // viewer:s3cret
    let turns = vec![("GET", ASKS_FOR_BASIC, vec![]), ("Basic dmlld2VyOnMzY3JldA==", "200 OK", jpeg.clone())];
    let url = format!("http://{}/still.jpg?size=full", answering(turns).await);
    patch(json!({"url": url, "username": "viewer", "password": "s3cret"})).await.expect(200);
    // Written back as it was read, the password stays.
    let shown = rest.get(profile).await.expect(200).json()["snapshot"].clone();
    assert_eq!(shown, json!({"url": url, "username": "viewer"}));
    patch(shown).await.expect(200);
    let fetched = fetch().await.expect(200);
    assert_eq!((fetched.header("content-type"), &fetched.body[..]), ("image/jpeg", &jpeg[..]));
    assert_eq!(rest.get(path).await.expect(200).body[..], jpeg[..]);
    fetch().await.problem(429, "rate-limited");
    let audit = rest.get("/v1/audit").await.expect(200).json().to_string();
    assert!(!audit.contains("s3cret"), "{audit}");
}

#[tokio::test]
async fn what_is_no_picture_or_too_large_is_not_taken() {
    let most = crate::config::Limits::default().picture_bytes;
    let too_large = [b"\xff\xd8\xff".as_slice(), &vec![0; most]].concat();
    for (head, file) in [("200 OK", b"<html>".to_vec()), ("200 OK", too_large), (ASKS_FOR_BASIC, vec![])] {
        let url = format!("http://{}/", answering(vec![("GET", head, file)]).await);
        fetched(json!({"url": url})).await.problem(502, "snapshot-unavailable");
    }
}

/// The proofs are MD5(HA1:nonce:HA2) of RFC 2617 without `qop`, by another program.
#[tokio::test]
async fn an_onvif_camera_says_where_its_pictures_are_and_gets_a_digest() {
    let jpeg = b"\xff\xd8\xff still".to_vec();
    let xml = |content: &str| format!("<Envelope><Body>{content}</Body></Envelope>").into_bytes();
    // The camera knows itself by an address that its clients cannot reach.
    let media = xml("<Media><XAddr>http://10.9.8.7:81/onvif/media</XAddr></Media>");
    let profiles = xml("<Profiles token=\"main\"><Name>main</Name></Profiles>");
    let still = xml("<MediaUri><Uri>http://10.9.8.7:81/still.jpg?channel=1</Uri></MediaUri>");
    let turns = vec![
        ("GetCapabilities", ASKS_FOR_DIGEST, vec![]),
        ("response=\"c13a8849539a7a6b8e13c95387076b3f\"", "200 OK", media),
        ("POST /onvif/media ", "200 OK", profiles),
        ("<ProfileToken>main</ProfileToken>", "200 OK", still),
        ("response=\"670f1c01d5d2beee03f2a9d236c465f0\"", "200 OK", jpeg.clone()),
    ];
    let url = format!("onvif://{}", answering(turns).await);
    let snapshot = json!({"url": url, "username": "viewer", "password": "s3cret"});
    assert_eq!(fetched(snapshot).await.expect(200).body[..], jpeg[..]);
}

#[tokio::test]
async fn a_wrong_password_of_a_snapshot_is_refused_and_not_tried_again() {
    let turns = vec![("GET", ASKS_FOR_DIGEST, vec![]), ("Digest", ASKS_FOR_DIGEST, vec![])];
    let url = format!("http://{}/still.jpg", answering(turns).await);
    let snapshot = json!({"url": url, "username": "viewer", "password": "guess"});
    fetched(snapshot).await.problem(502, "snapshot-unavailable");
}

#[tokio::test]
async fn a_picture_is_set_shown_and_removed() {
    let rest = Rest::with_camera().await;
    let path = "/v1/cameras/c/picture";
    assert!(rest.get(path).await.expect(204).body.is_empty());
    let jpeg = [b"\xff\xd8\xff".as_slice(), &[7; 1_000]].concat();
    let put = |media_type: &'static str, content: Vec<u8>| {
        let rest = &rest;
        async move { rest.send("PUT", path, &[("content-type", media_type)], content).await }
    };
    put("image/jpeg", jpeg.clone()).await.expect(204);
    let shown = rest.get(path).await.expect(200);
    assert_eq!((shown.header("content-type"), &shown.body[..]), ("image/jpeg", &jpeg[..]));
    let png = b"\x89PNG\r\n\x1a\n rest".to_vec();
    put("image/png", png.clone()).await.expect(204);
    assert_eq!(rest.get(path).await.expect(200).body[..], png[..]);

    put("image/png", jpeg.clone()).await.problem(400, "malformed-body");
    put("image/webp", jpeg.clone()).await.problem(415, "unsupported-media-type");
    let most = crate::config::Limits::default().picture_bytes;
    put("image/jpeg", [&jpeg[..3], &vec![0; most - 3]].concat()).await.expect(204);
    put("image/jpeg", [&jpeg[..3], &vec![0; most - 2]].concat()).await.problem(413, "too-large");
    rest.send("PUT", "/v1/cameras/none/picture", &[("content-type", "image/jpeg")], jpeg)
        .await
        .problem(404, "camera-not-found");

    assert!(rest.send("DELETE", path, &[], Body::empty()).await.expect(204).body.is_empty());
    rest.get(path).await.expect(204);
    let audit = rest.get("/v1/audit").await.expect(200).json();
    assert_eq!(audit["items"][0]["subject"], "picture removed", "{audit}");
}
