//! Holds the committed description of the REST interface to the code.

use std::path::Path;

use crate::harness::{TestServer, data_folder, run};

#[test]
fn the_committed_description_is_the_code_s() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/openapi.json");
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    let current = run(&["openapi"]);
    assert!(
        committed == current,
        "the REST interface has changed; run: cargo run -- openapi > docs/openapi.json"
    );
}

#[tokio::test]
async fn the_server_tells_the_same_description_and_shows_it_offline() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let reported = server.get("/openapi.json").await.expect(200).json();
    let printed: serde_json::Value = serde_json::from_str(&run(&["openapi"])).expect("JSON");
    assert_eq!(reported, printed);
    assert!(
        reported["openapi"].as_str().is_some_and(|version| version.starts_with("3.1")),
        "{}",
        reported["openapi"]
    );

    let page = server.get("/docs/").await.expect(200).text();
    assert!(page.contains("<title>sightfix: REST interface</title>"), "{page}");
    for (at, _) in page.match_indices("src=\"").chain(page.match_indices("href=\"")) {
        let link = page[at..].split('"').nth(1).unwrap_or_default();
        assert!(!link.starts_with("http") && !link.starts_with("//"), "{link} needs the internet");
    }
}

/// The description states the values of a parameter and the form of a body, so that clients can be generated.
#[test]
fn parameters_with_few_values_list_them_and_lines_are_no_object() {
    let description: serde_json::Value = serde_json::from_str(&run(&["openapi"])).expect("JSON");
    let operation = |path: &str, method: &str| description["paths"][path][method].clone();
    let values = |path: &str, method: &str, name: &str| {
        let operation = operation(path, method);
        let parameters = operation["parameters"].as_array().expect("parameters").clone();
        let found = parameters.into_iter().find(|it| it["name"] == name).expect("the parameter");
        let schema = found["schema"].to_string();
        schema.split('"').filter(|text| !text.is_empty()).map(str::to_owned).collect::<Vec<_>>()
    };
    let samples = "/v1/cameras/{camera}/samples";
    let pairings = "/v1/cameras/{camera}/samples/pairings";
    for (path, name, value) in [
        (samples, "durability", "relaxed"),
        (samples, "on_conflict", "replace"),
        (samples, "box_form", "left_top"),
        (samples, "box_unit", "share"),
        (pairings, "method", "interpolate"),
        (pairings, "durability", "synced"),
        ("/v1/cameras/{camera}/tracks", "durability", "relaxed"),
    ] {
        let values = values(path, "post", name);
        assert!(values.iter().any(|it| it == value), "{path} {name}: {values:?}");
    }
    for path in [samples, "/v1/cameras/{camera}/fusions"] {
        let schema = &operation(path, "post")["requestBody"]["content"]["application/x-ndjson"]["schema"];
        assert_eq!(schema["type"], "string", "{path}: lines are no object");
    }
    let events = operation("/v1/cameras/{camera}/events", "get").to_string();
    assert!(events.contains("CameraEventBody"), "all events, not tracks alone: {events}");
    let tags: Vec<&str> =
        description["tags"].as_array().expect("tags").iter().filter_map(|tag| tag["name"].as_str()).collect();
    for (path, item) in description["paths"].as_object().expect("paths") {
        for (method, operation) in item.as_object().expect("operations") {
            for tag in operation["tags"].as_array().into_iter().flatten() {
                assert!(
                    tags.contains(&tag.as_str().unwrap_or_default()),
                    "{method} {path}: {tag} has no description"
                );
            }
        }
    }
}
