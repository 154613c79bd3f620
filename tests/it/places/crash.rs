//! Events under kills of the server.

use std::collections::BTreeSet;

use jiff::SignedDuration;
use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::TcpListener;
use tokio::sync::mpsc;

use super::{create, drive, line};
use crate::crash::setting;
use crate::harness::{TestServer, data_folder, now, own_address};
use crate::outside::peers::create_gate;

/// A receiver of webhooks that sends the id of each event it takes.
async fn receive(listener: TcpListener, taken: mpsc::UnboundedSender<String>) {
    while let Ok((stream, _)) = listener.accept().await {
        let taken = taken.clone();
        tokio::spawn(async move {
            let mut stream = BufReader::new(stream);
            while let Some(body) = read_request(&mut stream).await {
                let event: Value = serde_json::from_slice(&body).expect("JSON");
                let _ = taken.send(event["id"].as_str().expect("an id").to_owned());
                if stream.get_mut().write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n").await.is_err()
                {
                    return;
                }
            }
        });
    }
}

/// The body of a request; `None` where the connection ends.
async fn read_request(stream: &mut BufReader<tokio::net::TcpStream>) -> Option<Vec<u8>> {
    let mut length = 0;
    loop {
        let mut line = String::new();
        if stream.read_line(&mut line).await.ok()? == 0 {
            return None;
        }
        match line.trim_end().split_once(": ") {
            Some((name, value)) if name.eq_ignore_ascii_case("content-length") => {
                length = value.parse().ok()?
            }
            Some(_) => {}
            None if line.trim_end().is_empty() => break,
            None => {}
        }
    }
    let mut body = vec![0; length];
    stream.read_exact(&mut body).await.ok()?;
    Some(body)
}

/// Every event that the server has stored reaches the webhook, however often the server is killed.
#[tokio::test]
#[ignore = "kills servers; .ci/run runs it as a step of its own"]
async fn crash_every_stored_event_reaches_a_webhook_once_or_more() {
    let kills = setting("KILLS", 5);
    let receiver = own_address();
    let (taken, mut ids) = mpsc::unbounded_channel();
    tokio::spawn(receive(TcpListener::bind(receiver).await.expect("a port"), taken));
    let folder = data_folder();
    let mut server = TestServer::start(folder.path());
    create_gate(&server).await;
    let sink =
        json!({"address": format!("http://{receiver}/"), "content": "place_events", "camera_ids": ["gate"]});
    server.post("/v1/connections", &json!({"id": "hook", "sink": sink})).await.expect(201);
    create(&server, &line()).await;
    let start = now() - SignedDuration::from_secs(600);
    for round in 0..kills {
        for target in 0..20 {
            drive(&server, &format!("t{round}-{target}"), (-50.0, 50.0), 10.0, start).await;
        }
        // Somewhere between the evaluation of the first and the delivery of the last.
        tokio::time::sleep(std::time::Duration::from_millis(40 * (round + 1))).await;
        server.kill();
        server = TestServer::start(folder.path());
        tokio::time::sleep(std::time::Duration::from_millis(1_500)).await;
    }
    let page = server.get("/v1/place-events?limit=1000").await.expect(200).json();
    let stored: BTreeSet<_> =
        page["items"].as_array().expect("events").iter().map(|it| it["id"].to_string()).collect();
    assert!(!stored.is_empty(), "nothing was stored between the kills");
    let mut received: Vec<String> = Vec::new();
    let all = async {
        loop {
            received.push(json!(ids.recv().await.expect("open")).to_string());
            if received.iter().cloned().collect::<BTreeSet<_>>().is_superset(&stored) {
                return;
            }
        }
    };
    let in_time = tokio::time::timeout(std::time::Duration::from_secs(60), all).await.is_ok();
    let unique: BTreeSet<_> = received.iter().cloned().collect();
    println!(
        "{kills} kills: {} events stored, {} deliveries of {} events",
        stored.len(),
        received.len(),
        unique.len()
    );
    assert!(in_time && unique == stored, "{:?}", stored.difference(&unique));
}
