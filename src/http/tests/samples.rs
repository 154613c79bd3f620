use super::*;

const HEADER: &str = "time,target_id,left,top,width,height,longitude,latitude\n";
const SAMPLES: &str = "/v1/cameras/c/samples";

fn rows(count: u32) -> String {
    let row = |n: u32| {
        format!("2025-01-01T{:02}:{:02}:{:02}Z,a,1,2,30,40,103.9,30.6\n", n / 3600, n / 60 % 60, n % 60)
    };
    std::iter::once(HEADER.to_owned()).chain((0..count).map(row)).collect()
}

#[tokio::test]
async fn every_format_is_imported_and_exported() {
    let rest = Rest::with_camera().await;
    let imported = rest.csv(SAMPLES, rows(2_500)).await.expect(200).json();
    assert_eq!(
        imported,
        json!({
            "accepted": 2500, "accepted_without_fix": 0, "duplicate": 0, "replaced": 0, "rejected": 0, "rejected_rows": [],
            "durability": "synced", "warnings": [],
        })
    );
    for (media_type, lines) in [("text/csv", 2_501), ("application/x-ndjson", 2_500)] {
        let export = rest.send("GET", SAMPLES, &[("accept", media_type)], Body::empty()).await.expect(200);
        assert_eq!(export.header("content-type"), media_type);
        assert_eq!(export.text().lines().count(), lines);
        let again = rest.send("POST", SAMPLES, &[("content-type", media_type)], export.body).await;
        let again = again.expect(200).json();
        assert_eq!((&again["accepted"], &again["duplicate"]), (&json!(0), &json!(2_500)), "{media_type}");
    }
    let map =
        rest.send("GET", SAMPLES, &[("accept", "application/geo+json")], Body::empty()).await.expect(200);
    let map: geojson::FeatureCollection =
        map.text().parse::<geojson::GeoJson>().expect("GeoJSON").try_into().expect("a collection");
    assert_eq!(map.features.len(), 2_500);

    let page = rest.get(&format!("{SAMPLES}?limit=7&from=2025-01-01T00:00:10Z")).await.expect(200).json();
    let items = page["items"].as_array().expect("items");
    assert_eq!((items.len(), &items[0]["time"]), (7, &json!("2025-01-01T00:00:10Z")));
    let again = rest.post(SAMPLES, &page["items"]).await.expect(200).json();
    assert_eq!((&again["accepted"], &again["duplicate"]), (&json!(0), &json!(7)));
    let cursor = page["next_cursor"].as_str().expect("more");
    let next = rest.get(&format!("{SAMPLES}?limit=7&cursor={cursor}")).await.expect(200).json();
    assert_eq!(next["items"][0]["time"], "2025-01-01T00:00:17Z");
}

#[tokio::test]
async fn samples_are_counted_and_deleted_by_time() {
    let rest = Rest::with_camera().await;
    rest.csv(SAMPLES, rows(100)).await.expect(200);
    let early = "from=2025-01-01T00:00:00Z&until=2025-01-01T08:00:10%2B08:00";
    let count = rest.get(&format!("{SAMPLES}/count?{early}")).await.expect(200).json();
    assert_eq!(count, json!({"count": 10, "without_fix": 0}));
    let unescaped = early.replace("%2B", "+");
    let deleted = rest.send("DELETE", &format!("{SAMPLES}?{unescaped}"), &[], Body::empty()).await;
    assert_eq!(deleted.expect(200).json(), json!({"deleted": 10}));
    assert_eq!(
        rest.get(&format!("{SAMPLES}/count")).await.expect(200).json(),
        json!({"count": 90, "without_fix": 0})
    );
    for (query, field) in [
        ("", "from"),
        ("from=yesterday", "from"),
        ("from=2025-01-01T00:00:00", "from"),
        ("from=2025-01-02T00:00:00Z&until=2025-01-01T00:00:00Z", "until"),
        ("target_id=", "target_id"),
        ("to=2025-01-01T00:00:00Z", "to"),
    ] {
        let answer = rest.send("DELETE", &format!("{SAMPLES}?{query}"), &[], Body::empty()).await;
        assert_eq!(answer.problem(422, "invalid-argument"), [field], "{query}");
    }
    assert_eq!(
        rest.get(&format!("{SAMPLES}/count")).await.expect(200).json(),
        json!({"count": 90, "without_fix": 0})
    );
}

#[tokio::test]
async fn rejected_rows_are_told_up_to_a_hundred() {
    let rest = Rest::with_camera().await;
    let bad = "2025-01-01T00:00:00Z,a,1,2,30,40,103.9,91\n".repeat(150);
    let response = rest.csv(SAMPLES, format!("{}{bad}", rows(3))).await.expect(200).json();
    assert_eq!((&response["accepted"], &response["rejected"]), (&json!(3), &json!(150)));
    let rows = response["rejected_rows"].as_array().expect("rows");
    assert_eq!((rows.len(), &rows[0]["line"], &rows[0]["field"]), (100, &json!(5), &json!("latitude")));
}

#[tokio::test]
async fn imports_that_cannot_be_read_are_refused() {
    let rest = Rest::with_camera().await;
    assert_eq!(rest.csv(SAMPLES, "time,lat\n").await.problem(400, "malformed-body"), ["lat"]);
    rest.csv(SAMPLES, "").await.problem(400, "malformed-body");
    rest.post(SAMPLES, &json!({"rows": []})).await.problem(400, "malformed-body");
    rest.csv("/v1/cameras/none/samples", rows(1)).await.problem(404, "camera-not-found");
    for media_type in ["application/geo+json", "text/plain", "application/x-www-form-urlencoded"] {
        let answer = rest.send("POST", SAMPLES, &[("content-type", media_type)], rows(1)).await;
        answer.problem(415, "unsupported-media-type");
    }
    let accept = rest.send("GET", SAMPLES, &[("accept", "image/png")], Body::empty()).await;
    assert_eq!(accept.problem(406, "not-acceptable"), ["accept"]);
    let limit =
        rest.send("GET", &format!("{SAMPLES}?limit=5"), &[("accept", "text/csv")], Body::empty()).await;
    assert_eq!(limit.problem(422, "invalid-argument"), ["limit"]);
}

#[tokio::test]
async fn long_imports_go_through_a_file_and_too_long_ones_nowhere() {
    let limits = Limits { import_memory_bytes: 1_000, import_bytes: 100_000, ..Limits::default() };
    let rest = Rest::with(limits).await;
    rest.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    let parts = |csv: String| {
        let parts: Vec<Result<Bytes, std::io::Error>> =
            csv.into_bytes().chunks(777).map(|part| Ok(Bytes::copy_from_slice(part))).collect();
        Body::from_stream(futures_util::stream::iter(parts))
    };
    let response = rest.csv(SAMPLES, parts(rows(1_000))).await.expect(200).json();
    assert_eq!(response["accepted"], 1_000);
    rest.csv(SAMPLES, parts(rows(5_000))).await.problem(413, "too-large");
    rest.csv(SAMPLES, rows(5_000)).await.problem(413, "too-large");
    assert_eq!(
        rest.get(&format!("{SAMPLES}/count")).await.expect(200).json(),
        json!({"count": 1_000, "without_fix": 0})
    );
}
