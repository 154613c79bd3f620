//! The Open Inference Protocol over REST and gRPC, on the model that fusions answer by.

use serde_json::{Value, json};
use sightfix::grpc::inference_proto as proto;
use sightfix::grpc::inference_proto::grpc_inference_service_client::GrpcInferenceServiceClient;
use sightfix::grpc::inference_proto::model_infer_request::{InferInputTensor, InferRequestedOutputTensor};
use tonic::Code;

use crate::harness::{TestServer, data_folder};

const BOXES: [[f64; 4]; 3] =
    [[300.0, 300.0, 40.0, 110.0], [420.5, 310.25, 38.0, 105.0], [610.0, 400.0, 60.0, 160.0]];

/// A server whose camera `square` has the demonstration's model.
async fn served() -> (TestServer, tempfile::TempDir) {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    server.post("/v1/cameras", &json!({"id": "square"})).await.expect(201);
    server.post("/v1/cameras", &json!({"id": "untrained"})).await.expect(201);
    let model = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors"));
    let headers = [("content-type", "application/octet-stream")];
    let imported =
        server.send("POST", "/v1/cameras/square/models", &headers, model.expect("committed")).await;
    let number = imported.expect(201).json()["number"].clone();
    let active = json!({"number": number}).to_string();
    let headers = [("content-type", "application/json")];
    server.send("PUT", "/v1/cameras/square/active-model", &headers, active).await.expect(200);
    (server, folder)
}

fn rest_request(data: Value) -> Value {
    json!({"id": "7", "inputs": [{"name": "boxes", "shape": [BOXES.len(), 4], "datatype": "FP64", "data": data}]})
}

fn tensor(answer: &Value, name: &str) -> Vec<f64> {
    let outputs = answer["outputs"].as_array().expect("outputs");
    let output = outputs.iter().find(|output| output["name"] == name).expect("the output");
    output["data"]
        .as_array()
        .expect("numbers")
        .iter()
        .map(|number| number.as_f64().expect("a number"))
        .collect()
}

#[tokio::test]
async fn rest_answers_as_fusions_do() {
    let (server, _folder) = served().await;
    let answer = server.post("/v2/models/square/infer", &rest_request(json!(BOXES))).await.expect(200).json();
    assert_eq!(
        (&answer["model_name"], &answer["model_version"], &answer["id"]),
        (&json!("square"), &json!("1"), &json!("7"))
    );
    let flat = server.post("/v2/models/square/versions/1/infer", &rest_request(json!(BOXES.concat()))).await;
    assert_eq!(flat.expect(200).json(), answer, "flat or nested, with or without a version");

    let observations: Vec<Value> = BOXES
        .iter()
        .map(|[left, top, width, height]| {
            json!({"time": "2026-01-01T00:00:00Z", "bounding_box":
                {"left_px": left, "top_px": top, "width_px": width, "height_px": height}})
        })
        .collect();
    let fused = server.post("/v1/cameras/square/fusions", &json!({"observations": observations})).await;
    let fused = fused.expect(200).json();
    let (positions, radii, covariances) =
        (tensor(&answer, "position_deg"), tensor(&answer, "r95_m"), tensor(&answer, "covariance_m2"));
    for (at, item) in fused["items"].as_array().expect("items").iter().enumerate() {
        assert_eq!(item["fused"]["longitude_deg"], positions[2 * at]);
        assert_eq!(item["fused"]["latitude_deg"], positions[2 * at + 1]);
        assert!((item["r95_m"].as_f64().expect("a radius") - radii[at]).abs() < 1e-9 * radii[at]);
        let stated = item["covariance"]["east_m2"].as_f64().expect("a variance");
        assert!((stated - covariances[3 * at]).abs() < 1e-9 * stated, "{stated} {covariances:?}");
    }

    let one = json!({"inputs": rest_request(json!(BOXES))["inputs"], "outputs": [{"name": "r95_m"}]});
    let one = server.post("/v2/models/square/infer", &one).await.expect(200).json();
    assert_eq!(one["outputs"].as_array().map(Vec::len), Some(1));
    assert_eq!(tensor(&one, "r95_m"), radii);

    let metadata = server.get("/v2/models/square").await.expect(200).json();
    assert_eq!(metadata["inputs"][0], json!({"name": "boxes", "datatype": "FP64", "shape": [-1, 4]}));
    assert_eq!(metadata["versions"], json!(["1"]));
    assert_eq!(server.get("/v2").await.expect(200).json()["name"], "sightfix");
    assert_eq!(server.get("/v2/health/live").await.expect(200).json(), json!({"live": true}));
    assert_eq!(server.get("/v2/health/ready").await.expect(200).json(), json!({"ready": true}));
    let ready = server.get("/v2/models/square/versions/1/ready").await.expect(200).json();
    assert_eq!(ready, json!({"name": "square", "ready": true}));
}

