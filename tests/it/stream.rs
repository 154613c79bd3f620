//! The live stream from the outside: its rules, its acknowledgements, its limits.

use std::time::{Duration, Instant};

use futures_util::{StreamExt as _, stream};
use serde_json::{Value, json};
use sightfix::geo::{Position, distance_m};
use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use sightfix::grpc::proto::stream_answer::Outcome;
use sightfix::simulation::{Options, SimulatedRow};
use tokio::sync::mpsc;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::harness::{TestServer, data_folder};
use crate::live_client::{
    Client, Received, Sent, add_model, begin, boxed, channel, fixed, messages, open, opening, rows, whole,
    yard,
};

#[tokio::test]
async fn boxes_and_fixes_apart_become_tracks_that_everyone_can_read() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let mut client = open(&channel(&server).await, "edge-1", false).await;
    let rows = rows(&Options { seed: 31, samples: 400, ..Options::demo() });
    let (mut track_m, mut gnss_m, mut count) = (0.0, 0.0, 0.0);
    for row in &rows {
        let seq = client.item(boxed(row)).await;
        let answer = client.answer().await;
        assert_eq!(answer.seq, seq);
        let Some(Outcome::Fused(fused)) = answer.outcome else { panic!("{answer:?}") };
        assert!(
            fused.regressed.is_some() && fused.gnss.is_none() && fused.model_version == Some(1),
            "{fused:?}"
        );
        let seq = client.item(fixed(row)).await;
        let answer = client.answer().await;
        assert_eq!(answer.seq, seq);
        let track = answer.track.expect("the target is followed");
        let position = track.position.expect("set");
        let position = Position::new(position.longitude_deg(), position.latitude_deg()).expect("valid");
        track_m += distance_m(position, row.truth);
        gnss_m += distance_m(row.fix.expect("no gaps").position, row.truth);
        count += 1.0;
    }
    assert!(track_m < 0.7 * gnss_m, "track {} m, GNSS {} m", track_m / count, gnss_m / count);

    let tracks = server.get("/v1/cameras/yard/tracks").await.expect(200);
    assert_eq!(tracks.header("content-type"), "application/geo+json");
    let tracks = tracks.json();
    let feature = &tracks["features"][0];
    assert_eq!(
        (&tracks["type"], &feature["geometry"]["type"]),
        (&json!("FeatureCollection"), &json!("Point"))
    );
    let target = feature["properties"]["target_id"].as_str().expect("a name").to_owned();
    let history = server.get(&format!("/v1/cameras/yard/tracks/{target}")).await.expect(200).json();
    let times: Vec<&str> = history["features"]
        .as_array()
        .expect("features")
        .iter()
        .map(|feature| feature["properties"]["time"].as_str().expect("a time"))
        .collect();
    assert!(times.len() > 20 && times.is_sorted(), "{}", times.len());
    server.get("/v1/cameras/yard/tracks/nobody").await.expect(404);
    let metrics = server.get("/metrics").await.expect(200).text();
    assert!(metrics.contains("sightfix_track_nis_count"), "{metrics}");
    assert!(metrics.contains("sightfix_live_streams 1"), "{metrics}");

    let (acknowledged, _, ended) = client.finish().await;
    assert!(acknowledged.is_none() && ended.is_none(), "{acknowledged:?} {ended:?}");
}

#[tokio::test]
async fn rest_clients_follow_targets_and_watch_them() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let mut events = server.open("GET", "/v1/cameras/yard/events", &[], "").await.into_body();
    let rows = rows(&Options { seed: 32, samples: 20, ..Options::demo() });
    let sides = |row: &SimulatedRow| {
        let [left_px, top_px, width_px, height_px] = row.bounding_box.expect("a box").sides_px();
        json!({"left_px": left_px, "top_px": top_px, "width_px": width_px, "height_px": height_px})
    };
    let observations: Vec<Value> = rows
        .iter()
        .map(|row| json!({"time": row.time, "target_id": row.target_id.as_str(), "bounding_box": sides(row)}))
        .collect();
    let body = json!({ "observations": observations });
    let followed = server.post("/v1/cameras/yard/tracks", &body).await.expect(200).json();
    let items = followed["items"].as_array().expect("items");
    assert_eq!(items.len(), rows.len());
    let r95_m = |item: &Value| item["track"]["properties"]["r95_m"].as_f64().expect("a radius");
    assert!(
        items.iter().all(|item| r95_m(item) > 0.0 && item["fused"]["flags"][0] == "gnss_denied"),
        "{items:?}"
    );
    let mut seen = String::new();
    while seen.matches("event: track").count() < rows.len() {
        let frame = http_body_util::BodyExt::frame(&mut events).await.expect("more").expect("no break");
        seen.push_str(std::str::from_utf8(&frame.into_data().unwrap_or_default()).expect("UTF-8"));
    }
    let problem = server
        .post(
            "/v1/cameras/yard/tracks",
            &json!({"observations": [{"time": "now", "fix": {"longitude_deg": 1.0, "latitude_deg": 2.0}}]}),
        )
        .await;
    assert_eq!(problem.expect(422).json()["violations"][0]["field"], "observations[0].time");
}

