//! `/v2`: the Open Inference Protocol (KServe's V2). A model is a camera, a version one of its model versions.

use std::fmt;

use axum::extract::State;
use hyper::http::request::Parts;
use serde::de::{DeserializeSeed, IgnoredAny, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::value::RawValue;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::inference_body::InferenceBody;
use crate::app::{App, BOX_COLUMNS, BOXES, Inferred, OutputTensor};
use crate::domain::{CameraId, Error, ErrorKind, Result};
use crate::exchange::wire::parse_field;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{camera_of, path};
use crate::http::plumbing::problem::{ApiError, ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{json, json_of_about};

const FP64: &str = "FP64";
/// Any extent.
const ANY: i64 = -1;
/// Typical length of a number as JSON, to reserve memory.
const NUMBER_BYTES: usize = 20;

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(server_metadata))
        .routes(routes!(server_live))
        .routes(routes!(server_ready))
        .routes(routes!(model_metadata))
        .routes(routes!(model_version_metadata))
        .routes(routes!(model_ready))
        .routes(routes!(model_version_ready))
        .routes(routes!(infer))
        .routes(routes!(infer_version))
}

/// The model of a path.
struct ModelName {
    camera: CameraId,
    version: Option<String>,
}

#[derive(Deserialize)]
struct Segments {
    camera: String,
    version: Option<String>,
}

impl<S: Send + Sync> axum::extract::FromRequestParts<S> for ModelName {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> ApiResult<Self> {
        let Segments { camera, version } = path(parts, state).await?;
        Ok(Self { camera: camera_of(&camera)?, version })
    }
}

/// Name, version and extensions of the server.
#[derive(Serialize, ToSchema)]
struct ServerMetadata {
    /// Name of the server.
    name: &'static str,
    /// Version of the server.
    version: &'static str,
    /// Extensions of the protocol.
    extensions: [&'static str; 1],
}

/// States that the server is alive.
#[derive(Serialize, ToSchema)]
struct Live {
    /// True if the server is alive.
    live: bool,
}

/// The readiness of the server.
#[derive(Serialize, ToSchema)]
struct Ready {
    /// True if the server is ready for requests.
    ready: bool,
}

/// The readiness of a model.
#[derive(Serialize, ToSchema)]
struct ModelReady {
    /// The camera's id.
    name: String,
    /// True if the model is ready for requests.
    ready: bool,
}

/// Inputs and outputs of a model.
#[derive(Serialize, ToSchema)]
struct InferenceModelMetadata {
    /// The camera's id.
    name: String,
    /// Numbers of the versions that answer: the active one.
    versions: Vec<String>,
    /// Framework of the model.
    platform: &'static str,
    /// The input tensors.
    inputs: Vec<TensorMetadata>,
    /// The output tensors.
    outputs: Vec<TensorMetadata>,
}

/// Name, type and shape of a tensor.
#[derive(Serialize, ToSchema)]
struct TensorMetadata {
    /// Name of the tensor.
    name: &'static str,
    /// Type of its elements.
    datatype: &'static str,
    /// Its extents; -1 is any.
    shape: [i64; 2],
}

/// Asks for the positions of boxes.
#[derive(Deserialize, ToSchema)]
struct InferenceRequest<'r> {
    /// Returned in the answer.
    id: Option<String>,
    /// Parameters; none is used.
    #[schema(value_type = Option<Object>)]
    #[serde(rename = "parameters")]
    _parameters: Option<IgnoredAny>,
    /// One tensor, `boxes`: a row of left, top, width and height in pixels per box.
    #[serde(borrow)]
    inputs: Vec<InputTensor<'r>>,
    /// The outputs that are wanted; all if left out.
    #[serde(default)]
    outputs: Vec<RequestedOutput>,
}

/// An input tensor.
#[derive(Deserialize, ToSchema)]
struct InputTensor<'r> {
    /// `boxes`.
    #[schema(example = "boxes")]
    name: String,
    /// Its extents: the number of boxes, and 4.
    #[schema(example = json!([1, 4]))]
    shape: Vec<u64>,
    /// `FP64` or `FP32`.
    #[schema(example = "FP64")]
    datatype: String,
    /// Parameters.
    parameters: Option<TensorParameters>,
    /// Its elements row by row, as one array or as an array per row; left out where they come in binary.
    #[schema(value_type = Option<Vec<f64>>, example = json!([[475.0, 11.0, 28.0, 77.0]]))]
    #[serde(borrow)]
    data: Option<&'r RawValue>,
}

