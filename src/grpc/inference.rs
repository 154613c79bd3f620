//! `inference.GRPCInferenceService`: the Open Inference Protocol (KServe's V2).

use super::convert::required;
use super::inference_proto as proto;
use super::inference_proto::grpc_inference_service_server::GrpcInferenceService;
use super::inference_proto::model_infer_request::InferInputTensor;
use super::inference_proto::model_infer_response::InferOutputTensor;
use super::inference_proto::model_metadata_response::TensorMetadata;
use super::statuses::{Reply, answer};
use crate::app::{App, BOX_COLUMNS, BOXES, Inferred, OutputTensor};
use crate::domain::{CameraId, Error, ErrorKind, Result};
use crate::shutdown::Shutdown;

const FP64: &str = "FP64";
const FP32: &str = "FP32";
/// Any extent.
const ANY: i64 = -1;

pub(super) struct Inference {
    app: App,
    shutdown: Shutdown,
}

impl Inference {
    pub(super) fn new(app: &App, shutdown: &Shutdown) -> Self {
        Self { app: app.clone(), shutdown: shutdown.clone() }
    }
}

#[tonic::async_trait]
impl GrpcInferenceService for Inference {
    async fn server_live(
        &self,
        request: tonic::Request<proto::ServerLiveRequest>,
    ) -> Reply<proto::ServerLiveResponse> {
        answer(&self.app, request, |_, _| async { Ok(proto::ServerLiveResponse { live: true }) }).await
    }

    async fn server_ready(
        &self,
        request: tonic::Request<proto::ServerReadyRequest>,
    ) -> Reply<proto::ServerReadyResponse> {
        let ready = !self.shutdown.is_draining();
        answer(&self.app, request, |_, _| async move { Ok(proto::ServerReadyResponse { ready }) }).await
    }

    async fn model_ready(
        &self,
        request: tonic::Request<proto::ModelReadyRequest>,
    ) -> Reply<proto::ModelReadyResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = model_name(&asked.name, "name")?;
            let ready = match app.inference().served_model(&camera, version(&asked.version)).await {
                Ok(_) => true,
                Err(error) if error.kind() == ErrorKind::NoModel => false,
                Err(error) => return Err(error),
            };
            Ok(proto::ModelReadyResponse { ready })
        })
        .await
    }

    async fn server_metadata(
        &self,
        request: tonic::Request<proto::ServerMetadataRequest>,
    ) -> Reply<proto::ServerMetadataResponse> {
        answer(&self.app, request, |_, _| async {
            Ok(proto::ServerMetadataResponse {
                name: env!("CARGO_PKG_NAME").to_owned(),
                version: env!("CARGO_PKG_VERSION").to_owned(),
                extensions: Vec::new(),
            })
        })
        .await
    }

    async fn model_metadata(
        &self,
        request: tonic::Request<proto::ModelMetadataRequest>,
    ) -> Reply<proto::ModelMetadataResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = model_name(&asked.name, "name")?;
            let (_, version) = app.inference().served_model(&camera, version(&asked.version)).await?;
            let tensor = |name: &str, columns: usize| TensorMetadata {
                name: name.to_owned(),
                datatype: FP64.to_owned(),
                shape: vec![ANY, columns as i64],
            };
            Ok(proto::ModelMetadataResponse {
                name: asked.name,
                versions: vec![version.to_string()],
                platform: env!("CARGO_PKG_NAME").to_owned(),
                inputs: vec![tensor(BOXES, BOX_COLUMNS)],
                outputs: OutputTensor::ALL.map(|output| tensor(output.name(), output.columns())).to_vec(),
            })
        })
        .await
    }

    async fn model_infer(
        &self,
        request: tonic::Request<proto::ModelInferRequest>,
    ) -> Reply<proto::ModelInferResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = model_name(&asked.model_name, "model_name")?;
            let outputs = OutputTensor::named(asked.outputs.iter().map(|output| output.name.as_str()))?;
            let [input] = &asked.inputs[..] else {
                return Err(Error::invalid("inputs", format!("must be one tensor, `{BOXES}`")));
            };
            let boxes = boxes(input, &asked.raw_input_contents)?;
            let inferred =
                app.inference().infer(&camera, version(&asked.model_version), &boxes, &outputs).await?;
            Ok(response(asked, inferred, boxes.len()))
        })
        .await
    }
}

/// The camera that a request names as its model.
fn model_name(name: &str, field: &str) -> Result<CameraId> {
    let name = required(Some(name).filter(|name| !name.is_empty()), field)?;
    CameraId::new(name)
        .map_err(|_| Error::refused(ErrorKind::CameraNotFound, "there is no camera of that name"))
}

fn version(version: &str) -> Option<&str> {
    Some(version).filter(|version| !version.is_empty())
}

/// The rows of the input tensor.
fn boxes(input: &InferInputTensor, raw: &[bytes::Bytes]) -> Result<Vec<[f64; BOX_COLUMNS]>> {
    if input.name != BOXES {
        return Err(Error::invalid("inputs[0].name", format!("must be {BOXES}")));
    }
    let contents = input.contents.as_ref();
    let numbers: Vec<f64> = match (input.datatype.as_str(), raw) {
        (FP64, []) => contents.map(|contents| contents.fp64_contents.clone()).unwrap_or_default(),
        (FP32, []) => contents
            .map(|contents| contents.fp32_contents.iter().copied().map(f64::from).collect())
            .unwrap_or_default(),
        (FP64, [raw]) => chunks(raw, f64::from_le_bytes)?,
        (FP32, [raw]) => chunks(raw, |bytes| f64::from(f32::from_le_bytes(bytes)))?,
        (FP64 | FP32, _) => {
            return Err(Error::invalid("raw_input_contents", "must be one per input, or none"));
        }
        _ => return Err(Error::invalid("inputs[0].datatype", "must be FP64 or FP32")),
    };
    let (rows, rest) = numbers.as_chunks::<BOX_COLUMNS>();
    let expected = [rows.len() as i64, BOX_COLUMNS as i64];
    if !rest.is_empty() || input.shape != expected {
        let message = format!(
            "must be [N, {BOX_COLUMNS}] with as many numbers as the tensor has: it has {}",
            numbers.len()
        );
        return Err(Error::invalid("inputs[0].shape", message));
    }
    Ok(rows.to_vec())
}

fn chunks<const N: usize>(raw: &[u8], number: impl Fn([u8; N]) -> f64) -> Result<Vec<f64>> {
    let (chunks, rest) = raw.as_chunks::<N>();
    if !rest.is_empty() {
        return Err(Error::invalid("raw_input_contents[0]", "is cut off within a number"));
    }
    Ok(chunks.iter().copied().map(number).collect())
}

fn response(asked: proto::ModelInferRequest, inferred: Inferred, rows: usize) -> proto::ModelInferResponse {
    let is_raw = !asked.raw_input_contents.is_empty();
    let (mut outputs, mut raw_output_contents) = (Vec::new(), Vec::new());
    for (output, numbers) in inferred.outputs {
        let contents = if is_raw {
            raw_output_contents
                .push(numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into());
            None
        } else {
            Some(proto::InferTensorContents { fp64_contents: numbers, ..Default::default() })
        };
        outputs.push(InferOutputTensor {
            name: output.name().to_owned(),
            datatype: FP64.to_owned(),
            shape: vec![rows as i64, output.columns() as i64],
            parameters: Default::default(),
            contents,
        });
    }
    proto::ModelInferResponse {
        model_name: asked.model_name,
        model_version: inferred.version.to_string(),
        id: asked.id,
        parameters: Default::default(),
        outputs,
        raw_output_contents,
    }
}
