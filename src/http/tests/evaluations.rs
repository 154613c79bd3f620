use super::*;

const EVALUATIONS: &str = "/v1/evaluations";

/// A camera with 200 samples, a second apart, of a target that walks to and fro; the last 100 state
/// the truth.
async fn taught(limits: Limits) -> Rest {
    let rest = Rest::with(limits).await;
    let profile = json!({"id": "c", "gnss_error": {"sigma_m": 3.5}, "recipe": "hybrid"});
    rest.post("/v1/cameras", &profile).await.expect(201);
    let rows: String = (0..200)
        .map(|n| {
            let step = f64::from(n % 50);
            let (left, east) = (100.0 + 5.0 * step, 103.9 + 1e-5 * step);
            let truth = if n < 100 { ",".to_owned() } else { format!("{east:.7},30.6") };
            format!("2025-01-01T00:{:02}:{:02}Z,a,{left},2,30,40,{east:.7},30.6,{truth}\n", n / 60, n % 60)
        })
        .collect();
    let head = "time,target_id,left,top,width,height,longitude,latitude,truth_longitude,truth_latitude";
    rest.csv("/v1/cameras/c/samples", format!("{head}\n{rows}")).await.expect(200);
    rest
}

/// A good request with some fields changed; null takes one away.
fn changed(fields: Value) -> Value {
    let mut body = json!({
        "camera_id": "c",
        "train": {"until": "2025-01-01T00:02:00Z"},
        "test": {"from": "2025-01-01T00:02:00Z"},
    });
    for (name, value) in fields.as_object().expect("fields") {
        let object = body.as_object_mut().expect("an object");
        if value.is_null() {
            object.remove(name)
        } else {
            object.insert(name.clone(), value.clone())
        };
    }
    body
}

#[tokio::test]
async fn an_evaluation_is_queued_listed_cancelled_and_deleted() {
    let rest = taught(Limits::default()).await;
    let asked = changed(json!({"methods": ["track", "gnss"], "seeds": 2, "gnss_sigma_m": 2.5}));
    let queued = rest.post(EVALUATIONS, &asked).await.expect(202);
    let path = queued.header("location").to_owned();
    let queued = queued.json();
    for (field, value) in [
        ("camera_id", json!("c")),
        ("state", json!("queued")),
        ("train", json!({"until": "2025-01-01T00:02:00Z"})),
        ("test", json!({"from": "2025-01-01T00:02:00Z"})),
        ("methods", json!(["track", "gnss"])),
        ("recipe", json!("hybrid")),
        ("seeds", json!(2)),
        ("box_shift_px", json!(0.0)),
        ("gnss_sigma_m", json!(2.5)),
    ] {
        assert_eq!(queued[field], value, "{field}: {queued}");
    }
    assert_eq!(path, format!("{EVALUATIONS}/{}", queued["id"].as_str().expect("an id")));
    assert_eq!(rest.get(&path).await.expect(200).json(), queued);
    let second = rest.post(EVALUATIONS, &changed(json!({}))).await.expect(202).json();
    // The clock stands still here: ids of one instant are in the order of their random parts.
    let mut newest_first = [queued.clone(), second.clone()];
    newest_first.sort_by(|one, other| other["id"].as_str().cmp(&one["id"].as_str()));

    let page = rest.get("/v1/evaluations?camera=c&limit=1").await.expect(200).json();
    assert_eq!(page["items"], json!([newest_first[0]]), "newest first");
    let cursor = page["next_cursor"].as_str().expect("more").to_owned();
    let page =
        rest.get(&format!("/v1/evaluations?camera=c&limit=1&cursor={cursor}")).await.expect(200).json();
    assert_eq!(page, json!({"items": [newest_first[1]]}), "the last page");
    assert_eq!(rest.get(EVALUATIONS).await.expect(200).json()["items"], json!(newest_first));

    let cancelled = rest.send("POST", &format!("{path}/cancel"), &[], Body::empty()).await.expect(200);
    assert_eq!(cancelled.json()["state"], "cancelled");
    rest.send("POST", &format!("{path}/cancel"), &[], Body::empty()).await.problem(409, "evaluation-ended");
    rest.send("DELETE", &path, &[], Body::empty()).await.expect(204);
    rest.send("DELETE", &path, &[], Body::empty()).await.problem(404, "evaluation-not-found");
    rest.get(&path).await.problem(404, "evaluation-not-found");
    assert_eq!(rest.get(EVALUATIONS).await.expect(200).json()["items"], json!([second]));
}