/// Parameters of an input tensor; others are not used.
#[derive(Deserialize, ToSchema)]
struct TensorParameters {
    /// Bytes of its elements, which come after the JSON, little-endian and row by row; the header
    /// `inference-header-content-length` has the bytes of the JSON.
    binary_data_size: Option<usize>,
}

impl InputTensor<'_> {
    /// Its elements; those of at most this number of boxes are kept.
    ///
    /// # Errors
    /// `InvalidArgument` naming the tensor's data.
    fn elements(&self, binary: &[u8], most_boxes: usize) -> Result<TensorData> {
        let size = self.parameters.as_ref().and_then(|parameters| parameters.binary_data_size);
        match (self.data, size) {
            (Some(json), None) => TensorData::read(json, most_boxes),
            (None, Some(size)) if size == binary.len() => {
                TensorData::read_binary(binary, &self.datatype, most_boxes)
            }
            (None, Some(size)) => Err(Error::invalid(
                "inputs[0].parameters.binary_data_size",
                format!("is {size}, but {} bytes come after the JSON", binary.len()),
            )),
            _ => Err(Error::invalid("inputs[0].data", "give either data or parameters.binary_data_size")),
        }
    }
}

/// Elements of a tensor, row by row.
struct TensorData {
    numbers: Vec<f64>,
    is_of_rows: bool,
    /// Number of elements; at most `most` are kept.
    count: usize,
    most: usize,
}

impl TensorData {
    /// The elements of a tensor; those of at most this number of boxes are kept.
    ///
    /// # Errors
    /// `InvalidArgument` naming the tensor's data.
    fn read(json: &RawValue, most_boxes: usize) -> Result<Self> {
        let most = most_boxes.saturating_mul(BOX_COLUMNS);
        let data = Self { numbers: Vec::new(), is_of_rows: false, count: 0, most };
        parse_field("inputs[0].data", json, TensorVisitor(data))
    }

    /// The same of little-endian numbers of a type.
    fn read_binary(bytes: &[u8], datatype: &str, most_boxes: usize) -> Result<Self> {
        let most = most_boxes.saturating_mul(BOX_COLUMNS);
        let mut data = Self { numbers: Vec::new(), is_of_rows: false, count: 0, most };
        let rest = if datatype == FP64 {
            let (numbers, rest) = bytes.as_chunks::<8>();
            numbers.iter().for_each(|number| data.add(f64::from_le_bytes(*number)));
            rest
        } else {
            let (numbers, rest) = bytes.as_chunks::<4>();
            numbers.iter().for_each(|number| data.add(f32::from_le_bytes(*number).into()));
            rest
        };
        if rest.is_empty() {
            return Ok(data);
        }
        let message = format!("has {} bytes, which are no whole numbers", bytes.len());
        Err(Error::invalid("inputs[0].parameters.binary_data_size", message))
    }

    fn add(&mut self, number: f64) {
        self.count += 1;
        if self.count <= self.most {
            self.numbers.push(number);
        }
    }
}

struct TensorVisitor(TensorData);

impl<'de> DeserializeSeed<'de> for TensorVisitor {
    type Value = TensorData;

    fn deserialize<D: Deserializer<'de>>(self, source: D) -> std::result::Result<TensorData, D::Error> {
        source.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for TensorVisitor {
    type Value = TensorData;

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("an array of numbers, or of rows")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> std::result::Result<TensorData, A::Error> {
        let Self(mut data) = self;
        while items.next_element_seed(TensorItem(&mut data))?.is_some() {}
        Ok(data)
    }
}

/// A number, or a row of them, which is added to the others.
struct TensorItem<'t>(&'t mut TensorData);

impl TensorItem<'_> {
    fn add<E: serde::de::Error>(self, number: f64) -> std::result::Result<(), E> {
        if self.0.is_of_rows {
            return Err(E::custom(format!("must have {BOX_COLUMNS} numbers")));
        }
        self.0.add(number);
        Ok(())
    }
}

impl<'de> DeserializeSeed<'de> for TensorItem<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, source: D) -> std::result::Result<(), D::Error> {
        source.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for TensorItem<'_> {
    type Value = ();

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "a number, or a row of {BOX_COLUMNS}")
    }

    fn visit_f64<E: serde::de::Error>(self, number: f64) -> std::result::Result<(), E> {
        self.add(number)
    }

    fn visit_i64<E: serde::de::Error>(self, number: i64) -> std::result::Result<(), E> {
        self.add(number as f64)
    }

    fn visit_u64<E: serde::de::Error>(self, number: u64) -> std::result::Result<(), E> {
        self.add(number as f64)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> std::result::Result<(), A::Error> {
        let Self(data) = self;
        let begin = data.count;
        let is_first = begin == 0;
        while let Some(number) = items.next_element()? {
            data.add(number);
        }
        if data.count != begin + BOX_COLUMNS || !(data.is_of_rows || is_first) {
            return Err(serde::de::Error::custom(format!("must have {BOX_COLUMNS} numbers")));
        }
        data.is_of_rows = true;
        Ok(())
    }
}

