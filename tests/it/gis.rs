//! OGC API Features and Moving Features JSON: by requests, and by GDAL's own client.

use std::process::Command;

use serde_json::{Value, json};

use crate::harness::{TestServer, data_folder, simulated_csv};

/// A server whose camera `gate` has samples, the demonstration's model and two tracked targets.
async fn surveyed() -> (TestServer, tempfile::TempDir, usize) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    for id in ["empty", "gate"] {
        server.post("/v1/cameras", &json!({"id": id})).await.expect(201);
    }
    let headers = [("content-type", "text/csv")];
    let report =
        server.send("POST", "/v1/cameras/gate/samples", &headers, simulated_csv()).await.expect(200).json();
    let model = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors"));
    let headers = [("content-type", "application/octet-stream")];
    server.send("POST", "/v1/cameras/gate/models", &headers, model.expect("committed")).await.expect(201);
    let headers = [("content-type", "application/json")];
    server.send("PUT", "/v1/cameras/gate/active-model", &headers, r#"{"number": 1}"#).await.expect(200);
    for second in 0..5 {
        let observations: Vec<Value> = ["a", "b/c"]
            .iter()
            .enumerate()
            .map(|(target, name)| {
                let longitude_deg = 24.7 + target as f64 * 0.01;
                let fix =
                    json!({"longitude_deg": longitude_deg, "latitude_deg": 59.4 + f64::from(second) * 1e-5});
                json!({"time": format!("2026-01-01T00:00:0{second}Z"), "target_id": name, "fix": fix})
            })
            .collect();
        server.post("/v1/cameras/gate/tracks", &json!({"observations": observations})).await.expect(200);
    }
    let accepted = report["accepted"].as_u64().expect("a number") as usize;
    (server, folder, accepted)
}

/// The path of a link of an answer; `None` without it.
fn link(answer: &Value, rel: &str, server: &TestServer) -> Option<String> {
    let links = answer["links"].as_array().expect("links");
    let found = links.iter().find(|link| link["rel"] == rel)?;
    let href = found["href"].as_str().expect("a text");
    Some(href.strip_prefix(&format!("http://{}", server.address)).expect("absolute").to_owned())
}

/// All features of a collection, page by page.
async fn all(server: &TestServer, path: &str) -> Vec<Value> {
    let (mut features, mut next) = (Vec::new(), Some(path.to_owned()));
    while let Some(path) = next {
        let answer = server.get(&path).await.expect(200);
        assert_eq!(answer.header("content-type"), "application/geo+json");
        let page = answer.json();
        let items = page["features"].as_array().expect("features");
        assert_eq!(page["numberReturned"], items.len());
        features.extend(items.iter().cloned());
        next = link(&page, "next", server);
    }
    features
}

#[tokio::test]
async fn the_landing_page_leads_to_every_feature() {
    let (server, _folder, accepted) = surveyed().await;
    let landing = server.get("/ogc").await.expect(200).json();
    let conformance =
        server.get(&link(&landing, "conformance", &server).expect("a link")).await.expect(200).json();
    assert_eq!(conformance["conformsTo"].as_array().map(Vec::len), Some(2));
    server.get(&link(&landing, "service-desc", &server).expect("a link")).await.expect(200);
    let collections = server.get(&link(&landing, "data", &server).expect("a link")).await.expect(200).json();
    let ids: Vec<&str> = collections["collections"]
        .as_array()
        .expect("a list")
        .iter()
        .filter_map(|it| it["id"].as_str())
        .collect();
    assert_eq!(ids, ["cameras", "empty.samples", "empty.tracks", "gate.samples", "gate.tracks"]);
    for collection in collections["collections"].as_array().expect("a list") {
        let own = server.get(&link(collection, "self", &server).expect("a link")).await.expect(200).json();
        assert_eq!(&own, collection);
        let items = all(&server, &link(collection, "items", &server).expect("a link")).await;
        let expected = match own["id"].as_str().expect("an id") {
            "cameras" | "gate.tracks" => 2,
            "gate.samples" => accepted,
            _ => 0,
        };
        assert_eq!(items.len(), expected, "{}", own["id"]);
        for item in items.iter().take(3) {
            let id = item["id"].as_str().expect("an id").replace('/', "%2F");
            let path = format!("/ogc/collections/{}/items/{id}", own["id"].as_str().expect("an id"));
            let mut single = server.get(&path).await.expect(200).json();
            assert!(link(&single, "collection", &server).is_some());
            single.as_object_mut().expect("an object").remove("links");
            assert_eq!(&single, item);
        }
    }
}

