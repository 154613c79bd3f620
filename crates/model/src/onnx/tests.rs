//! Exported graphs are well formed. That they answer as the service does is proven with another runtime by
//! `.ci/onnx`.

use std::collections::HashSet;

use prost::Message as _;

use super::messages::{GraphProto, ModelProto};
use super::{BOXES, OUTPUTS};
use crate::domain::Recipe;
use crate::fit;
use crate::simulation::walk;
use crate::tests::{options, silent};

#[test]
fn every_recipe_exports_a_graph_in_order_with_all_outputs_and_its_origin() {
    let samples = walk(6, 40, 2.0, 2);
    for &recipe in Recipe::ALL {
        let artifact = fit(&samples, &options(recipe), &mut silent).expect("fits");
        let file = artifact.to_onnx().expect("a fitted model is exported");
        assert_eq!(artifact.to_onnx().expect("again"), file, "the same model gives the same bytes");
        let model = ModelProto::decode(file).expect("reads what it has written");
        let graph = model.graph.expect("a graph");
        check_order(&graph);
        let outputs: Vec<&str> = graph.output.iter().map(|output| output.name.as_str()).collect();
        assert_eq!(outputs, OUTPUTS.map(|(name, ..)| name));
        let origin = model.metadata_props.iter().find(|entry| entry.key == "sightfix.origin_latitude_deg");
        let origin_deg: f64 = origin.and_then(|entry| entry.value.parse().ok()).expect("an origin");
        assert_eq!(origin_deg.to_bits(), artifact.metadata.origin.latitude_deg.to_bits());
    }
}

/// Every input of a node has been computed before it, every name is given once, and every output is computed.
fn check_order(graph: &GraphProto) {
    let constants = graph.initializer.iter().map(|tensor| tensor.name.as_str());
    let mut known: HashSet<&str> = constants.chain([BOXES]).collect();
    assert_eq!(known.len(), graph.initializer.len() + 1, "constants have names of their own");
    for node in &graph.node {
        for input in &node.input {
            assert!(known.contains(input.as_str()), "{input} of {} is not known", node.op_type);
        }
        for output in &node.output {
            assert!(known.insert(output), "{output} is computed twice");
        }
    }
    assert!(graph.output.iter().all(|output| known.contains(output.name.as_str())));
}
