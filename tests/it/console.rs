//! The operator's console and what the interface answers for it.

use std::collections::BTreeSet;

use hyper::body::Bytes;
use serde_json::{Value, json};
use sightfix::domain::Recipe;

use crate::harness::{TestServer, data_folder, sightfix, simulated_csv};

async fn asset(server: &TestServer, path: &str, headers: &[(&str, &str)]) -> crate::harness::Answer {
    server.send("GET", path, headers, Bytes::new()).await
}

/// Paths of the scripts and styles that a page asks for.
fn assets_of(page: &str) -> Vec<String> {
    let paths = page.split('"').filter(|part| part.starts_with("/assets/"));
    paths.map(ToOwned::to_owned).collect()
}

#[test]
fn the_console_describes_each_recipe() {
    let texts = include_str!("../../console/src/lib/texts.ts");
    let keys = texts.lines().filter_map(|line| line.trim_start().strip_prefix("'recipe."));
    let described: BTreeSet<&str> = keys.filter_map(|rest| rest.split('\'').next()).collect();
    assert_eq!(described, Recipe::ALL.iter().map(|recipe| recipe.as_str()).collect());
}

#[tokio::test]
async fn pages_are_revalidated_and_contained() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    for path in ["/", "/walk"] {
        let page = asset(&server, path, &[]).await.expect(200);
        assert_eq!(page.header("content-type"), "text/html; charset=utf-8");
        assert_eq!(page.header("cache-control"), "no-cache");
        let policy = page.header("content-security-policy");
        assert!(policy.contains("default-src 'none'") && !policy.contains("unsafe"), "{policy}");
        assert!(!page.text().contains("<style") && !page.text().contains("onload="), "{}", page.text());
        let tag = page.header("etag").to_owned();
        let known = asset(&server, path, &[("if-none-match", &tag)]).await.expect(304);
        assert!(known.body.is_empty() && known.header("etag") == tag);
        asset(&server, path, &[("if-none-match", "\"other\"")]).await.expect(200);
    }
    server.send("POST", "/", &[], Bytes::new()).await.expect(405);
}

#[tokio::test]
async fn hashed_files_are_kept_for_a_year_and_sent_compressed() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let page = asset(&server, "/", &[]).await.expect(200).text();
    let paths = assets_of(&page);
    assert!(paths.iter().any(|path| path.ends_with(".js")), "{page}");
    for path in paths.iter().filter(|path| path.ends_with(".js")) {
        let whole = asset(&server, path, &[]).await.expect(200);
        assert_eq!(whole.header("cache-control"), "public, max-age=31536000, immutable");
        assert!(!whole.headers.contains_key("content-encoding"));
        // A compressed form of a hundred bytes is not shorter.
        if whole.body.len() < 512 {
            continue;
        }
        let mut tags = vec![whole.header("etag").to_owned()];
        for (accepted, encoding) in [("gzip, deflate", "gzip"), ("gzip, deflate, br", "br")] {
            let short = asset(&server, path, &[("accept-encoding", accepted)]).await.expect(200);
            assert_eq!(
                (short.header("content-encoding"), short.header("vary")),
                (encoding, "accept-encoding")
            );
            assert!(short.body.len() < whole.body.len(), "{path} as {encoding}");
            tags.push(short.header("etag").to_owned());
        }
        tags.dedup();
        assert_eq!(tags.len(), 3, "every encoding has a tag of its own");
        let refused = asset(&server, path, &[("accept-encoding", "br;q=0, gzip;q=0")]).await.expect(200);
        assert!(!refused.headers.contains_key("content-encoding"));
    }
}

#[tokio::test]
async fn a_status_shows_samples_run_model_and_activity() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    let status = async || -> Value {
        let page = server.get("/v1/camera-statuses?limit=1").await.expect(200).json();
        page["items"][0].clone()
    };
    server.post("/v1/cameras", &json!({"id": "a"})).await.expect(201);
    server.post("/v1/cameras", &json!({"id": "b"})).await.expect(201);
    let empty = status().await;
    assert_eq!((&empty["camera"]["id"], &empty["camera"]["samples"]), (&json!("a"), &json!(0)), "{empty}");
    assert!(empty.get("model").is_none() && empty.get("last_observed_at").is_none(), "{empty}");

    let headers = [("content-type", "text/csv")];
    let csv = simulated_csv();
    let rows = csv.lines().count() - 1;
    server.send("POST", "/v1/cameras/a/samples", &headers, csv).await.expect(200);
    let run = server.train("a", &json!({"recipe": "projective", "epochs": 5})).await;
    let mut trained = status().await;
    // The end of a run is stored a moment before its model answers.
    for _ in 0..100 {
        if trained["model"]["view_area"].is_array() {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        trained = status().await;
    }
    assert_eq!(
        (&trained["camera"]["samples"], &trained["latest_run"]["id"]),
        (&json!(rows), &run["id"]),
        "{trained}"
    );
    let corners = trained["model"]["view_area"].as_array().expect("corners");
    assert!(corners.len() >= 3 && trained["model"]["median_r95_m"].as_f64() > Some(0.0), "{trained}");

    let fix = &corners[0];
    #[expect(clippy::disallowed_methods, reason = "the server reads the wall clock, too")]
    let now = jiff::Timestamp::now();
    let observation = json!({"time": now.to_string(), "target_id": "p", "fix": fix});
    server.post("/v1/cameras/a/tracks", &observation).await.expect(200);
    let live = status().await;
    assert_eq!((&live["targets"], &live["streams"]), (&json!(1), &json!(0)), "{live}");
    assert!(live["last_observed_at"].is_string(), "{live}");

    let page = server.get("/v1/camera-statuses?limit=1").await.expect(200).json();
    let cursor = page["next_cursor"].as_str().expect("another page").to_owned();
    let last = server.get(&format!("/v1/camera-statuses?limit=1&cursor={cursor}")).await.expect(200).json();
    assert_eq!(last["items"][0]["camera"]["id"], "b", "{last}");
    assert!(last.get("next_cursor").is_none(), "{last}");
}