#[tokio::test]
async fn box_time_and_limit_select() {
    let (server, _folder, accepted) = surveyed().await;
    let items = "/ogc/collections/gate.samples/items";
    let everything = all(&server, items).await;
    assert_eq!(all(&server, &format!("{items}?limit=37")).await, everything, "pages of another size");
    let west = |feature: &Value| feature["geometry"]["coordinates"][0].as_f64().expect("degrees");
    let mut longitudes: Vec<f64> = everything.iter().map(west).collect();
    longitudes.sort_by(f64::total_cmp);
    // Coordinates are written to the centimetre, so the border is where no sample is near.
    let gap = longitudes.windows(2).skip(accepted / 3).find(|pair| pair[1] - pair[0] > 1e-6).expect("a gap");
    let (west_deg, east_deg) = (longitudes[0] - 0.001, f64::midpoint(gap[0], gap[1]));
    let within = all(&server, &format!("{items}?bbox={west_deg},-90,{east_deg},90&limit=50")).await;
    let expected: Vec<&Value> = everything.iter().filter(|it| west(it) <= east_deg).collect();
    assert!(expected.len() > 50 && expected.len() < accepted, "{}", expected.len());
    assert_eq!(within.iter().collect::<Vec<_>>(), expected);
    assert_eq!(all(&server, &format!("{items}?bbox=0,0,1,1")).await.len(), 0);

    let time = |feature: &Value| feature["properties"]["time"].as_str().expect("a time").to_owned();
    let (early, late) = (time(&everything[10]), time(&everything[20]));
    let instant = all(&server, &format!("{items}?datetime={early}")).await;
    assert!(instant.contains(&everything[10]) && instant.iter().all(|it| time(it) == early));
    let until = all(&server, &format!("{items}?datetime=../{late}")).await;
    let since = all(&server, &format!("{items}?datetime={late}/..")).await;
    let at_late = all(&server, &format!("{items}?datetime={late}")).await;
    assert_eq!(until.len() + since.len(), accepted + at_late.len(), "intervals are closed");

    let tracks = "/ogc/collections/gate.tracks/items";
    assert_eq!(all(&server, &format!("{tracks}?limit=1")).await.len(), 2);
    assert_eq!(all(&server, &format!("{tracks}?bbox=24.705,59,24.72,60")).await.len(), 1);
    let cameras = "/ogc/collections/cameras/items";
    let area = all(&server, cameras).await;
    assert_eq!(area[1]["geometry"]["type"], "Polygon", "{area:?}");
    assert_eq!(
        all(&server, &format!("{cameras}?bbox=0,0,1,1")).await.len(),
        1,
        "one without a geometry is everywhere"
    );

    for query in ["bbox=1,2,3", "datetime=soon", "limit=0", "unknown=1", "cursor=x", "limit=1&limit=2"] {
        let problem = server.get(&format!("{items}?{query}")).await.expect(400).json();
        assert_eq!(problem["type"], "urn:sightfix:problem:invalid-query", "{query}");
    }
    assert!(server.get(&format!("{items}?limit=1000000")).await.expect(200).json()["features"].is_array());
    for path in ["none.samples", "gate.models", "gate"] {
        server.get(&format!("/ogc/collections/{path}/items")).await.expect(404);
    }
    server.get("/ogc/collections/gate.samples/items/none").await.expect(404);
}

#[tokio::test]
async fn histories_are_moving_features() {
    let (server, _folder, _) = surveyed().await;
    let one = server.get("/v1/cameras/gate/tracks/a?form=moving_features").await.expect(200).json();
    let plain = server.get("/v1/cameras/gate/tracks/a").await.expect(200).json();
    let feature = &one["features"][0];
    let moving = &feature["temporalGeometry"];
    assert_eq!((&moving["type"], &moving["interpolation"]), (&json!("MovingPoint"), &json!("Linear")));
    let positions: Vec<&Value> = plain["features"].as_array().expect("positions").iter().collect();
    assert!(positions.len() > 2);
    let of_plain = |pointer: &str| -> Vec<Value> {
        positions.iter().map(|it| it.pointer(pointer).expect("set").clone()).collect()
    };
    assert_eq!(moving["coordinates"], json!(of_plain("/geometry/coordinates")));
    assert_eq!(moving["datetimes"], json!(of_plain("/properties/time")));
    assert_eq!(feature["temporalProperties"][0]["r95_m"]["values"], json!(of_plain("/properties/r95_m")));
    assert_eq!(feature["geometry"]["type"], "LineString");
    let every = server.get("/v1/cameras/gate/tracks?form=moving_features").await.expect(200).json();
    assert_eq!(every["features"].as_array().map(Vec::len), Some(2));
    server.get("/v1/cameras/gate/tracks?form=kml").await.expect(422);
}

/// GDAL's client of the standard. Ignored by default, since it needs `ogr2ogr` (Debian: gdal-bin).
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs gdal-bin"]
async fn gdal_reads_every_feature() {
    let (server, folder, accepted) = surveyed().await;
    let url = format!("OAPIF:http://{}/ogc", server.address);
    let gdal = |program: &str, arguments: &[&str]| {
        let output = Command::new(program).args(arguments).output().expect("gdal-bin is installed");
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{program} {arguments:?}: {errors}");
        String::from_utf8(output.stdout).expect("UTF-8")
    };
    let layers = gdal("ogrinfo", &["-q", &url]);
    for layer in ["cameras", "gate.samples", "gate.tracks"] {
        assert!(layers.contains(layer), "{layers}");
    }
    let summary = gdal("ogrinfo", &["-so", &url, "gate.samples"]);
    assert!(summary.contains(&format!("Feature Count: {accepted}")), "{summary}");
    for (layer, expected) in [("gate.samples", accepted), ("gate.tracks", 2), ("cameras", 2)] {
        let file = folder.path().join(format!("{layer}.gpkg"));
        let file = file.to_str().expect("UTF-8");
        gdal("ogr2ogr", &["-f", "GPKG", file, &url, layer]);
        let written = gdal("ogrinfo", &["-so", "-al", file]);
        assert!(written.contains(&format!("Feature Count: {expected}")), "{written}");
        println!("{layer}: {expected} features read by GDAL");
    }
    let few = gdal("ogrinfo", &["-so", &url, "gate.tracks", "-spat", "24.705", "59", "24.72", "60"]);
    assert!(few.contains("Feature Count: 1"), "{few}");
    let history = server.get("/v1/cameras/gate/tracks/a?form=moving_features").await.expect(200);
    let file = folder.path().join("moving.geojson");
    std::fs::write(&file, history.text()).expect("written");
    let read = gdal("ogrinfo", &["-al", file.to_str().expect("UTF-8")]);
    assert!(read.contains("LINESTRING"), "{read}");
}
