//! Fusions: good ones, and each kind of bad input.

use sightfix::grpc::proto;
use tonic::Code;

use super::server::{Server, refusal_of};

const NOON: prost_types::Timestamp = prost_types::Timestamp { seconds: 1_700_000_000, nanos: 500_000_000 };

fn profile() -> proto::CameraProfile {
    proto::CameraProfile {
        image_size: Some(proto::ImageSize { width_px: 640, height_px: 480 }),
        gnss_error: Some(proto::GnssError { sigma_m: Some(3.0) }),
        ..Default::default()
    }
}

fn fix(longitude_deg: f64, latitude_deg: f64) -> Option<proto::Fix> {
    Some(proto::Fix { longitude_deg: Some(longitude_deg), latitude_deg: Some(latitude_deg), sigma_m: None })
}

fn sides(left_px: f64, top_px: f64, width_px: f64, height_px: f64) -> Option<proto::BoundingBox> {
    Some(proto::BoundingBox {
        left_px: Some(left_px),
        top_px: Some(top_px),
        width_px: Some(width_px),
        height_px: Some(height_px),
    })
}

fn good() -> proto::Observation {
    proto::Observation {
        time: Some(NOON),
        target_id: Some("person-1".to_owned()),
        bounding_box: None,
        fix: fix(103.98678, 30.6280135),
    }
}

fn of_yard(observations: Vec<proto::Observation>) -> proto::FuseRequest {
    proto::FuseRequest { camera_id: "yard".to_owned(), observations }
}

#[tokio::test]
async fn without_a_model_fixes_pass_and_boxes_are_refused() {
    let server = Server::with_camera(profile()).await;
    let fused = server.fusion().fuse(of_yard(vec![good()])).await.expect("a fix").into_inner().fusions;
    let [fused] = fused.as_slice() else { panic!("{fused:?}") };
    assert_eq!((fused.time, fused.target_id.as_deref()), (Some(NOON), Some("person-1")));
    assert_eq!(fused.gnss, good().fix);
    let position = fused.fused.expect("set");
    assert_eq!((position.longitude_deg, position.latitude_deg), (Some(103.98678), Some(30.6280135)));
    let flags: Vec<_> = fused.flags().collect();
    assert!(flags.contains(&proto::Flag::BoxMissing) && flags.contains(&proto::Flag::NoModel), "{flags:?}");
    assert!(fused.r95_m > 3.0 && (fused.confidence_gnss - 1.0).abs() < 1e-12, "{fused:?}");

    let boxed = proto::Observation { bounding_box: sides(10.0, 10.0, 20.0, 40.0), ..good() };
    let status = server.fusion().fuse(of_yard(vec![good(), boxed])).await.expect_err("no model");
    let (message, _) = refusal_of(&status, Code::FailedPrecondition, "no-model");
    assert!(message.contains("yard"), "{message}");
}

#[tokio::test]
async fn observations_with_bad_values_name_the_field() {
    let server = Server::with_camera(profile()).await;
    let at = |seconds| Some(prost_types::Timestamp { seconds, nanos: 0 });
    let boxed = |bounding_box| proto::Observation { bounding_box, ..good() };
    let fixed = |fix| proto::Observation { fix, ..good() };
    for (bad, field) in [
        (fixed(fix(f64::NAN, 30.0)), "fix.longitude_deg"),
        (fixed(fix(103.9, f64::NAN)), "fix.latitude_deg"),
        (fixed(fix(f64::NEG_INFINITY, 30.0)), "fix.longitude_deg"),
        (fixed(fix(181.0, 30.0)), "fix.longitude_deg"),
        (fixed(fix(103.9, 91.0)), "fix.latitude_deg"),
        (fixed(Some(proto::Fix::default())), "fix.longitude_deg"),
        (fixed(fix(0.0, 0.0).map(|fix| proto::Fix { sigma_m: Some(-1.0), ..fix })), "fix.sigma_m"),
        (boxed(sides(1e39, 10.0, 20.0, 40.0)), "bounding_box.left_px"),
        (boxed(sides(10.0, f64::NAN, 20.0, 40.0)), "bounding_box.top_px"),
        (boxed(sides(10.0, 10.0, 0.0, 40.0)), "bounding_box.width_px"),
        (boxed(sides(10.0, 10.0, 20.0, f64::INFINITY)), "bounding_box.height_px"),
        (boxed(sides(5_000.0, 10.0, 20.0, 40.0)), "bounding_box.left_px"),
        (boxed(Some(proto::BoundingBox::default())), "bounding_box.left_px"),
        (proto::Observation { fix: None, ..good() }, "bounding_box"),
        (proto::Observation { time: None, ..good() }, "time"),
        (proto::Observation { time: at(4_102_444_800), ..good() }, "time"),
        (proto::Observation { time: at(0), ..good() }, "time"),
        (proto::Observation { time: at(i64::MIN), ..good() }, "time.seconds"),
        (proto::Observation { target_id: Some(String::new()), ..good() }, "target_id"),
    ] {
        let request = of_yard(vec![good(), bad.clone()]);
        let status = server.fusion().fuse(request).await.expect_err(field);
        let (_, fields) = refusal_of(&status, Code::InvalidArgument, "invalid-argument");
        assert_eq!(fields, [format!("observations[1].{field}")], "{bad:?}");
    }
}

#[tokio::test]
async fn batches_have_a_camera_and_a_length() {
    let server = Server::with_camera(profile()).await;
    let elsewhere = proto::FuseRequest { camera_id: "nowhere".to_owned(), observations: vec![good()] };
    let status = server.fusion().fuse(elsewhere).await.expect_err("no such camera");
    refusal_of(&status, Code::NotFound, "camera-not-found");
    let status = server.fusion().fuse(of_yard(Vec::new())).await.expect_err("none");
    assert_eq!(refusal_of(&status, Code::InvalidArgument, "invalid-argument").1, ["observations"]);
    let many = vec![good(); server.app.limits.batch_observations + 1];
    let status = server.fusion().fuse(of_yard(many)).await.expect_err("too many");
    assert_eq!(refusal_of(&status, Code::ResourceExhausted, "too-large").1, ["observations"]);
}

#[tokio::test]
async fn fixes_of_one_point_tell_the_receivers_error() {
    use sightfix::grpc::proto::model_service_client::ModelServiceClient;
    let server = Server::with_camera(profile()).await;
    let mut models = ModelServiceClient::new(server.channel.clone());
    let degree = 1e-5;
    let mut fixes: Vec<proto::Fix> =
        (0..40).filter_map(|n| fix(f64::from(n % 5) * degree, f64::from(n % 4) * degree)).collect();
    fixes[7].latitude_deg = Some(91.0);
    let request = proto::EstimateGnssErrorRequest { camera_id: "yard".to_owned(), fixes };
    let told_of = models.estimate_gnss_error(request.clone()).await.expect("enough").into_inner();
    assert_eq!((told_of.fixes, told_of.rejected), (39, 1));
    assert_eq!((told_of.rejected_rows[0].line, told_of.rejected_rows[0].field.as_str()), (8, "latitude_deg"));
    assert!((0.5..5.0).contains(&told_of.sigma_m), "{told_of:?}");
    let few = proto::EstimateGnssErrorRequest { fixes: request.fixes[..9].to_vec(), ..request };
    let status = models.estimate_gnss_error(few).await.expect_err("too few");
    assert_eq!(refusal_of(&status, Code::InvalidArgument, "invalid-argument").1, ["fixes"]);
}