/// An output that is asked for.
#[derive(Deserialize, ToSchema)]
struct RequestedOutput {
    /// Name of the tensor.
    #[schema(example = "position_deg")]
    name: String,
    /// Parameters; none is used.
    #[schema(value_type = Option<Object>)]
    #[serde(rename = "parameters")]
    _parameters: Option<IgnoredAny>,
}

/// Positions of boxes.
#[derive(Serialize, ToSchema)]
struct InferenceResponse {
    /// The camera's id.
    model_name: String,
    /// Number of the model version that answered.
    model_version: String,
    /// The id of the request, if it had one.
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<String>,
    /// The output tensors.
    outputs: Vec<OutputData>,
}

/// An output tensor.
#[derive(Serialize, ToSchema)]
struct OutputData {
    /// Name of the tensor.
    name: &'static str,
    /// Extents of the tensor.
    shape: [usize; 2],
    /// Type of its elements.
    datatype: &'static str,
    /// Its elements, row by row.
    data: Vec<f64>,
}

/// Read what the inference server is
#[utoipa::path(
    get, path = "/v2", tag = "inference",
    responses((status = 200, description = "Name and version", body = ServerMetadata))
)]
async fn server_metadata() -> ApiResult {
    let metadata = ServerMetadata {
        name: env!("CARGO_PKG_NAME"),
        version: env!("CARGO_PKG_VERSION"),
        extensions: ["binary_tensor_data"],
    };
    Ok(json(&metadata)?)
}

/// Check that the inference server is alive
#[utoipa::path(
    get, path = "/v2/health/live", tag = "inference",
    responses((status = 200, description = "It is", body = Live))
)]
async fn server_live() -> ApiResult {
    Ok(json(&Live { live: true })?)
}