#[tokio::test]
async fn what_is_left_out_is_filled_in() {
    let rest = taught(Limits::default()).await;
    let plain = rest.post(EVALUATIONS, &json!({"camera_id": "c"})).await.expect(202).json();
    // 200 samples: the last fifth begins with the one at 160 s and ends after that at 199 s.
    assert_eq!(plain["train"], json!({"until": "2025-01-01T00:02:40Z"}));
    assert_eq!(
        plain["test"],
        json!({"from": "2025-01-01T00:02:40Z", "until": "2025-01-01T00:03:19.000001Z"})
    );
    assert_eq!((&plain["seeds"], &plain["gnss_sigma_m"]), (&json!(1), &json!(3.5)));
    let methods = [
        "gnss",
        "imm_ukf",
        "homography.denied",
        "hybrid.one_step",
        "hybrid.two_step",
        "hybrid.denied",
        "track",
        "track.denied",
    ];
    assert_eq!(plain["methods"], json!(methods));
    let half = rest.post(EVALUATIONS, &json!({"camera_id": "c", "test_share": 0.5})).await.expect(202).json();
    assert_eq!(half["test"]["from"], "2025-01-01T00:01:40Z");

    let point = json!({"longitude_deg": 103.9, "latitude_deg": 30.6});
    let standing = rest.post(EVALUATIONS, &changed(json!({"truth_point": point}))).await.expect(202).json();
    assert_eq!(standing["truth_point"], point);
    let line = json!([[103.9, 30.6, 480.0], [103.901, 30.6]]);
    let walking = rest.post(EVALUATIONS, &changed(json!({"truth_line": line}))).await.expect(202).json();
    assert_eq!(walking["truth_line"], json!([[103.9, 30.6], [103.901, 30.6]]));
}

#[tokio::test]
async fn bad_evaluations_name_their_fields() {
    let rest = taught(Limits::default()).await;
    let point = json!({"longitude_deg": 103.9, "latitude_deg": 30.6});
    let until = |until: &str| json!({"until": until});
    for (fields, field) in [
        (json!({"methods": ["gnss", "guess"]}), "methods[1]"),
        (json!({"methods": ["gnss", "track", "gnss"]}), "methods[2]"),
        (json!({"methods": []}), "methods"),
        (json!({"methods": "gnss"}), "methods"),
        (json!({"train": until("2025-01-01T00:02:01Z")}), "test"),
        (json!({"train": {}}), "test"),
        (json!({"train": null}), "train"),
        (json!({"test": null}), "test"),
        (json!({"test_share": 0.5}), "test_share"),
        (json!({"train": null, "test": null, "test_share": 0.95}), "test_share"),
        (json!({"train": until("yesterday")}), "train.until"),
        (json!({"test": {"from": "2025-01-02T00:00:00Z"}}), "test"),
        (json!({"test": {"from": "2025-01-02T00:00:00Z", "until": "2025-01-01T00:00:00Z"}}), "test.until"),
        (json!({"seeds": 0}), "seeds"),
        (json!({"seeds": 21}), "seeds"),
        (json!({"box_shift_px": -1}), "box_shift_px"),
        (json!({"gnss_sigma_m": 0}), "gnss_sigma_m"),
        (json!({"truth_point": {"longitude_deg": 181, "latitude_deg": 0}}), "truth_point.longitude_deg"),
        (json!({"truth_line": [[103.9, 30.6], [103.9, 91]]}), "truth_line[1].latitude_deg"),
        (json!({"truth_line": [[103.9, 30.6], [103.9]]}), "truth_line[1]"),
        (json!({"truth_line": [[103.9, 30.6]]}), "truth_line"),
        (json!({"truth_line": vec![[103.9, 30.6]; 1_001]}), "truth_line"),
        (json!({"truth_point": point, "truth_line": [[103.9, 30.6], [103.91, 30.6]]}), "truth_line"),
        (json!({"camera_id": null}), "camera_id"),
        (json!({"camera": "c"}), "camera"),
        // The first 100 samples do not state the truth.
        (
            json!({
                "train": {"from": "2025-01-01T00:01:40Z"},
                "test": {"until": "2025-01-01T00:01:40Z"},
            }),
            "truth_point",
        ),
    ] {
        let body = changed(fields);
        let named = rest.post(EVALUATIONS, &body).await.problem(422, "invalid-argument");
        assert_eq!(named, [field], "{body}");
    }
    let few = changed(json!({"train": until("2025-01-01T00:00:05Z")}));
    assert_eq!(rest.post(EVALUATIONS, &few).await.problem(422, "unusable-samples"), ["train"]);
    rest.post(EVALUATIONS, &changed(json!({"camera_id": "none"}))).await.problem(404, "camera-not-found");
    rest.post(EVALUATIONS, &changed(json!({"camera_id": "No slug"}))).await.problem(404, "camera-not-found");
    rest.get("/v1/evaluations?camera=none").await.problem(404, "camera-not-found");
    assert_eq!(rest.get("/v1/evaluations?cursor=x").await.problem(422, "invalid-argument"), ["cursor"]);
    rest.get("/v1/evaluations/no-uuid").await.problem(404, "evaluation-not-found");
    assert_eq!(rest.get(EVALUATIONS).await.expect(200).json(), json!({"items": []}), "nothing was queued");
}

#[tokio::test]
async fn evaluations_have_limits() {
    let rest = taught(Limits { live_evaluations: 1, rows_per_evaluation: 199, ..Limits::default() }).await;
    let whole = rest.post(EVALUATIONS, &changed(json!({}))).await;
    assert_eq!(whole.problem(422, "invalid-argument"), ["train"]);
    let fewer = changed(json!({"train": {"from": "2025-01-01T00:00:01Z", "until": "2025-01-01T00:02:00Z"}}));
    rest.post(EVALUATIONS, &fewer).await.expect(202);
    rest.post(EVALUATIONS, &fewer).await.problem(503, "overloaded");
    assert!(rest.get("/metrics").await.expect(200).text().contains("sightfix_evaluations_total"));
}
