//! A model as an ONNX graph: from boxes to positions with their error, scalers inside, for runtimes other than this
//! service.
//!
//! The graph computes in float64 what [`Regressor::regress`] does for a box alone, without a fix and without the
//! earlier boxes of its target. Input and outputs are those of the inference protocol (`app::inference`), and the
//! position in metres besides. ONNX has no pre- or post-processing to agree upon: pixels go in, metres come out.
//!
//! The files in the order of their layers: `messages`, `expression`, `boxes`, `network`, the error model, `answer`, the
//! encoders of the recipes (`recipes/*/onnx.rs`), this one.

pub(crate) mod answer;
pub(crate) mod boxes;
mod error_model;
pub(crate) mod expression;
mod messages;
pub(crate) mod network;
pub(crate) mod plane;
mod scene;

use bytes::Bytes;
use prost::Message as _;

use self::answer::{Answer, GraphContext};
use self::boxes::{BOXES, Boxes};
use self::expression::Graph;
use self::messages::{
    DOUBLE, DimensionProto, ModelProto, OperatorSetIdProto, StringStringEntryProto, TensorShapeProto,
    TensorTypeProto, TypeProto, ValueInfoProto,
};
use super::artifact::Artifact;
use super::regressor::{Regressor, VARIANCE_RANGE_M2};
use crate::domain::{ModelMetadata, Result};

/// Version of the file's structure: the newest that runtimes of 2023 read.
const IR_VERSION: i64 = 8;
/// Version of the operators.
const OPERATOR_SET: i64 = 18;
/// Name of the extent that is the number of boxes.
const BATCH: &str = "boxes_in_batch";

/// Outputs with the number of their columns.
const OUTPUTS: [(&str, i64, &str); 5] = [
    (
        "position_m",
        2,
        "metres east and north of the origin in the metadata, in the plane tangent to WGS 84 there",
    ),
    ("position_deg", 2, "longitude and latitude, WGS 84 degrees"),
    (
        "covariance_m2",
        3,
        "variance along east, along north, and covariance of both, of the normal distribution with the radius r95_m",
    ),
    ("r95_m", 1, "radius about the position that holds the true one with 95 % probability"),
    ("outside_training", 1, "1 where the box is unlike those of the training samples, else 0"),
];

impl Artifact {
    /// The model as an ONNX file. The same model gives the same bytes.
    ///
    /// # Errors
    /// As [`Artifact::load`].
    pub fn to_onnx(&self) -> Result<Bytes> {
        let regressor = self.load()?;
        let graph = Graph::default();
        put_outputs(&regressor, &graph);
        let mut graph = graph.finish(&OUTPUTS.map(|(name, ..)| name));
        "boxes_to_positions".clone_into(&mut graph.name);
        graph.input = vec![value_info(BOXES, 4, "left, top, width and height of each box, px")];
        graph.output = OUTPUTS.iter().map(|(name, columns, text)| value_info(name, *columns, text)).collect();
        let model = ModelProto {
            ir_version: IR_VERSION,
            producer_name: "sightfix".to_owned(),
            producer_version: env!("CARGO_PKG_VERSION").to_owned(),
            doc_string: "Positions on the ground from the bounding boxes of one fixed camera".to_owned(),
            graph: Some(graph),
            opset_import: vec![OperatorSetIdProto { domain: String::new(), version: OPERATOR_SET }],
            metadata_props: metadata_props(&self.metadata, &regressor),
        };
        Ok(model.encode_to_vec().into())
    }
}

fn put_outputs(regressor: &Regressor, graph: &Graph) {
    let boxes = Boxes::of(graph);
    let lookup = error_model::look_up(&regressor.error_model.coverage, boxes);
    let context = GraphContext {
        plane: regressor.plane(),
        error_model: &regressor.error_model,
        r95_scale: regressor.r95_scale,
        boxes,
        lookup,
    };
    let Answer { position_m, position_deg, covariance_m2, r95_scale, reconstruction_error } =
        regressor.encoder.express(&context);
    let (position_m, position_deg, covariance_m2) = match &regressor.scene {
        Some(scene) => {
            let ratio = lookup.extrapolation_ratio;
            let (position_m, covariance_m2) =
                scene::limit(scene, position_m, covariance_m2, ratio, r95_scale);
            (position_m, plane::to_position(regressor.plane(), position_m), covariance_m2)
        }
        None => (position_m, position_deg, covariance_m2),
    };
    let [east_m2, cross_m2, north_m2] = covariance_m2;
    let variance_m2 = (east_m2 + north_m2) * 0.5;
    let limited_m2 = variance_m2.clamp(VARIANCE_RANGE_M2[0], VARIANCE_RANGE_M2[1]);
    let added_m2 = limited_m2 - variance_m2;
    let covariance_m2 = [east_m2 + added_m2, cross_m2, north_m2 + added_m2];
    let r95_m = r95_scale * limited_m2.sqrt();
    let normal_scale = (r95_m / plane::r95_m(covariance_m2)).square();
    let [east_m2, cross_m2, north_m2] = covariance_m2.map(|element| element * normal_scale);
    let [is_far, is_unlike] =
        error_model::is_outside_training(&regressor.error_model, &lookup, reconstruction_error);
    let [longitude_deg, latitude_deg] = position_deg;
    let values = [
        graph.columns(&position_m),
        graph.columns(&[plane::wrapped(longitude_deg), latitude_deg]),
        graph.columns(&[east_m2, north_m2, cross_m2]),
        r95_m,
        is_far.choose(1.0, is_unlike.choose(1.0, 0.0)),
    ];
    for (value, (name, ..)) in values.into_iter().zip(OUTPUTS) {
        graph.output(value, name);
    }
}

/// A matrix of float64 with a row per box.
fn value_info(name: &str, columns: i64, text: &str) -> ValueInfoProto {
    let dim = vec![
        DimensionProto { dim_param: Some(BATCH.to_owned()), dim_value: None },
        DimensionProto { dim_value: Some(columns), dim_param: None },
    ];
    let tensor_type = TensorTypeProto { elem_type: DOUBLE, shape: Some(TensorShapeProto { dim }) };
    ValueInfoProto {
        name: name.to_owned(),
        r#type: Some(TypeProto { tensor_type: Some(tensor_type) }),
        doc_string: text.to_owned(),
    }
}

/// The facts that a user of the graph needs besides its inputs and outputs; all keys begin with `sightfix.`.
fn metadata_props(metadata: &ModelMetadata, regressor: &Regressor) -> Vec<StringStringEntryProto> {
    let origin = regressor.plane().origin();
    let mut entries = vec![
        ("recipe", metadata.recipe.clone()),
        ("origin_longitude_deg", origin.longitude_deg().to_string()),
        ("origin_latitude_deg", origin.latitude_deg().to_string()),
        ("datum", "WGS 84, height 0".to_owned()),
        ("input", "boxes: left, top, width, height in px, origin at the upper left of the image".to_owned()),
        ("training_rows_sha256", metadata.training_rows_sha256.clone()),
        ("e_gnss_m2", metadata.e_gnss_m2.to_string()),
    ];
    if let Some(size) = regressor.image_size() {
        entries.push(("image_width_px", size.width_px().to_string()));
        entries.push(("image_height_px", size.height_px().to_string()));
    }
    let entry = |(key, value)| StringStringEntryProto { key: format!("sightfix.{key}"), value };
    entries.into_iter().map(entry).collect()
}

#[cfg(test)]
mod tests;
