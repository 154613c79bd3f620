//! Fusing one observation in memory.

use std::hint::black_box;
use std::time::Instant;

use sightfix::domain::{Observation, Recipe};
use sightfix::fusion::two_step;
use sightfix::model::{self, FitOptions};
use sightfix::simulation::{Options, simulate};

use crate::ratio::median;
use crate::tables;

const CALLS: usize = 200_000;

pub(crate) fn run() {
    tables::head(
        "One observation in memory: forward pass, decoder, weights, positions",
        &["recipe", "with a fix (ns)", "without a fix (ns)"],
    );
    let world = simulate(&Options::demo());
    let samples = world.training_samples();
    for recipe in [Recipe::Paper, Recipe::Hybrid, Recipe::Projective, Recipe::GaussianProcess] {
        let options = FitOptions {
            recipe,
            seed: 1,
            epochs: Some(50),
            image_size: Some(world.image_size),
            gnss_error: sightfix::domain::GnssError::Unknown,
            gnss_bias_sigma_m: None,
        };
        let artifact = model::fit(&samples, &options, &mut |_| std::ops::ControlFlow::Continue(()))
            .expect("the demonstration can be learnt");
        let regressor = artifact.load().expect("what was fitted can be loaded");
        let mut times = [true, false].map(|with_fix| {
            let observations: Vec<_> = samples
                .iter()
                .map(|sample| {
                    let fix = with_fix.then_some(sample.fix);
                    Observation::new(sample.time, None, Some(sample.bounding_box), fix).expect("a box")
                })
                .collect();
            let mut rounds: Vec<f64> = (0..7)
                .map(|_| {
                    let began = Instant::now();
                    for observation in observations.iter().cycle().take(CALLS) {
                        black_box(two_step::fuse(
                            black_box(observation),
                            Some((&regressor, 1)),
                            Some(world.image_size),
                            None,
                        ));
                    }
                    began.elapsed().as_secs_f64() * 1e9 / CALLS as f64
                })
                .collect();
            median(&mut rounds)
        });
        let [with_fix, denied] = &mut times;
        tables::row(recipe, &[(*with_fix, 0), (*denied, 0)]);
    }
}