/// Check that the inference server is ready
#[utoipa::path(
    get, path = "/v2/health/ready", tag = "inference",
    responses(
        (status = 200, description = "It can", body = Ready),
        (status = 503, description = "It is shutting down", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn server_ready(State(rest): State<Rest>) -> ApiResult {
    if rest.shutdown.is_draining() {
        return Err(Error::refused(ErrorKind::ShuttingDown, "the server is ending").into());
    }
    Ok(json(&Ready { ready: true })?)
}

/// Read what a camera's active model takes and gives
#[utoipa::path(
    get, path = "/v2/models/{camera}", tag = "inference",
    params(("camera" = String, Path, description = "The camera's id")),
    responses(
        (status = 200, description = "Its tensors", body = InferenceModelMetadata),
        (status = 409, description = "The camera has no active model", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn model_metadata(CallerApp(app): CallerApp, model: ModelName) -> ApiResult {
    metadata(&app, model).await
}

/// Read what a model version takes and gives
#[utoipa::path(
    get, path = "/v2/models/{camera}/versions/{version}", tag = "inference",
    params(("camera" = String, Path, description = "The camera's id"), ("version" = String, Path, description = "The version's number")),
    responses(
        (status = 200, description = "Its tensors", body = InferenceModelMetadata),
        (status = 404, description = "The version does not answer", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The camera has no active model", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn model_version_metadata(CallerApp(app): CallerApp, model: ModelName) -> ApiResult {
    metadata(&app, model).await
}

async fn metadata(app: &App, model: ModelName) -> ApiResult {
    let (_, version) = app.inference().served_model(&model.camera, model.version.as_deref()).await?;
    let tensor = |name, columns: usize| TensorMetadata { name, datatype: FP64, shape: [ANY, columns as i64] };
    Ok(json(&InferenceModelMetadata {
        name: model.camera.to_string(),
        versions: vec![version.to_string()],
        platform: env!("CARGO_PKG_NAME"),
        inputs: vec![tensor(BOXES, BOX_COLUMNS)],
        outputs: OutputTensor::ALL.map(|output| tensor(output.name(), output.columns())).into(),
    })?)
}

/// Check that a camera's active model is ready
#[utoipa::path(
    get, path = "/v2/models/{camera}/ready", tag = "inference",
    params(("camera" = String, Path, description = "The camera's id")),
    responses(
        (status = 200, description = "It can", body = ModelReady),
        (status = 409, description = "The camera has no active model", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn model_ready(CallerApp(app): CallerApp, model: ModelName) -> ApiResult {
    ready(&app, model).await
}

/// Check that a model version is ready
#[utoipa::path(
    get, path = "/v2/models/{camera}/versions/{version}/ready", tag = "inference",
    params(("camera" = String, Path, description = "The camera's id"), ("version" = String, Path, description = "The version's number")),
    responses(
        (status = 200, description = "It can", body = ModelReady),
        (status = 404, description = "The version does not answer", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The camera has no active model", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn model_version_ready(CallerApp(app): CallerApp, model: ModelName) -> ApiResult {
    ready(&app, model).await
}

async fn ready(app: &App, model: ModelName) -> ApiResult {
    app.inference().served_model(&model.camera, model.version.as_deref()).await?;
    Ok(json(&ModelReady { name: model.camera.to_string(), ready: true })?)
}

/// Infer positions of boxes by a camera's active model
///
/// The input `boxes` has a row of left, top, width and height in pixels per box. The outputs are `position_deg`
/// (longitude, latitude), `covariance_m2` (east, north, east with north), `r95_m`, and `outside_training`, which is
/// 1 for a box unlike those of the training samples.
#[utoipa::path(
    post, path = "/v2/models/{camera}/infer", tag = "inference",
    params(("camera" = String, Path, description = "The camera's id")),
    request_body = InferenceRequest,
    responses(
        (status = 200, description = "The output tensors", body = InferenceResponse),
        (status = 409, description = "The camera has no active model", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn infer(CallerApp(app): CallerApp, model: ModelName, body: InferenceBody) -> ApiResult {
    inferred(&app, model, &body).await
}

/// Infer positions of boxes by a model version
#[utoipa::path(
    post, path = "/v2/models/{camera}/versions/{version}/infer", tag = "inference",
    params(("camera" = String, Path, description = "The camera's id"), ("version" = String, Path, description = "The version's number")),
    request_body = InferenceRequest,
    responses(
        (status = 200, description = "The output tensors", body = InferenceResponse),
        (status = 404, description = "The version does not answer", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The camera has no active model", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn infer_version(CallerApp(app): CallerApp, model: ModelName, body: InferenceBody) -> ApiResult {
    inferred(&app, model, &body).await
}

async fn inferred(app: &App, model: ModelName, body: &InferenceBody) -> ApiResult {
    let request: InferenceRequest<'_> = body.read()?;
    let outputs = OutputTensor::named(request.outputs.iter().map(|output| output.name.as_str()))?;
    let [input] = &request.inputs[..] else {
        return Err(Error::invalid("inputs", format!("must be one tensor, `{BOXES}`")).into());
    };
    let data = input.elements(&body.elements, app.limits.batch_observations)?;
    app.limits.check_batch(data.count.div_ceil(BOX_COLUMNS)).map_err(|error| error.at(BOXES))?;
    let boxes = boxes(input, &data.numbers)?;
    let answer = app.inference().infer(&model.camera, model.version.as_deref(), boxes, &outputs).await?;
    let Inferred { version, outputs } = answer;
    let numbers: usize = outputs.iter().map(|(_, numbers)| numbers.len()).sum();
    let outputs = outputs.into_iter().map(|(output, data)| OutputData {
        name: output.name(),
        shape: [boxes.len(), output.columns()],
        datatype: FP64,
        data,
    });
    let response = InferenceResponse {
        model_name: model.camera.to_string(),
        model_version: version.to_string(),
        id: request.id,
        outputs: outputs.collect(),
    };
    Ok(json_of_about(&response, 512 + NUMBER_BYTES * numbers)?)
}

/// The rows of the input tensor.
fn boxes<'n>(input: &InputTensor<'_>, numbers: &'n [f64]) -> Result<&'n [[f64; BOX_COLUMNS]]> {
    if input.name != BOXES {
        return Err(Error::invalid("inputs[0].name", format!("must be {BOXES}")));
    }
    if !matches!(input.datatype.as_str(), FP64 | "FP32") {
        return Err(Error::invalid("inputs[0].datatype", "must be FP64 or FP32"));
    }
    let (rows, rest) = numbers.as_chunks::<BOX_COLUMNS>();
    if !rest.is_empty() || input.shape != [rows.len() as u64, BOX_COLUMNS as u64] {
        let message = format!(
            "must be [N, {BOX_COLUMNS}] with as many numbers as the tensor has: it has {}",
            numbers.len()
        );
        return Err(Error::invalid("inputs[0].shape", message));
    }
    Ok(rows)
}
