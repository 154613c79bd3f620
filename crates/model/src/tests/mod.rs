//! The public interface of the module, and the explicit kernels against candle's own.

mod behaviour;
mod site;

use std::ops::ControlFlow;

use candle_core::{DType, Device, Tensor, Var};
use candle_nn::{Linear, Module};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::domain::{GnssError, Recipe, SigmaM};
use crate::network::kernel::{BatchLoss, Scratch};
use crate::network::{Activation, LossWeights, Net, NetShape, TrainingSet};
use crate::simulation::walk;
use crate::{Artifact, FitError, FitEvent, FitOptions, fit};

/// The same network built of candle's layers over the flat parameters.
fn candle_layers(shape: &NetShape, flat: &Tensor) -> Vec<Linear> {
    shape
        .layers()
        .map(|layer| {
            let weights = flat.narrow(0, layer.weights, layer.inputs * layer.outputs).expect("weights");
            let weights = weights.reshape((layer.outputs, layer.inputs)).expect("matrix");
            let biases = flat.narrow(0, layer.biases, layer.outputs).expect("biases");
            Linear::new(weights, Some(biases))
        })
        .collect()
}

/// Outputs of the bottleneck and of the last layer, for rows of inputs.
fn candle_forward(shape: &NetShape, flat: &Tensor, inputs: &Tensor) -> (Tensor, Tensor) {
    let mut units = inputs.clone();
    let mut bottleneck = None;
    for (index, (linear, layer)) in candle_layers(shape, flat).iter().zip(shape.layers()).enumerate() {
        units = linear.forward(&units).expect("linear");
        if !layer.linear {
            units = match shape.activation() {
                Activation::Tanh => units.tanh(),
                Activation::Relu => units.relu(),
            }
            .expect("activation");
        }
        if index + 1 == shape.bottleneck() {
            bottleneck = Some(units.clone());
        }
    }
    (bottleneck.expect("a bottleneck"), units)
}

fn shapes() -> impl Strategy<Value = NetShape> {
    let hidden = proptest::collection::vec(1usize..=33, 1..=2);
    (1usize..=6, hidden, any::<bool>(), any::<bool>()).prop_map(|(inputs, hidden, tanh, decoder)| {
        let activation = if tanh { Activation::Tanh } else { Activation::Relu };
        if decoder {
            NetShape::auto_encoder(inputs, &hidden, activation)
        } else {
            NetShape::regression(inputs, &hidden, activation)
        }
    })
}