#[tokio::test]
async fn rest_refuses_what_is_no_tensor_of_boxes() {
    let (server, _folder) = served().await;
    let with = |field: &str, value: Value| {
        let mut request = rest_request(json!(BOXES));
        request["inputs"][0][field] = value;
        request
    };
    let bad_box = json!([[0.0, 0.0, -1.0, 5.0], BOXES[1], BOXES[2]]);
    for (request, field) in [
        (with("name", json!("images")), "inputs[0].name"),
        (with("datatype", json!("INT8")), "inputs[0].datatype"),
        (with("shape", json!([3, 5])), "inputs[0].shape"),
        (with("shape", json!([4, 4])), "inputs[0].shape"),
        (with("data", json!([[1.0], [2.0], [3.0]])), "inputs[0].data[0]"),
        (with("data", bad_box), "boxes[0].width_px"),
        (json!({"inputs": []}), "inputs"),
        (
            json!({"inputs": rest_request(json!(BOXES))["inputs"], "outputs": [{"name": "x"}]}),
            "outputs[0].name",
        ),
    ] {
        let problem = server.post("/v2/models/square/infer", &request).await.expect(422).json();
        assert_eq!(problem["violations"][0]["field"], field, "{problem}");
        assert_eq!(problem["error"], problem["detail"], "clients of the protocol read `error`");
    }
    // More boxes than a request may have are counted, not kept.
    let many = with("data", json!(vec![1.0; 4_004]));
    let problem = server.post("/v2/models/square/infer", &many).await.expect(413).json();
    assert_eq!(problem["violations"][0]["field"], "boxes", "{problem}");
    for (path, status) in [
        ("/v2/models/none", 404),
        ("/v2/models/square/versions/2", 404),
        ("/v2/models/untrained", 409),
        ("/v2/models/untrained/ready", 409),
    ] {
        let problem = server.get(path).await.expect(status).json();
        assert!(problem["error"].is_string(), "{problem}");
    }
}

#[tokio::test]
async fn elements_may_come_in_binary_after_the_json() {
    let (server, _folder) = served().await;
    let path = "/v2/models/square/infer";
    let expected = server.post(path, &rest_request(json!(BOXES))).await.expect(200).json();
    let elements: Vec<u8> = BOXES.concat().iter().flat_map(|number| number.to_le_bytes()).collect();
    let request = |size: usize| {
        let input = json!({"name": "boxes", "shape": [BOXES.len(), 4], "datatype": "FP64",
            "parameters": {"binary_data_size": size}});
        json!({"id": "7", "inputs": [input], "parameters": {"binary_data_output": true}}).to_string()
    };
    let send = |json: String, length: usize, elements: &[u8]| {
        let body = [json.as_bytes(), elements].concat();
        let length = length.to_string();
        let server = &server;
        // Without a type, as Triton's client sends it.
        async move { server.send("POST", path, &[("inference-header-content-length", &length)], body).await }
    };
    let json = request(elements.len());
    let answer = send(json.clone(), json.len(), &elements).await.expect(200).json();
    assert_eq!(answer, expected);
    let short = request(elements.len() - 4);
    for (json, length, elements, field) in [
        (json.clone(), json.len(), &elements[1..], "inputs[0].parameters.binary_data_size"),
        (short.clone(), short.len(), &elements[4..], "inputs[0].parameters.binary_data_size"),
        (json.clone(), json.len() + elements.len() + 1, &elements[..], "inference-header-content-length"),
        (
            rest_request(Value::Null).to_string(),
            rest_request(Value::Null).to_string().len(),
            &elements[..0],
            "inputs[0].data",
        ),
    ] {
        let refused = send(json, length, elements).await.expect(422).json();
        assert_eq!(refused["violations"][0]["field"], field, "{refused}");
    }
}

