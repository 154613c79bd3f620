//! Clients whose backlog never ends: what ends a stream is noticed all the same.

use futures_util::stream;
use serde_json::json;
use sightfix::grpc::proto;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use sightfix::simulation::Options;
use tokio::sync::mpsc;
use tonic::Code;

use crate::harness::{TestServer, data_folder};
use crate::live_client::{Client, Received, Sent, boxed, channel, open, rows, yard};

/// Sends one box again and again until the stream takes no more.
fn flood(client: &Client) {
    let row = rows(&Options { samples: 1, ..Options::demo() }).remove(0);
    let (items, mut seq) = (client.items.clone(), client.seq);
    tokio::spawn(async move {
        loop {
            seq += 1;
            let kind = Some(Sent::Item(proto::StreamItem { seq, ..boxed(&row) }));
            if items.send(proto::StreamRequest { kind }).await.is_err() {
                return;
            }
        }
    });
}

/// Reads until the stream ends; whether a reconnect was asked for, and how it ended.
async fn read_to_end(client: &mut Client) -> (bool, Option<Code>) {
    let mut asked_to_reconnect = false;
    loop {
        match client.next().await {
            Ok(Some(Received::Reconnect(_))) => asked_to_reconnect = true,
            Ok(Some(_)) => {}
            Ok(None) => return (asked_to_reconnect, None),
            Err(status) => return (asked_to_reconnect, Some(status.code())),
        }
    }
}

async fn flooded(server: &TestServer) -> Client {
    let mut client = open(&channel(server).await, "edge-1", false).await;
    flood(&client);
    for _ in 0..500 {
        client.next().await.expect("no end");
    }
    client
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flooded_stream_notices_its_age() {
    let folder = data_folder();
    let server = yard(folder.path(), &[("SIGHTFIX_LIMITS__LIVE_AGE_S", "1")], json!({}), true).await;
    let mut client = flooded(&server).await;
    assert_eq!(read_to_end(&mut client).await, (true, None));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flooded_stream_notices_the_end_of_the_server() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), true).await;
    let mut client = flooded(&server).await;
    let ended = tokio::task::spawn_blocking(move || server.terminate());
    assert_eq!(read_to_end(&mut client).await, (true, Some(Code::Unavailable)));
    assert!(ended.await.expect("no panic"), "the server ends in order");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flooded_import_notices_the_end_of_the_server() {
    let folder = data_folder();
    let server = yard(folder.path(), &[], json!({}), false).await;
    let mut service = SampleServiceClient::new(channel(&server).await);
    let (sent, mut first_is_sent) = mpsc::channel(1);
    let requests = stream::unfold(sent, |sent| async move {
        // One sample too old to be taken: nothing waits for the database.
        let sample = proto::Sample { time: Some(prost_types::Timestamp::default()), ..Default::default() };
        let samples = vec![sample; 20];
        let _ = sent.try_send(());
        Some((
            proto::ImportSamplesRequest { camera_id: "yard".to_owned(), samples, ..Default::default() },
            sent,
        ))
    });
    let importing = tokio::spawn(async move { service.import_samples(requests).await });
    first_is_sent.recv().await.expect("the import has begun");
    let ended = tokio::task::spawn_blocking(move || server.terminate());
    let status = importing.await.expect("no panic").expect_err("the server ends");
    // The server's status is lost where the connection ends with a part of the flood unread: tonic calls it internal.
    assert!(matches!(status.code(), Code::Unavailable | Code::Internal), "{status:?}");
    assert!(ended.await.expect("no panic"), "the server ends in order");
}
