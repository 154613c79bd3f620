//! Imports as a client's stream, and what is stored of them.

use std::ops::Range;
use std::time::Duration;

use futures_util::{StreamExt as _, stream};
use sightfix::grpc::proto;
use sightfix::grpc::proto::sample_service_client::SampleServiceClient;
use tonic::{Code, Status};

use super::server::{Server, refusal_of};

const BEGIN_S: i64 = 1_700_000_000;

fn sample(second: i64) -> proto::Sample {
    proto::Sample {
        time: Some(prost_types::Timestamp { seconds: BEGIN_S + second, nanos: 0 }),
        target_id: "person-1".to_owned(),
        bounding_box: Some(proto::BoundingBox {
            left_px: Some(10.0 + second as f64 % 100.0),
            top_px: Some(20.0),
            width_px: Some(30.0),
            height_px: Some(60.0),
        }),
        fix: Some(Box::new(proto::Fix {
            longitude_deg: Some(103.9 + second as f64 * 1e-6),
            latitude_deg: Some(30.6),
            sigma_m: Some(2.0),
        })),
        class: Some("person".to_owned()),
        score: Some(0.75),
        truth: None,
    }
}

pub(super) fn samples(seconds: Range<i64>) -> Vec<proto::Sample> {
    seconds.map(sample).collect()
}

fn batch(samples: Vec<proto::Sample>) -> proto::ImportSamplesRequest {
    proto::ImportSamplesRequest { camera_id: "yard".to_owned(), samples, ..Default::default() }
}

fn client(server: &Server) -> SampleServiceClient<tonic::transport::Channel> {
    SampleServiceClient::new(server.channel.clone())
}

async fn send(
    server: &Server,
    messages: Vec<proto::ImportSamplesRequest>,
) -> Result<proto::ImportSamplesResponse, Status> {
    client(server).import_samples(stream::iter(messages)).await.map(tonic::Response::into_inner)
}

pub(super) async fn import(
    server: &Server,
    samples: Vec<proto::Sample>,
) -> Result<proto::ImportSamplesResponse, Status> {
    send(server, vec![batch(samples)]).await
}

async fn count(server: &Server, filter: Option<proto::SampleFilter>) -> u64 {
    let request = proto::CountSamplesRequest { camera_id: "yard".to_owned(), filter };
    client(server).count_samples(request).await.expect("a number").into_inner().count
}

/// The bound on what a message comes to in memory is none for rows that have nothing but what they must have.
#[tokio::test]
async fn a_message_of_many_short_rows_is_taken() {
    let server = Server::with_camera(proto::CameraProfile::default()).await;
    let short = |second| proto::Sample {
        target_id: "7".to_owned(),
        fix: None,
        class: None,
        score: None,
        ..sample(second)
    };
    let imported = import(&server, (0..20_000).map(short).collect()).await.expect("taken");
    assert_eq!(imported.accepted, 20_000);
}

#[tokio::test]
async fn one_bad_sample_never_loses_the_others() {
    let server = Server::with_camera(proto::CameraProfile {
        image_size: Some(proto::ImageSize { width_px: 640, height_px: 480 }),
        ..Default::default()
    })
    .await;
    let mut second = samples(1_500..3_000);
    second[250].fix.as_mut().expect("set").latitude_deg = Some(91.0);
    second[251].bounding_box = None;
    second[252].bounding_box.as_mut().expect("set").left_px = Some(9_000.0);
    second[253] = sample(3);
    let messages = vec![
        batch(samples(0..1_500)),
        proto::ImportSamplesRequest { samples: second, ..Default::default() },
        batch(Vec::new()),
        batch(samples(2_990..3_010)),
    ];
    let report = send(&server, messages).await.expect("an answer");
    assert_eq!((report.accepted, report.duplicate, report.rejected), (3_006, 11, 3));
    let rejected: Vec<_> = report.rejected_rows.iter().map(|row| (row.line, row.field.as_str())).collect();
    assert_eq!(
        rejected,
        [(1_751, "fix.latitude_deg"), (1_752, "bounding_box"), (1_753, "bounding_box.left_px")]
    );
    assert!(report.rejected_rows[0].reason.contains("-90 to 90"), "{:?}", report.rejected_rows[0]);
    assert_eq!(count(&server, None).await, 3_006);

    let again = import(&server, samples(0..10)).await.expect("an answer");
    assert_eq!((again.accepted, again.duplicate), (0, 10));
    let bad = vec![proto::Sample::default(); 150];
    let report = import(&server, bad).await.expect("an answer");
    assert_eq!((report.rejected, report.rejected_rows.len()), (150, 100));
}