fn random_set(shape: &NetShape, samples: usize, rng: &mut ChaCha8Rng) -> TrainingSet {
    let mut column = || (0..samples).map(|_| rng.random_range(-2.0f32..2.0)).collect::<Vec<f32>>();
    let inputs: Vec<Vec<f32>> = (0..shape.widths()[0]).map(|_| column()).collect();
    let position_targets = [column(), column()];
    let reconstruction_targets = if shape.has_decoder() { inputs.clone() } else { Vec::new() };
    let weights = column().iter().map(|weight| weight.abs()).collect();
    TrainingSet { inputs, reconstruction_targets, position_targets, weights }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn the_forward_pass_equals_candles(shape in shapes(), seed in any::<u64>()) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let parameters = shape.initial_parameters(&mut rng);
        let inputs: Vec<f32> = (0..shape.widths()[0]).map(|_| rng.random_range(-3.0..3.0)).collect();
        let flat = Tensor::from_slice(&parameters, parameters.len(), &Device::Cpu).expect("flat");
        let row = Tensor::from_slice(&inputs, (1, inputs.len()), &Device::Cpu).expect("row");
        let (bottleneck, last) = candle_forward(&shape, &flat, &row);
        let net = Net::new(shape.clone(), &parameters);
        let own = net.encode(&inputs);
        let theirs: Vec<Vec<f32>> = bottleneck.to_vec2().expect("bottleneck");
        for (one, other) in own.iter().zip(&theirs[0]) {
            prop_assert!((one - other).abs() <= 1e-4 * (1.0 + other.abs()), "{one} {other}");
        }
        if shape.has_decoder() {
            let theirs: Vec<Vec<f32>> = last.to_vec2().expect("last");
            for (one, other) in net.decode(own).iter().zip(&theirs[0]) {
                prop_assert!((one - other).abs() <= 1e-4 * (1.0 + other.abs()), "{one} {other}");
            }
        }
    }

    #[test]
    fn the_gradient_of_the_kernel_equals_candles(
        shape in shapes(), seed in any::<u64>(), samples in 1usize..150, wx in 0.1f32..3.0, wz in 0.1f32..3.0,
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let parameters = shape.initial_parameters(&mut rng);
        let set = random_set(&shape, samples, &mut rng);
        let rows: Vec<u32> = (0..samples as u32).rev().collect();
        let mut gradient = vec![0.0; parameters.len()];
        let sums = pulp::Arch::new().dispatch(BatchLoss {
            shape: &shape,
            parameters: &parameters,
            set: &set,
            rows: &rows,
            weights: LossWeights { reconstruction: wx, regression: wz },
            scratch: &mut Scratch::new(&shape),
            gradient: &mut gradient,
        });
        let var = Var::from_slice(&parameters, parameters.len(), &Device::Cpu).expect("var");
        let matrix = |columns: &[Vec<f32>]| {
            let flat: Vec<f32> = columns.iter().flatten().copied().collect();
            Tensor::from_vec(flat, (columns.len(), samples), &Device::Cpu).expect("columns").t().expect("rows")
        };
        let (bottleneck, last) = candle_forward(&shape, var.as_tensor(), &matrix(&set.inputs));
        let weights = Tensor::from_slice(&set.weights, samples, &Device::Cpu).expect("weights");
        let ez = (bottleneck - matrix(&set.position_targets)).and_then(|error| error.sqr()).and_then(|error| error.mean(1));
        let ez = (ez.expect("eZ") * weights).and_then(|ez| ez.mean_all()).expect("eZ");
        let mut loss = (ez * f64::from(wz)).expect("loss");
        if shape.has_decoder() {
            let ex = (last - matrix(&set.reconstruction_targets)).and_then(|error| error.sqr()).and_then(|error| error.mean_all());
            loss = (loss + (ex.expect("eX") * f64::from(wx)).expect("loss")).expect("loss");
        }
        let theirs = loss.to_dtype(DType::F32).and_then(|loss| loss.to_scalar::<f32>()).expect("loss");
        let own = (sums.loss / sums.samples) as f32;
        prop_assert!((own - theirs).abs() <= 1e-4 * (1.0 + theirs.abs()), "{own} {theirs}");
        let derivatives = loss.backward().expect("backward");
        let derivatives: Vec<f32> = derivatives.get(var.as_tensor()).expect("derivatives").to_vec1().expect("derivatives");
        let size = derivatives.iter().fold(0.0f32, |size, derivative| size.max(derivative.abs()));
        for (one, other) in gradient.iter().zip(&derivatives) {
            prop_assert!((one - other).abs() <= 1e-3 * size + 1e-6, "{one} {other}");
        }
    }
}

pub(super) fn options(recipe: Recipe) -> FitOptions {
    FitOptions {
        recipe,
        seed: 7,
        epochs: Some(30),
        image_size: None,
        gnss_error: GnssError::Known(SigmaM::new(2.0).expect("valid")),
        gnss_bias_sigma_m: None,
    }
}

pub(super) fn silent(_: FitEvent<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let samples = walk(6, 40, 2.0, 1);
    for &recipe in Recipe::ALL {
        let first = fit(&samples, &options(recipe), &mut silent).expect("fits");
        let second = fit(&samples, &options(recipe), &mut silent).expect("fits");
        assert_eq!(first.weights, second.weights, "{recipe}");
        assert_eq!(first.metadata, second.metadata, "{recipe}");
        assert!(first.weights.len() <= crate::LARGEST_WEIGHTS_BYTES);
        let other = FitOptions { seed: 8, ..options(recipe) };
        let other = fit(&samples, &other, &mut silent).expect("fits");
        assert!(recipe == Recipe::Projective || recipe == Recipe::Auto || other.weights != first.weights);
    }
}

