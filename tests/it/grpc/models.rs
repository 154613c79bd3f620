//! Model versions: in by a file, active, back, and out again as the same file.

use std::ops::ControlFlow;

use sightfix::domain::{CameraId, GnssError, Observation, Recipe, StoredSample};
use sightfix::grpc::proto;
use sightfix::grpc::proto::model_service_client::ModelServiceClient;
use sightfix::model::{FitOptions, fit};
use sightfix::simulation::{Options, simulate};
use tonic::Code;
use tonic::transport::Channel;

use super::server::{Server, refusal_of};

/// A model of the small simulated square after a few passes, as a file.
fn file(seed: u64) -> bytes::Bytes {
    let options = FitOptions {
        recipe: Recipe::Hybrid,
        seed,
        epochs: Some(3),
        image_size: None,
        gnss_error: GnssError::Unknown,
        gnss_bias_sigma_m: None,
    };
    let samples = simulate(&Options::demo()).training_samples();
    let fitted = fit(&samples, &options, &mut |_| ControlFlow::Continue(()));
    fitted.expect("a fit").to_file().expect("a file")
}

async fn import(models: &mut ModelServiceClient<Channel>, seed: u64) -> proto::ModelVersion {
    let request = proto::ImportModelRequest { camera_id: "yard".to_owned(), safetensors: file(seed) };
    models.import_model(request).await.expect("stored").into_inner().model.expect("set")
}

#[tokio::test]
async fn versions_come_and_go_and_answer_as_the_application_does() {
    let server = Server::with_camera(proto::CameraProfile::default()).await;
    let mut models = ModelServiceClient::new(server.channel.clone());
    let first = import(&mut models, 1).await;
    assert_eq!((first.number, first.run_id.as_ref(), first.recipe.as_str()), (1, None, "hybrid"));
    let metadata: serde_json::Value = serde_json::from_str(&first.metadata_json).expect("JSON");
    assert_eq!(metadata["seed"], 1);
    assert_eq!(import(&mut models, 2).await.number, 2);
    let list = proto::ListModelsRequest { camera_id: "yard".to_owned(), page_size: 1, ..Default::default() };
    let page = models.list_models(list.clone()).await.expect("a page").into_inner();
    let rest = proto::ListModelsRequest { page_token: page.next_page_token, ..list };
    let rest = models.list_models(rest).await.expect("a page").into_inner();
    assert_eq!((page.models[0].number, rest.models.as_slice()), (2, [first.clone()].as_slice()));
    assert!(rest.next_page_token.is_empty());

    let number = |number| proto::ActivateModelRequest { camera_id: "yard".to_owned(), number };
    for version in [1, 2] {
        let active = models.activate_model(number(version)).await.expect("there").into_inner().model;
        assert_eq!(active.map(|model| model.number), Some(version));
    }
    let status = models.activate_model(number(3)).await.expect_err("no such version");
    refusal_of(&status, Code::NotFound, "model-not-found");
    let back = proto::RollBackModelRequest { camera_id: "yard".to_owned() };
    let active = models.roll_back_model(back).await.expect("one before").into_inner().model;
    assert_eq!(active, Some(first));

    let get = |format| proto::DownloadModelRequest { camera_id: "yard".to_owned(), number: 2, format };
    let downloaded = models.download_model(get(0)).await.expect("there").into_inner();
    assert_eq!((&downloaded.safetensors, downloaded.onnx.is_empty()), (&file(2), true));
    let onnx = models.download_model(get(proto::ModelFormat::Onnx as i32)).await.expect("there").into_inner();
    assert!(onnx.safetensors.is_empty() && !onnx.onnx.is_empty(), "the graph alone");
    let status = models.download_model(get(9)).await.expect_err("no such format");
    refusal_of(&status, Code::InvalidArgument, "invalid-argument");
    fuses_as_the_application_does(&server).await;
}

/// Bit for bit, with a fix and without.
async fn fuses_as_the_application_does(server: &Server) {
    let camera = CameraId::new("yard").expect("a slug");
    let samples = simulate(&Options::demo()).training_samples();
    let mut observations = Vec::new();
    let mut messages = Vec::new();
    for (index, sample) in samples.into_iter().take(100).enumerate() {
        let message = proto::Sample::from(StoredSample::from(sample.clone()));
        let fix = Some(sample.fix).filter(|_| index % 3 > 0);
        messages.push(proto::Observation {
            time: message.time,
            target_id: Some(message.target_id),
            bounding_box: message.bounding_box,
            fix: fix.map(Into::into),
        });
        let target_id = Some(sample.target_id);
        observations
            .push(Observation::new(sample.time, target_id, Some(sample.bounding_box), fix).expect("a box"));
    }
    let request = proto::FuseRequest { camera_id: "yard".to_owned(), observations: messages };
    let fusions = server.fusion().fuse(request).await.expect("positions").into_inner().fusions;
    let active = server.app.active_camera(&camera).await.expect("known");
    let expected = server.app.fusion().fuse(active, &observations).await.expect("positions");
    assert_eq!(fusions.len(), expected.len());
    for (fused, expected) in fusions.iter().zip(&expected) {
        let position = fused.fused.expect("set");
        let bits = |value: Option<f64>| value.map(f64::to_bits);
        assert_eq!(bits(position.longitude_deg), bits(Some(expected.fused.longitude_deg())));
        assert_eq!(bits(position.latitude_deg), bits(Some(expected.fused.latitude_deg())));
        assert_eq!(fused.r95_m.to_bits(), expected.r95_m.to_bits());
        assert_eq!(fused.confidence_gnss.to_bits(), expected.confidences.gnss.to_bits());
        assert_eq!(bits(fused.e_regression_m2), bits(expected.e_regression_m2));
        assert_eq!((fused.model_version, fused.gnss.is_some()), (Some(1), expected.gnss.is_some()));
    }
}

#[tokio::test]
async fn files_that_are_no_models_are_refused() {
    let server = Server::with_camera(proto::CameraProfile::default()).await;
    let mut models = ModelServiceClient::new(server.channel.clone());
    let whole = file(1);
    for broken in [whole.slice(..0), whole.slice(..100), whole.slice(..whole.len() - 1)] {
        let request = proto::ImportModelRequest { camera_id: "yard".to_owned(), safetensors: broken };
        let status = models.import_model(request).await.expect_err("no model");
        assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
    }
    let back = proto::RollBackModelRequest { camera_id: "yard".to_owned() };
    let status = models.roll_back_model(back).await.expect_err("none");
    refusal_of(&status, Code::FailedPrecondition, "no-model");
}