#[tokio::test]
async fn what_two_devices_bring_is_paired_and_stored_exactly_once() {
    let folder = data_folder();
    let profile = json!({"receivers": [
        {"receiver_id": "phone-1", "target_id": "walker-1", "clock_offset_s": -18.0},
    ]});
    let server = yard(folder.path(), &[], profile, false).await;
    let channel = channel(&server).await;
    let rows = rows(&Options { seed: 33, samples: 600, targets: 1, ..Options::demo() });
    let count = async || {
        let samples = server.get("/v1/cameras/yard/samples/count").await.expect(200).json();
        samples["count"].as_u64().expect("a number")
    };
    for round in 1..=2 {
        let mut detector = open(&channel, "detector", true).await;
        let mut receiver = open(&channel, "receiver", true).await;
        for row in &rows {
            let name = Some("walker-1".to_owned());
            detector.item(proto::StreamItem { target_id: name, ..boxed(row) }).await;
            let mut fix = fixed(row);
            if let Some(time) = &mut fix.time {
                time.seconds += 18; // the receiver's clock counts no leap seconds
            }
            receiver
                .item(proto::StreamItem { target_id: None, receiver_id: Some("phone-1".to_owned()), ..fix })
                .await;
            let answer = detector.answer().await;
            let flags: Vec<_> = answer.flags().collect();
            assert!(answer.outcome.is_none() && flags == [proto::Flag::NoModel], "{answer:?}");
            receiver.answer().await;
        }
        let sent = rows.len() as u64;
        let (detected, received) = tokio::join!(detector.finish(), receiver.finish());
        for (acknowledged, _, ended) in [detected, received] {
            assert!(ended.is_none(), "{ended:?}");
            assert_eq!(acknowledged, Some(sent), "round {round}");
        }
        assert_eq!(count().await, sent, "round {round}");
    }
}

#[tokio::test]
async fn a_bad_first_message_ends_the_stream_with_its_reason() {
    let folder = data_folder();
    let server = yard(folder.path(), &[("SIGHTFIX_LIMITS__HEADER_S", "1")], json!({}), false).await;
    let channel = channel(&server).await;
    let refused = async |first: Sent| {
        let mut client = begin(&channel, first).await;
        client.next().await.expect_err("refused")
    };
    let named = |status: &Status| {
        let details = status.get_error_details();
        let violations = details.bad_request().map_or(&[][..], |bad| &bad.field_violations);
        violations.first().map(|violation| violation.field.clone()).unwrap_or_default()
    };
    let status = refused(Sent::Item(proto::StreamItem::default())).await;
    assert_eq!((status.code(), named(&status).as_str()), (Code::InvalidArgument, "opening"), "{status:?}");
    let status = refused(opening("", true)).await;
    assert_eq!(
        (status.code(), named(&status).as_str()),
        (Code::InvalidArgument, "client_name"),
        "{status:?}"
    );
    let elsewhere = proto::StreamOpening {
        camera_id: "nowhere".to_owned(),
        client_name: "a".to_owned(),
        ..Default::default()
    };
    assert_eq!(refused(Sent::Opening(elsewhere)).await.code(), Code::NotFound);
    // Nothing at all.
    let (_items, requests) = mpsc::channel::<proto::StreamRequest>(1);
    let responses = FusionServiceClient::new(channel.clone()).stream(messages(requests)).await;
    let status = responses.expect("opened").into_inner().message().await.expect_err("too late");
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
}