#[tokio::test]
async fn grpc_answers_as_rest_does() {
    let (server, _folder) = served().await;
    let rest = server.post("/v2/models/square/infer", &rest_request(json!(BOXES))).await.expect(200).json();
    let mut client = GrpcInferenceServiceClient::new(server.channel().await);
    let tensor_of = |contents| InferInputTensor {
        name: "boxes".to_owned(),
        datatype: "FP64".to_owned(),
        shape: vec![BOXES.len() as i64, 4],
        parameters: Default::default(),
        contents,
    };
    let contents = proto::InferTensorContents { fp64_contents: BOXES.concat(), ..Default::default() };
    let request = proto::ModelInferRequest {
        model_name: "square".to_owned(),
        id: "7".to_owned(),
        inputs: vec![tensor_of(Some(contents))],
        ..Default::default()
    };
    let typed = client.model_infer(request.clone()).await.expect("answered").into_inner();
    assert_eq!((typed.model_version.as_str(), typed.id.as_str()), ("1", "7"));
    for output in &typed.outputs {
        assert_eq!(output.contents.as_ref().expect("typed").fp64_contents, tensor(&rest, &output.name));
    }
    let raw = proto::ModelInferRequest {
        inputs: vec![tensor_of(None)],
        raw_input_contents: vec![
            BOXES.concat().iter().flat_map(|side| side.to_le_bytes()).collect::<Vec<_>>().into(),
        ],
        outputs: vec![InferRequestedOutputTensor {
            name: "position_deg".to_owned(),
            parameters: Default::default(),
        }],
        ..request.clone()
    };
    let raw = client.model_infer(raw).await.expect("answered").into_inner();
    let numbers: Vec<f64> = raw.raw_output_contents[0]
        .chunks_exact(8)
        .map(|bytes| f64::from_le_bytes(bytes.try_into().expect("eight")))
        .collect();
    assert_eq!(numbers, tensor(&rest, "position_deg"), "raw in, raw out");

    let ready = |name: &str, version: &str| {
        let request = proto::ModelReadyRequest { name: name.to_owned(), version: version.to_owned() };
        let mut client = client.clone();
        async move { client.model_ready(request).await.map(|answer| answer.into_inner().ready) }
    };
    assert!(ready("square", "").await.expect("answered"));
    assert!(!ready("untrained", "").await.expect("answered"));
    assert_eq!(ready("square", "9").await.expect_err("not active").code(), Code::NotFound);
    assert_eq!(ready("none", "").await.expect_err("unknown").code(), Code::NotFound);
    let empty = proto::ModelInferRequest { inputs: Vec::new(), ..request };
    assert_eq!(client.model_infer(empty).await.expect_err("nothing").code(), Code::InvalidArgument);
    let metadata = proto::ModelMetadataRequest { name: "square".to_owned(), version: String::new() };
    let metadata = client.model_metadata(metadata).await.expect("answered").into_inner();
    assert_eq!(metadata.outputs.len(), 4);
    assert!(client.server_live(proto::ServerLiveRequest {}).await.expect("answered").into_inner().live);
}