#[tokio::test]
async fn a_stream_names_one_camera_that_exists() {
    let server = Server::with_camera(proto::CameraProfile::default()).await;
    let nameless = proto::ImportSamplesRequest { samples: samples(0..2), ..Default::default() };
    for messages in [Vec::new(), vec![nameless]] {
        let status = send(&server, messages).await.expect_err("no camera");
        assert_eq!(refusal_of(&status, Code::InvalidArgument, "invalid-argument").1, ["camera_id"]);
    }
    let elsewhere = proto::ImportSamplesRequest {
        camera_id: "nowhere".to_owned(),
        samples: samples(2..4),
        ..Default::default()
    };
    let status = send(&server, vec![elsewhere.clone()]).await.expect_err("no such camera");
    refusal_of(&status, Code::NotFound, "camera-not-found");
    let status = send(&server, vec![batch(samples(0..2)), elsewhere]).await.expect_err("another camera");
    let (message, fields) = refusal_of(&status, Code::InvalidArgument, "invalid-argument");
    assert_eq!(fields, ["camera_id"]);
    assert!(message.contains("2 rows before it are stored"), "{message}");
    assert_eq!(count(&server, None).await, 2);
}

#[tokio::test]
async fn an_import_ends_with_the_server_and_says_what_is_stored() {
    let server = Server::with_camera(proto::CameraProfile::default()).await;
    let unending = stream::iter([batch(samples(0..5))]).chain(stream::pending());
    let mut importing = client(&server);
    let importing = tokio::spawn(async move { importing.import_samples(unending).await });
    tokio::time::timeout(Duration::from_secs(20), async {
        while count(&server, None).await < 5 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    })
    .await
    .expect("samples are stored as they come");
    server.begin_shutdown();
    let status = importing.await.expect("no panic").expect_err("the server ends");
    let (message, _) = refusal_of(&status, Code::Unavailable, "shutting-down");
    assert!(message.contains("5 rows"), "{message}");
}

#[tokio::test]
async fn samples_come_back_page_by_page_and_go_by_a_filter() {
    let server = Server::with_camera(proto::CameraProfile::default()).await;
    import(&server, samples(0..25)).await.expect("stored");
    let mut request =
        proto::ListSamplesRequest { camera_id: "yard".to_owned(), page_size: 10, ..Default::default() };
    let (mut pages, mut read) = (0, Vec::new());
    loop {
        let page = client(&server).list_samples(request.clone()).await.expect("a page").into_inner();
        pages += 1;
        read.extend(page.samples);
        if page.next_page_token.is_empty() {
            break;
        }
        request.page_token = page.next_page_token;
    }
    assert_eq!((pages, read), (3, samples(0..25)));

    let delete = |filter| proto::DeleteSamplesRequest { camera_id: "yard".to_owned(), filter };
    for none in [None, Some(proto::SampleFilter::default())] {
        let status = client(&server).delete_samples(delete(none)).await.expect_err("all of them");
        assert_eq!(refusal_of(&status, Code::InvalidArgument, "invalid-argument").1, ["filter"]);
    }
    let until = prost_types::Timestamp { seconds: BEGIN_S + 10, nanos: 0 };
    let filter = proto::SampleFilter { until: Some(until), ..Default::default() };
    assert_eq!(count(&server, Some(filter.clone())).await, 10);
    let deleted = client(&server).delete_samples(delete(Some(filter))).await.expect("some").into_inner();
    assert_eq!((deleted.deleted, count(&server, None).await), (10, 15));
}