#[tokio::test]
async fn tiles_are_shown_only_from_the_set_server() {
    let folder = data_folder();
    let settings = [("SIGHTFIX_CONSOLE__TILE_URL", "https://tiles.example.org/a/{z}/{x}/{y}.png")];
    let server = TestServer::start_with(folder.path(), &settings);
    let policy = asset(&server, "/", &[]).await.expect(200).header("content-security-policy").to_owned();
    assert!(policy.contains("img-src 'self' data: blob: https://tiles.example.org;"), "{policy}");
    let info = server.get("/v1/server").await.expect(200).json();
    assert_eq!(info["tiles"]["url"], settings[0].1, "{info}");
    assert!(info["offered_tiles"].is_null(), "{info}");
    assert_eq!(info["limits"]["page_items"], 1_000, "{info}");

    for url in ["tiles/{z}/{x}/{y}", "https://tiles.example.org/{z}", "https://a;script-src *;/{z}/{x}/{y}"] {
        let output = sightfix().args(["config"]).env("SIGHTFIX_CONSOLE__TILE_URL", url).output();
        let output = output.expect("the binary runs");
        assert!(!output.status.success(), "{url} was taken");
        assert!(String::from_utf8_lossy(&output.stderr).contains("console.tile_url"));
    }
}

#[tokio::test]
async fn tiles_are_offered_unless_the_settings_forbid_it_or_name_others() {
    let none = json!(null);
    for (value, origin, offered) in [
        ("true", " https://tile.openstreetmap.org;", "https://tile.openstreetmap.org/{z}/{x}/{y}.png"),
        ("false", ";", ""),
    ] {
        let folder = data_folder();
        let server =
            TestServer::start_with(folder.path(), &[("SIGHTFIX_CONSOLE__OFFER_OPENSTREETMAP", value)]);
        let policy = asset(&server, "/", &[]).await.expect(200).header("content-security-policy").to_owned();
        assert!(policy.contains(&format!("img-src 'self' data: blob:{origin}")), "{policy}");
        let info = server.get("/v1/server").await.expect(200).json();
        assert_eq!(
            (&info["tiles"], info["offered_tiles"]["url"].as_str().unwrap_or_default()),
            (&none, offered)
        );
    }
}

#[tokio::test]
async fn a_file_of_tiles_is_served_by_ranges_and_the_policy_stays() {
    let folder = data_folder();
    let file = folder.path().join("area.pmtiles");
    let content: Vec<u8> =
        b"PMTiles\x03".iter().copied().chain((0..2_000).map(|at| (at % 251) as u8)).collect();
    std::fs::write(&file, &content).expect("written");
    let setting = file.to_string_lossy().into_owned();
    let settings = [("SIGHTFIX_CONSOLE__TILE_FILE", setting.as_str())];
    let server = TestServer::start_with(&folder.path().join("data"), &settings);
    let policy = asset(&server, "/", &[]).await.expect(200).header("content-security-policy").to_owned();
    assert!(policy.contains("connect-src 'self'; img-src 'self' data: blob:;"), "{policy}");
    let info = server.get("/v1/server").await.expect(200).json();
    assert_eq!(info["tiles"], json!({"url": "/v1/tiles", "format": "pmtiles", "attribution": ""}));

    let whole = asset(&server, "/v1/tiles", &[("accept-encoding", "gzip")]).await.expect(200);
    assert_eq!((whole.body.to_vec(), whole.header("accept-ranges")), (content.clone(), "bytes"));
    let tag = whole.header("etag").to_owned();
    let part =
        asset(&server, "/v1/tiles", &[("range", "bytes=1000-1099"), ("if-range", &tag)]).await.expect(206);
    assert_eq!(
        (part.body.as_ref(), part.header("content-range")),
        (&content[1_000..1_100], "bytes 1000-1099/2008")
    );
    assert_eq!((part.header("etag"), part.header("content-length")), (tag.as_str(), "100"));
    let end = asset(&server, "/v1/tiles", &[("range", "bytes=2000-16383")]).await.expect(206);
    assert_eq!((end.body.as_ref(), end.header("content-range")), (&content[2_000..], "bytes 2000-2007/2008"));
    let other = [("range", "bytes=0-9"), ("if-range", "\"other\"")];
    asset(&server, "/v1/tiles", &other).await.expect(200);
    let beyond = asset(&server, "/v1/tiles", &[("range", "bytes=2008-")]).await.expect(416).json();
    assert_eq!(beyond["violations"][0]["field"], "range", "{beyond}");
}

#[tokio::test]
async fn without_a_file_of_tiles_there_is_none_and_a_wrong_one_is_refused_at_the_start() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.get("/v1/tiles").await.expect(404);
    assert!(server.get("/v1/server").await.expect(200).json().get("tiles").is_none());

    let file = folder.path().join("note.txt");
    std::fs::write(&file, "not tiles").expect("written");
    for path in [file, folder.path().join("missing.pmtiles")] {
        let output = sightfix().arg("config").env("SIGHTFIX_CONSOLE__TILE_FILE", &path).output();
        let output = output.expect("the binary runs");
        assert!(!output.status.success(), "{} was taken", path.display());
        assert!(String::from_utf8_lossy(&output.stderr).contains("console.tile_file"));
    }
}
