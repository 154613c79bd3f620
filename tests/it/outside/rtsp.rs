//! ONVIF metadata of an RTSP stream, against GStreamer's RTSP server.

use serde_json::{Value, json};

use super::peers::{RtspCamera, connection_when, create_gate, patch};
use crate::harness::{TestServer, data_folder, now, own_address};

/// A frame that ONVIF Device Manager showed of a camera (its maker is not named; github.com/quatanium/python-onvif,
/// "Receive MetadataStream from Camera", 2018), with another time.
fn recorded_frame(object: u32) -> String {
    let time = now();
    format!(
        r#"<tt:MetadataStream xmlns:tt="http://www.onvif.org/ver10/schema"><tt:VideoAnalytics><tt:Frame UtcTime="{time:.4}">
        <tt:Object ObjectId="{object}"><tt:Appearance velocity="0.00" area="5.98"><tt:Shape>
        <tt:BoundingBox bottom="-0.78" top="0.93" right="0.96" left="0.32"/><tt:CenterOfGravity x="0.64" y="0.09"/>
        <tt:Polygon><tt:Point x="0.61" y="0.78"/><tt:Point x="0.69" y="0.93"/></tt:Polygon></tt:Shape>
        <tt:Class><tt:ClassCandidate><tt:Type>Human</tt:Type><tt:Likelihood>0.61</tt:Likelihood></tt:ClassCandidate></tt:Class>
        <tt:GeoLocation lon="9.4508070672052553" lat="52.5539138110899864" elevation="44.50"/></tt:Appearance></tt:Object>
        </tt:Frame></tt:VideoAnalytics></tt:MetadataStream>"#
    )
    .replace('\n', "")
}

async fn connect(server: &TestServer, camera: &RtspCamera) {
    let source =
        json!({"address": camera.address(), "format": "onvif", "cameras": {"*": {"camera_id": "gate"}}});
    server.post("/v1/connections", &json!({"id": "camera", "source": source})).await.expect(201);
}

/// Why messages, and parts of them, were not taken.
fn reasons(status: &Value) -> Vec<&str> {
    let reasons = status["reasons"].as_array().expect("reasons");
    reasons.iter().filter_map(|reason| reason["reason"].as_str()).collect()
}

#[tokio::test]
#[ignore = "needs GStreamer's RTSP server"]
async fn boxes_of_an_rtsp_stream_come_again_after_the_camera_was_away() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let port = own_address().port();
    let mut camera = RtspCamera::start_at(port, &[]);
    connect(&server, &camera).await;
    connection_when(&server, "camera", |status| status["state"] == "running").await;
    camera.send(&recorded_frame(16740));
    let status = connection_when(&server, "camera", |status| status["items"] == 1).await["status"].clone();
    assert_eq!((&status["lost"], &status["rejected"]), (&json!(0), &json!(0)), "{status}");
    // The stream also has documents without a frame, which are no detections.
    assert!(reasons(&status).iter().any(|reason| reason.contains("no detection")), "{status}");

    drop(camera);
    let away = connection_when(&server, "camera", |status| status["state"] == "waiting").await;
    assert!(away["status"]["last_error"].is_object(), "{away}");
    let mut camera = RtspCamera::start_at(port, &[]);
    connection_when(&server, "camera", |status| status["state"] == "running").await;
    camera.send(&recorded_frame(16741));
    let back = connection_when(&server, "camera", |status| status["items"] == 2).await;
    assert_eq!(back["status"]["lost"], 0, "{back}");
}

#[tokio::test]
#[ignore = "needs GStreamer's RTSP server"]
async fn a_camera_of_rtsp_that_asks_for_a_user_says_so_until_it_has_one() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    create_gate(&server).await;
    let mut camera = RtspCamera::start_at(own_address().port(), &["operator", "secret"]);
    connect(&server, &camera).await;
    let has_error = |status: &Value, part: &str| {
        status["last_error"]["message"].as_str().is_some_and(|message| message.contains(part))
    };
    connection_when(&server, "camera", |status| has_error(status, "give username")).await;
    let wrong = json!({"source": {"username": "operator"}, "secrets": {"password": "wrong"}});
    patch(&server, "camera", &wrong).await.expect(200);
    connection_when(&server, "camera", |status| has_error(status, "refuses the username or the password"))
        .await;
    patch(&server, "camera", &json!({"secrets": {"password": "secret"}})).await.expect(200);
    connection_when(&server, "camera", |status| status["state"] == "running").await;
    camera.send(&recorded_frame(16740));
    connection_when(&server, "camera", |status| status["items"] == 1).await;
}

#[tokio::test]
#[ignore = "needs GStreamer's RTSP server"]
async fn documents_of_rtsp_that_are_too_large_or_no_metadata_are_rejected_alone() {
    let folder = data_folder();
    let server =
        TestServer::start_with(folder.path(), &[("SIGHTFIX_LIMITS__CONNECTION_MESSAGE_BYTES", "4096")]);
    create_gate(&server).await;
    let mut camera = RtspCamera::start();
    connect(&server, &camera).await;
    connection_when(&server, "camera", |status| status["state"] == "running").await;
    camera.send(&format!("<!--{}-->", "-".repeat(40_000)));
    camera.send("<tt:MetadataStream");
    camera.send(&recorded_frame(16740));
    let status = connection_when(&server, "camera", |status| status["items"] == 1).await["status"].clone();
    assert_eq!((&status["rejected"], &status["lost"]), (&json!(2), &json!(0)), "{status}");
    for part in ["is larger than 4096 bytes", "is not XML"] {
        assert!(reasons(&status).iter().any(|reason| reason.contains(part)), "{part}: {status}");
    }
}