#[tokio::test]
async fn a_bad_item_is_answered_and_never_ends_the_stream() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let mut client = open(&channel(&server).await, "edge-1", true).await;
    let row = &rows(&Options { samples: 1, ..Options::demo() })[0];
    let narrow = |item: proto::StreamItem| {
        let sides = item.bounding_box.expect("a box");
        proto::StreamItem { bounding_box: Some(proto::BoundingBox { width_px: Some(0.0), ..sides }), ..item }
    };
    for (bad, field) in [
        (proto::StreamItem { time: None, ..whole(row) }, "time"),
        (proto::StreamItem { bounding_box: None, fix: None, ..whole(row) }, "bounding_box"),
        (narrow(whole(row)), "bounding_box.width_px"),
        (proto::StreamItem { score: Some(2.0), ..whole(row) }, "score"),
        (proto::StreamItem { target_id: Some(String::new()), ..whole(row) }, "target_id"),
    ] {
        let seq = client.item(bad).await;
        let answer = client.answer().await;
        let Some(Outcome::Error(error)) = answer.outcome else { panic!("{field}: {answer:?}") };
        assert_eq!((answer.seq, error.field.as_str()), (seq, field), "{error:?}");
        assert_eq!(error.reason, "invalid-argument");
    }
    // A seq that does not rise, a second opening, an empty message.
    client.send(Sent::Item(proto::StreamItem { seq: 2, ..whole(row) })).await;
    let Some(Outcome::Error(error)) = client.answer().await.outcome else { panic!("seq") };
    assert_eq!(error.field, "seq");
    client.send(opening("again", false)).await;
    let Some(Outcome::Error(error)) = client.answer().await.outcome else { panic!("opening") };
    assert_eq!(error.field, "opening");
    let _ = client.items.send(proto::StreamRequest { kind: None }).await;
    assert!(matches!(client.answer().await.outcome, Some(Outcome::Error(_))));

    let seq = client.item(whole(row)).await;
    let answer = client.answer().await;
    assert!(answer.seq == seq && matches!(answer.outcome, Some(Outcome::Fused(_))), "{answer:?}");
    let (acknowledged, _, ended) = client.finish().await;
    assert!(ended.is_none() && acknowledged == Some(seq), "{acknowledged:?} {ended:?}");
    let samples = server.get("/v1/cameras/yard/samples/count").await.expect(200).json();
    assert_eq!(samples["count"], 1);
}

#[tokio::test]
async fn a_new_model_answers_in_mid_stream() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let mut client = open(&channel(&server).await, "edge-1", false).await;
    for (index, row) in rows(&Options { samples: 40, ..Options::demo() }).iter().enumerate() {
        if index == 20 {
            add_model(&server).await;
        }
        client.item(boxed(row)).await;
        let Some(Outcome::Fused(fused)) = client.answer().await.outcome else { panic!("no hiccup") };
        assert_eq!(fused.model_version, Some(if index < 20 { 1 } else { 2 }));
    }
}

#[tokio::test]
async fn silence_and_age_end_a_stream() {
    let folder = data_folder();
    let server = yard(folder.path(), &[("SIGHTFIX_LIMITS__LIVE_IDLE_S", "2")], json!({}), false).await;
    let mut client = open(&channel(&server).await, "edge-1", false).await;
    let status = client.next().await.expect_err("silent for too long");
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");

    let folder = data_folder();
    let server = yard(folder.path(), &[("SIGHTFIX_LIMITS__LIVE_AGE_S", "1")], json!({}), false).await;
    let mut client = open(&channel(&server).await, "edge-1", true).await;
    let row = &rows(&Options { samples: 1, ..Options::demo() })[0];
    let seq = client.item(boxed(row)).await;
    loop {
        match client.next().await.expect("asked to reconnect") {
            Some(Received::Reconnect(reconnect)) => {
                break assert!(reconnect.reason.contains("age"), "{reconnect:?}");
            }
            Some(_) => {}
            None => panic!("ended without being asked to reconnect"),
        }
    }
    let (acknowledged, _, ended) = client.finish().await;
    assert!(ended.is_none() && acknowledged == Some(seq), "{acknowledged:?} {ended:?}");
}

#[tokio::test]
async fn a_server_that_ends_asks_to_reconnect_and_acknowledges_what_it_stored() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), false).await;
    let mut client = open(&channel(&server).await, "edge-1", true).await;
    let rows = rows(&Options { samples: 50, ..Options::demo() });
    for row in &rows {
        client.item(whole(row)).await;
        client.answer().await;
    }
    let ended = tokio::task::spawn_blocking(move || server.terminate());
    let (mut asked_to_reconnect, mut acknowledged) = (false, 0);
    let status = loop {
        match client.next().await {
            Ok(Some(Received::Reconnect(_))) => asked_to_reconnect = true,
            Ok(Some(Received::Acknowledgement(upto))) => acknowledged = upto.seq,
            Ok(Some(_)) => {}
            Ok(None) => panic!("ended without a reason"),
            Err(status) => break status,
        }
    };
    assert!(asked_to_reconnect && acknowledged == rows.len() as u64, "{acknowledged}");
    assert_eq!(status.code(), Code::Unavailable, "{status:?}");
    assert!(ended.await.expect("no panic"), "the server ends well");
}

