use super::*;

const FUSIONS: &str = "/v1/cameras/c/fusions";

fn fix_alone() -> Value {
    json!({"time": "2025-01-01T08:00:00+08:00", "fix": {"longitude_deg": 103.9, "latitude_deg": 30.6}})
}

fn with_box() -> Value {
    json!({
        "time": "2025-01-01T00:00:00Z",
        "target_id": "a",
        "bounding_box": {"left_px": 1, "top_px": 2, "width_px": 30, "height_px": 40},
    })
}

#[tokio::test]
async fn without_a_model_a_fix_passes_or_nothing_is_guessed() {
    let rest = Rest::with_camera().await;
    rest.post(FUSIONS, &with_box()).await.problem(409, "no-model");
    rest.post("/v1/cameras/none/fusions", &with_box()).await.problem(404, "camera-not-found");
}

#[tokio::test]
async fn items_at_fault_are_named_with_their_place() {
    let rest = Rest::with_camera().await;
    let mut second = with_box();
    second["bounding_box"]["left_px"] = json!(5_000);
    let mut third = fix_alone();
    third["fix"]["latitude_deg"] = json!(91);
    let body = json!({"observations": [with_box(), second, third]});
    let fields = rest.post(FUSIONS, &body).await.problem(422, "invalid-argument");
    assert_eq!(fields, ["observations[1].bounding_box.left_px", "observations[2].fix.latitude_deg"]);
    for (body, field) in [
        (json!({"observations": []}), "observations"),
        (json!({"observations": 5}), "observations"),
        (json!({"observations": [with_box()], "time": "2025-01-01T00:00:00Z"}), "time"),
        (json!({"observations": [{"time": 5}]}), "observations[0].time"),
        (json!({"observations": [{"time": "2025-01-01T00:00:00Z", "score": 1}]}), "observations[0].score"),
        (json!({}), "time"),
        (json!({"time": "2025-01-01T00:00:00Z"}), "bounding_box"),
    ] {
        assert_eq!(rest.post(FUSIONS, &body).await.problem(422, "invalid-argument"), [field], "{body}");
    }
    let many = vec![fix_alone(); 1_001];
    let fields = rest.post(FUSIONS, &json!({ "observations": many })).await.problem(413, "too-large");
    assert_eq!(fields, ["observations"]);
    let json = [("content-type", "application/json")];
    for body in ["NaN", "{", "{\"time\":NaN}", "\u{0}"] {
        rest.send("POST", FUSIONS, &json, body).await.problem(400, "malformed-body");
    }
    assert_eq!(rest.send("POST", FUSIONS, &json, "[]").await.problem(422, "invalid-argument"), ["body"]);
    let infinite = r#"{"time":"2025-01-01T00:00:00Z","fix":{"longitude_deg":1e999,"latitude_deg":1}}"#;
    assert_eq!(
        rest.send("POST", FUSIONS, &json, infinite).await.problem(422, "invalid-argument"),
        ["fix.longitude_deg"]
    );
    rest.send("POST", FUSIONS, &json, " ".repeat(2 << 20)).await.problem(413, "too-large");
}
