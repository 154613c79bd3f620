use http_body_util::BodyExt as _;

use super::*;

const RUNS: &str = "/v1/cameras/c/training-runs";

/// A camera with samples of a target that walks to and fro.
async fn taught() -> Rest {
    let rest = Rest::with_camera().await;
    teach(&rest).await;
    rest
}

async fn teach(rest: &Rest) {
    let rows: String = (0..200)
        .map(|n| {
            let step = f64::from(n % 50);
            let (left, east) = (100.0 + 5.0 * step, 103.9 + 1e-5 * step);
            format!("2025-01-01T00:{:02}:{:02}Z,a,{left},2,30,40,{east:.7},30.6\n", n / 60, n % 60)
        })
        .collect();
    let csv = format!("time,target_id,left,top,width,height,longitude,latitude\n{rows}");
    rest.csv("/v1/cameras/c/samples", csv).await.expect(200);
}

#[tokio::test]
async fn a_run_is_queued_listed_and_cancelled() {
    let rest = taught().await;
    let run = rest.post(RUNS, &json!({"recipe": "paper", "seed": 3, "epochs": 5})).await.expect(202);
    let path = run.header("location").to_owned();
    let run = run.json();
    assert_eq!((&run["state"], &run["recipe"], &run["seed"]), (&json!("queued"), &json!("paper"), &json!(3)));
    assert_eq!(rest.get(&path).await.expect(200).json(), run);
    assert_eq!(rest.get(RUNS).await.expect(200).json()["items"], json!([run]));
    rest.send("POST", RUNS, &[], Body::empty()).await.problem(409, "run-live");
    let live = rest.send("DELETE", "/v1/cameras/c", &[], Body::empty()).await;
    live.problem(409, "run-live");
    assert_eq!(rest.get(&format!("{path}/curve")).await.expect(200).json(), json!({"items": []}));
    rest.get(&format!("{path}/log")).await.expect(200);

    let cancelled = rest.send("POST", &format!("{path}/cancel"), &[], Body::empty()).await.expect(200);
    assert_eq!(cancelled.json()["state"], "cancelled");
    rest.send("POST", &format!("{path}/cancel"), &[], Body::empty()).await.problem(409, "run-ended");
    let events = rest.get(&format!("{path}/events")).await.expect(200);
    assert_eq!(events.header("content-type"), "text/event-stream");
    assert!(
        events.text().contains("id: ended") && events.text().contains("\"cancelled\""),
        "{}",
        events.text()
    );
    let seen = [("last-event-id", "ended")];
    rest.send("GET", &format!("{path}/events"), &seen, Body::empty()).await.expect(204);
}

#[tokio::test]
async fn watching_has_few_places_and_ends_with_the_server() {
    let rest = Rest::with(Limits { event_streams: 1, ..Limits::default() }).await;
    rest.post("/v1/cameras", &json!({"id": "c"})).await.expect(201);
    teach(&rest).await;
    let run = rest.send("POST", RUNS, &[], Body::empty()).await.expect(202);
    let events = format!("{}/events", run.header("location"));

    let mut first = rest.open("GET", &events, &[], Body::empty()).await;
    let event = first.body_mut().frame().await.expect("an event").expect("whole").into_data().expect("text");
    assert!(String::from_utf8_lossy(&event).contains("\"queued\""), "{event:?}");
    let second = rest.get(&events).await;
    assert_eq!(second.header("retry-after"), "1");
    second.problem(503, "overloaded");

    rest.shutdown.drain();
    assert!(first.body_mut().frame().await.is_none(), "the stream ends with the server");
    drop(first);
    rest.get(&events).await.expect(200);
}

#[tokio::test]
async fn bad_runs_name_their_fields() {
    let rest = taught().await;
    for (body, field) in [
        (json!({"epochs": 0}), "epochs"),
        (json!({"epochs": "many"}), "epochs"),
        (json!({"seed": -1}), "seed"),
        (json!({"recipe": "best"}), "recipe"),
        (json!({"from": "yesterday"}), "from"),
        (json!({"until": "2025-01-01T00:00:00"}), "until"),
        (json!({"speed": 1}), "speed"),
    ] {
        assert_eq!(rest.post(RUNS, &body).await.problem(422, "invalid-argument"), [field], "{body}");
    }
    rest.get(&format!("{RUNS}/no-uuid")).await.problem(404, "run-not-found");
    let none = "018f0000-0000-7000-8000-000000000000";
    rest.get(&format!("{RUNS}/{none}")).await.problem(404, "run-not-found");
    rest.get(&format!("{RUNS}/{none}/events")).await.problem(404, "run-not-found");
    rest.get("/v1/cameras/none/training-runs").await.problem(404, "camera-not-found");
}

#[tokio::test]
async fn missing_models_are_reported() {
    let rest = Rest::with_camera().await;
    let models = "/v1/cameras/c/models";
    assert_eq!(rest.get(models).await.expect(200).json(), json!({"items": []}));
    for path in ["1", "0", "x", "1/file"] {
        rest.get(&format!("{models}/{path}")).await.problem(404, "model-not-found");
    }
    rest.get("/v1/cameras/c/active-model").await.problem(409, "no-model");
    let json = [("content-type", "application/json")];
    let activate = rest.send("PUT", "/v1/cameras/c/active-model", &json, "{\"number\":1}").await;
    activate.problem(404, "model-not-found");
    let back = rest.send("POST", "/v1/cameras/c/active-model/roll-back", &[], Body::empty()).await;
    back.problem(409, "no-model");
    rest.send("POST", models, &json, "{}").await.problem(415, "unsupported-media-type");
}