/// Waits until that number of items was taken.
async fn taken(server: &TestServer, count: usize) {
    let begun = Instant::now();
    let wanted = format!("sightfix_live_items_total {count}\n");
    while !server.get("/metrics").await.expect(200).text().contains(&wanted) {
        assert!(begun.elapsed() < Duration::from_secs(60), "not all items are taken");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_never_reads_loses_positions_and_no_samples() {
    const STREAMS: usize = 32;
    const ITEMS: usize = 2_000;
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let rows = rows(&Options { seed: 34, samples: ITEMS, targets: 1, ..Options::demo() });
    let named = |row: &SimulatedRow, name: String| proto::StreamItem { target_id: Some(name), ..whole(row) };
    let mut clients = Vec::new();
    for index in 0..STREAMS {
        clients.push(open(&channel(&server).await, &format!("edge-{index}"), index == 0).await);
    }
    for row in &rows {
        for (index, client) in clients.iter_mut().enumerate() {
            client.item(named(row, format!("walker-{index}"))).await;
        }
    }
    taken(&server, STREAMS * ITEMS).await;
    for (index, client) in clients.into_iter().enumerate() {
        let (acknowledged, answers, ended) = client.finish().await;
        assert!(ended.is_none(), "{ended:?}");
        assert_eq!(acknowledged, (index == 0).then_some(ITEMS as u64));
        let last = answers.last().expect("the latest are there");
        assert!(last.seq == ITEMS as u64 && last.lost_answers > 0, "{last:?}");
        assert_eq!(last.lost_answers + answers.len() as u64, ITEMS as u64);
    }
    let samples = server.get("/v1/cameras/yard/samples/count").await.expect(200).json();
    assert_eq!(samples["count"], ITEMS);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ten_thousand_streams_are_attempted_and_the_server_goes_on() {
    const CONNECTIONS: usize = 40;
    const STREAMS: usize = 250;
    const TAKEN: usize = 100;
    let folder = data_folder();
    let limits = [
        ("SIGHTFIX_LIMITS__LIVE_STREAMS", "100"),
        ("SIGHTFIX_LIMITS__LIVE_STREAMS_PER_CLIENT", "30"),
        // All streams come from one address.
        ("SIGHTFIX_LIMITS__CLIENT_SHARE", "1"),
    ];
    let server = yard(folder.path(), &limits, json!({}), true).await;
    let mut held = Vec::new();
    let mut refused = 0;
    for connection in 0..CONNECTIONS {
        let channel = channel(&server).await;
        let attempts = (0..STREAMS).map(|stream| {
            let channel = channel.clone();
            async move {
                let mut client =
                    begin(&channel, opening(&format!("c-{}", (connection * STREAMS + stream) % 7), false))
                        .await;
                match client.next().await {
                    Ok(Some(Received::Opened(_))) => Some(client),
                    Ok(other) => panic!("{other:?}"),
                    Err(status) => {
                        assert_eq!(status.code(), Code::Unavailable, "{status:?}");
                        None
                    }
                }
            }
        });
        let attempts: Vec<Option<Client>> = stream::iter(attempts).buffer_unordered(STREAMS).collect().await;
        refused += attempts.iter().filter(|attempt| attempt.is_none()).count();
        held.extend(attempts.into_iter().flatten());
    }
    assert_eq!((held.len(), refused), (TAKEN, CONNECTIONS * STREAMS - TAKEN));
    // Those that were taken work, and so does everything else.
    let row = &rows(&Options { samples: 1, ..Options::demo() })[0];
    let client = held.last_mut().expect("taken");
    client.item(whole(row)).await;
    assert!(matches!(client.answer().await.outcome, Some(Outcome::Fused(_))));
    server.get("/v1/cameras/yard/tracks").await.expect(200);
    // A place that is given back is there for others.
    drop(held);
    let begun = Instant::now();
    let channel = channel(&server).await;
    loop {
        let mut client = begin(&channel, opening("late", false)).await;
        if let Ok(Some(Received::Opened(_))) = client.next().await {
            break;
        }
        assert!(begun.elapsed() < Duration::from_secs(20), "no place is given back");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test]
async fn a_turned_camera_is_reported_everywhere_and_trained_again() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({"retrain_when_moved": true}), true).await;
    let scene = Options { seed: 35, samples: 3_000, targets: 3, ..Options::demo() };
    // 10 degrees is at the detector's threshold: 25 within half an hour of three targets.
    let knocked = Options { pan_deg_from: Some((scene.start, 20.0)), seed: 36, ..scene.clone() };
    let later = |row: &SimulatedRow| {
        let mut item = whole(row);
        item.time.as_mut().expect("set").seconds += 86_400;
        item
    };
    let mut client = open(&channel(&server).await, "edge-1", true).await;
    // The state until the model that is trained again answers is read as soon as the notice comes.
    let profile = async || server.get("/v1/cameras/yard").await.expect(200).json();
    let (mut notice, mut answer_after) = (None, None);
    let before = rows(&scene);
    let after = rows(&knocked);
    for item in before.iter().map(whole).chain(after.iter().map(later)) {
        client.item(item).await;
        loop {
            match client.next().await.expect("no end") {
                Some(Received::Answer(answer)) => {
                    answer_after = answer_after.or(notice.is_some().then_some(answer));
                    break;
                }
                Some(Received::CameraMoved(moved)) => notice = Some((client.seq, moved, profile().await)),
                _ => {}
            }
        }
    }
    // Detection and storing go on after the answers.
    while notice.is_none() {
        if let Some(Received::CameraMoved(moved)) = client.next().await.expect("no end") {
            notice = Some((client.seq, moved, profile().await));
        }
    }
    let (seq, moved, camera) = notice.expect("the stream reports it");
    assert!(seq > before.len() as u64 && moved.model_version == 1, "{seq} {moved:?}");
    assert!(camera["moved"]["statistic"].as_f64().is_some_and(|statistic| statistic > 0.0), "{camera}");
    assert!(server.get("/metrics").await.text().contains("sightfix_cameras_moved_total 1"));
    if answer_after.is_none() {
        client.item(later(&after[0])).await;
        answer_after = Some(Box::new(client.answer().await));
    }
    let Some(Outcome::Fused(fused)) = answer_after.and_then(|it| it.outcome) else { panic!("no position") };
    let flags: Vec<_> = fused.flags().collect();
    assert!(flags.contains(&proto::Flag::CameraMoved), "{flags:?}");
    // It is wrong by metres now, and says so.
    assert!(fused.e_regression_m2 > fused.e_gnss_m2, "{fused:?}");
    client.finish().await;
    let begun = Instant::now();
    loop {
        let runs = server.get("/v1/cameras/yard/training-runs").await.expect(200).json();
        if let Some(run) = runs["items"].as_array().and_then(|runs| runs.first()) {
            assert!(run["from"].is_string(), "{run}");
            break;
        }
        assert!(begun.elapsed() < Duration::from_secs(30), "no run was started");
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

#[tokio::test]
async fn clients_that_only_fuse_reveal_a_turned_camera_too() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let scene = Options { seed: 37, samples: 3_000, targets: 3, ..Options::demo() };
    let knocked = Options { pan_deg_from: Some((scene.start, 10.0)), seed: 38, ..scene.clone() };
    let observed = |row: &SimulatedRow, days: i64| {
        let [left_px, top_px, width_px, height_px] = row.bounding_box?.sides_px();
        let position = row.fix?.position;
        Some(json!({
            "time": row.time + jiff::SignedDuration::from_hours(24 * days),
            "target_id": row.target_id.as_str(),
            "bounding_box": {"left_px": left_px, "top_px": top_px, "width_px": width_px, "height_px": height_px},
            "fix": {"longitude_deg": position.longitude_deg(), "latitude_deg": position.latitude_deg()},
        }))
    };
    let (before, after) = (rows(&scene), rows(&knocked));
    let all: Vec<Value> = before
        .iter()
        .filter_map(|row| observed(row, 0))
        .chain(after.iter().filter_map(|row| observed(row, 1)))
        .collect();
    let moved = async || server.get("/v1/cameras/yard").await.expect(200).json()["moved"].clone();
    // The last of each four is compared, so each of the three targets in turn.
    for (index, batch) in all.chunks(4).enumerate() {
        server.post("/v1/cameras/yard/fusions", &json!({ "observations": batch })).await.expect(200);
        if index == before.len() / 4 {
            assert!(moved().await.is_null(), "nothing was turned yet");
        }
    }
    let begun = Instant::now();
    while moved().await["model_version"] != 1 {
        assert!(begun.elapsed() < Duration::from_secs(30), "no alarm was raised");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}