#[test]
fn the_metadata_survive_json_and_the_model_answers_the_same() {
    let samples = walk(6, 40, 2.0, 2);
    for &recipe in Recipe::ALL {
        let artifact = fit(&samples, &options(recipe), &mut silent).expect("fits");
        let text = serde_json::to_string(&artifact.metadata).expect("json");
        let metadata = serde_json::from_str(&text).expect("metadata");
        let again = Artifact { metadata, weights: artifact.weights.clone() }.load().expect("loads");
        let regressor = artifact.load().expect("loads");
        for sample in samples.iter().step_by(17) {
            let one = regressor.regress(&sample.bounding_box, None);
            let other = again.regress(&sample.bounding_box, None);
            assert!(one.regressed.distance_m(other.regressed) < 1e-6);
            assert!(one.e_regression_m2 > 0.0 && one.e_regression_m2.is_finite());
        }
    }
}

#[test]
fn unusable_samples_are_refused_by_name() {
    let samples = walk(4, 30, 2.0, 3);
    let mut one_spot = samples.clone();
    for sample in &mut one_spot {
        sample.bounding_box = samples[0].bounding_box;
    }
    for (samples, word) in
        [(&samples[..0], "none"), (&samples[..19], "needs at least"), (&one_spot[..], "one spot")]
    {
        match fit(samples, &options(Recipe::Auto), &mut silent) {
            Err(FitError::Unusable(error)) => {
                let text = error.to_string();
                assert!(text.contains("samples") && text.contains(word), "{text}");
            }
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn the_observer_ends_the_fit() {
    let samples = walk(4, 30, 2.0, 3);
    let mut calls = 0;
    let ended = fit(&samples, &options(Recipe::Hybrid), &mut |_| {
        calls += 1;
        if calls < 5 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    });
    assert!(matches!(ended, Err(FitError::Cancelled)));
    assert_eq!(calls, 5);
}

#[test]
fn foreign_artifacts_are_refused_by_field() {
    let artifact = fit(&walk(4, 30, 2.0, 4), &options(Recipe::Hybrid), &mut silent).expect("fits");
    let field_of = |change: &dyn Fn(&mut Artifact)| {
        let mut changed = artifact.clone();
        change(&mut changed);
        match changed.load().expect_err("refused") {
            crate::domain::Error::Refused(refusal) => refusal.violations[0].field.clone(),
            fault => panic!("{fault}"),
        }
    };
    assert_eq!(field_of(&|artifact| artifact.metadata.format = 2), "metadata.format");
    assert_eq!(field_of(&|artifact| artifact.metadata.recipe = "magic".into()), "metadata.recipe");
    assert_eq!(field_of(&|artifact| artifact.metadata.error_scale = f64::NAN), "metadata.error_scale");
    assert_eq!(field_of(&|artifact| artifact.metadata.e_gnss_m2 = -1.0), "metadata.e_gnss_m2");
    assert_eq!(field_of(&|artifact| artifact.metadata.origin.latitude_deg = 91.0), "metadata.origin");
    assert_eq!(field_of(&|artifact| artifact.metadata.features.clear()), "metadata.features");
    assert_eq!(field_of(&|artifact| artifact.weights = bytes::Bytes::from_static(b"nonsense")), "weights");
    assert_eq!(field_of(&|artifact| artifact.weights = vec![0; 70_000].into()), "weights");
    assert_eq!(
        field_of(&|artifact| {
            let mut weights = artifact.weights.to_vec();
            let at = weights.len() - 4;
            weights[at..].copy_from_slice(&f32::NAN.to_le_bytes());
            artifact.weights = weights.into();
        }),
        "weights"
    );
}
