//! Training the same net on one thread, against PyTorch (benches/peers).

use std::ops::ControlFlow;
use std::process::Command;
use std::sync::Arc;
use std::time::Instant;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use sightfix::domain::{GnssError, Recipe, SigmaM};
use sightfix::model::FitOptions;
use sightfix::model::network::{Activation, LossWeights, NetShape, Schedule, TrainingSet, train};
use sightfix::simulation::{Options, Scene, simulate};

use crate::ratio::{self, in_turn, median};
use crate::tables;

const TITLE: &str = "Training 10,000 samples, 100 epochs, batch 512, net 4-32-2-32-4, one thread";
const SAMPLES: usize = 10_000;
const INPUTS: usize = 4;
const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/peers/train_torch.py");

pub(crate) fn run() {
    whole();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let set = Arc::new(training_set(&mut rng));
    let ours = || fit(&set);
    match std::env::var("PEERS_PYTHON") {
        Ok(python) => {
            ratio::head(TITLE, "s");
            ratio::row("compared with PyTorch", &in_turn(ours, || by_torch(&python)));
        }
        Err(_) => {
            tables::head(TITLE, &["case", "ours (s)"]);
            let mut rounds: Vec<f64> = (0..7).map(|_| ours()).collect();
            tables::row("set PEERS_PYTHON for the peer (benches/peers)", &[(median(&mut rounds), 3)]);
        }
    }
}

/// A whole default run: every candidate, held-out blocks, the final fit.
fn whole() {
    tables::head(
        "The default recipe on 10,000 simulated rows, one thread",
        &["scene", "s (target 20)", "model bytes (target 65536)"],
    );
    for &scene in Scene::ALL {
        let options = Options { seed: 1001, camera_seed: 1001, ..Options::new(scene) };
        let world = simulate(&options);
        let samples = world.training_samples();
        let fit_options = FitOptions {
            recipe: Recipe::Auto,
            seed: 1,
            epochs: None,
            image_size: Some(world.image_size),
            gnss_error: GnssError::Known(SigmaM::new(options.gnss_sigma_m).expect("above 0")),
            gnss_bias_sigma_m: None,
        };
        let began = Instant::now();
        let artifact = sightfix::model::fit(&samples, &fit_options, &mut |_| ControlFlow::Continue(()))
            .expect("a simulated world can be learnt");
        tables::row(scene, &[(began.elapsed().as_secs_f64(), 2), (artifact.weights.len() as f64, 0)]);
    }
}

/// The peer's own figures: boxes of unit variance, fixes that bend with them.
fn training_set(rng: &mut ChaCha8Rng) -> TrainingSet {
    let inputs: Vec<Vec<f32>> =
        (0..INPUTS).map(|_| (0..SAMPLES).map(|_| rng.sample(StandardNormal)).collect()).collect();
    let target = |axis: usize| {
        let (straight, bent) = (&inputs[axis], &inputs[axis + 2]);
        straight.iter().zip(bent).map(|(straight, bent)| 0.7 * straight + 0.3 * bent * bent).collect()
    };
    TrainingSet {
        reconstruction_targets: inputs.clone(),
        position_targets: [target(0), target(1)],
        inputs,
        weights: vec![1.0; SAMPLES],
    }
}

fn fit(set: &Arc<TrainingSet>) -> f64 {
    let shape = NetShape::auto_encoder(INPUTS, &[32], Activation::Tanh);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let parameters = shape.initial_parameters(&mut rng);
    let weights = LossWeights { reconstruction: 1.0, regression: 1.0 };
    let schedule = Schedule { epochs: 100, batch: 512, learning_rate: 0.005, last_rate_share: 1.0 };
    let began = Instant::now();
    train(
        &shape,
        parameters,
        set.clone(),
        weights,
        schedule,
        &mut rng,
        &mut |_, _| ControlFlow::Continue(()),
    )
    .expect("a training of finite numbers");
    began.elapsed().as_secs_f64()
}

fn by_torch(python: &str) -> f64 {
    let output = Command::new(python).arg(SCRIPT).output().expect("PEERS_PYTHON is a Python with PyTorch");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).trim().parse().expect("the script prints seconds")
}
