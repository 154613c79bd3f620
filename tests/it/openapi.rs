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
    let told = server.get("/openapi.json").await.expect(200).json();
    let printed: serde_json::Value = serde_json::from_str(&run(&["openapi"])).expect("JSON");
    assert_eq!(told, printed);
    assert!(
        told["openapi"].as_str().is_some_and(|version| version.starts_with("3.1")),
        "{}",
        told["openapi"]
    );

    let page = server.get("/docs/").await.expect(200).text();
    for (at, _) in page.match_indices("src=\"").chain(page.match_indices("href=\"")) {
        let link = page[at..].split('"').nth(1).unwrap_or_default();
        assert!(!link.starts_with("http") && !link.starts_with("//"), "{link} needs the internet");
    }
}
