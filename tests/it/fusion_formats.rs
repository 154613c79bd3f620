//! Observations and positions as JSON, CSV, NDJSON and GeoJSON, in and out of `/fusions`.

use serde_json::{Value, json};

use crate::harness::{Answer, TestServer, data_folder};

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");
const FUSIONS: &str = "/v1/cameras/c/fusions";
const CSV: &str = "text/csv";
const NDJSON: &str = "application/x-ndjson";
const JSON: &str = "application/json";
const GEOJSON: &str = "application/geo+json";

async fn with_model() -> (tempfile::TempDir, TestServer) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let model = std::fs::read(MODEL).expect("the model");
    let headers = [("content-type", "application/vnd.safetensors")];
    server.send("POST", "/v1/cameras/c/models", &headers, model).await.expect(201);
    let body = json!({"number": 1}).to_string();
    let headers = [("content-type", "application/json")];
    server.send("PUT", "/v1/cameras/c/active-model", &headers, body).await.expect(200);
    (folder, server)
}

async fn fuse(server: &TestServer, from: &str, to: &str, body: impl Into<String>) -> Answer {
    let headers = [("content-type", from), ("accept", to)];
    server.send("POST", FUSIONS, &headers, body.into()).await
}

const ROWS: &str = "time,target_id,left,top,width,height,longitude,latitude,sigma_m\n\
                    2020-12-14T06:41:48Z,a,475,111,28,77,,,\n\
                    2020-12-14T06:41:49Z,b,,,,,103.98678,30.6280135,2.5\n";

fn observations() -> Value {
    json!([
        {
            "time": "2020-12-14T06:41:48Z", "target_id": "a",
            "bounding_box": {"left_px": 475.0, "top_px": 111.0, "width_px": 28.0, "height_px": 77.0},
        },
        {
            "time": "2020-12-14T06:41:49Z", "target_id": "b",
            "fix": {"longitude_deg": 103.98678, "latitude_deg": 30.6280135, "sigma_m": 2.5},
        },
    ])
}

fn features() -> Value {
    let observations = observations();
    json!({
        "type": "FeatureCollection",
        "name": "a member that the format does not know",
        "features": [
            {"type": "Feature", "geometry": null, "properties": observations[0]},
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": [103.98678, 30.6280135, 512.0]},
                "properties": {"time": "2020-12-14T06:41:49Z", "target_id": "b", "sigma_m": 2.5},
            },
        ],
    })
}

#[tokio::test]
async fn the_same_observations_give_the_same_positions_in_every_format() {
    let (_folder, server) = with_model().await;
    let expected = fuse(&server, JSON, JSON, json!({"observations": observations()}).to_string()).await;
    let expected = expected.expect(200).json();
    assert_eq!(expected["items"].as_array().map(Vec::len), Some(2));
    let lines: Vec<String> = observations().as_array().into_iter().flatten().map(Value::to_string).collect();
    for (from, body) in
        [(CSV, ROWS.to_owned()), (NDJSON, lines.join("\n")), (GEOJSON, features().to_string())]
    {
        let fused = fuse(&server, from, JSON, body.clone()).await.expect(200).json();
        assert_eq!(fused, expected, "{from}");
        let ndjson = fuse(&server, from, NDJSON, body.clone()).await.expect(200);
        assert_eq!((ndjson.header("content-type"), ndjson.header("vary")), (NDJSON, "accept"));
        let items: Vec<Value> =
            ndjson.text().lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
        assert_eq!(json!(items), expected["items"], "{from}");
        let csv = fuse(&server, from, CSV, body.clone()).await.expect(200).text();
        assert_eq!(csv.lines().count(), 3, "{csv}");
        assert!(csv.starts_with("time,target_id,longitude,latitude,r95_m"), "{csv}");
        let map = fuse(&server, from, GEOJSON, body).await.expect(200).json();
        for (feature, item) in map["features"].as_array().into_iter().flatten().zip(items) {
            let fused = &item["fused"];
            assert_eq!(
                feature["geometry"]["coordinates"],
                json!([fused["longitude_deg"], fused["latitude_deg"]])
            );
            assert_eq!(feature["properties"], item);
        }
    }
}

#[tokio::test]
async fn a_fault_of_one_row_refuses_them_all_and_names_it() {
    let (_folder, server) = with_model().await;
    let csv = ROWS.replace("103.98678", "203.98678").replace("475", "wide");
    let problem = fuse(&server, CSV, JSON, csv).await.expect(422).json();
    let fields: Vec<&str> = problem["violations"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|it| it["field"].as_str())
        .collect();
    assert_eq!(fields, ["line 2: left", "line 3: longitude"], "{problem}");
    let mut map = features();
    map["features"][1]["geometry"]["type"] = json!("LineString");
    let problem = fuse(&server, GEOJSON, JSON, map.to_string()).await.expect(422).json();
    assert_eq!(problem["violations"][0]["field"], "features[1].geometry", "{problem}");
    for (from, body, status) in [
        (CSV, "time,colour\n".to_owned(), 400),
        (CSV, "time,left,top,width,height\n".to_owned(), 422),
        (NDJSON, "{".to_owned(), 422),
        (GEOJSON, json!({"type": "Feature"}).to_string(), 422),
        (GEOJSON, json!({"type": "FeatureCollection", "features": []}).to_string(), 422),
        (GEOJSON, "{".to_owned(), 400),
        ("text/plain", ROWS.to_owned(), 415),
    ] {
        fuse(&server, from, JSON, body).await.expect(status);
    }
    let refused = fuse(&server, CSV, "image/png", ROWS).await.expect(406).json();
    assert_eq!(refused["violations"][0]["field"], "accept");
    let many = format!("time,longitude,latitude\n{}", "2020-12-14T06:41:48Z,103,30\n".repeat(1_001));
    fuse(&server, CSV, CSV, many).await.expect(413);
}
