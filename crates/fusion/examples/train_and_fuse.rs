//! Trains a model on boxes and fixes of a camera and fuses another box with its fix, without a server:
//! `cargo run -p sightfix-fusion --example train_and_fuse`.

use std::error::Error;
use std::ops::ControlFlow;

use sightfix_domain::domain::{FusedFix, GnssError, Observation, Recipe, Sample};
use sightfix_fusion::two_step::fuse;
use sightfix_model::{FitOptions, fit};
use sightfix_simulation::{Options, Scene, simulate_split};

/// Rows of one's own become `Sample`s by `sightfix_exchange::read_samples`, or by hand.
fn rows() -> (Vec<Sample>, Sample) {
    let (training, test) = simulate_split(&Options { samples: 400, ..Options::new(Scene::Square) }, 50);
    (training.training_samples(), test.training_samples().swap_remove(0))
}

fn train_and_fuse(samples: &[Sample], row: &Sample) -> Result<FusedFix, Box<dyn Error>> {
    let options = FitOptions {
        recipe: Recipe::Projective,
        seed: 1,
        epochs: None,
        image_size: None,
        gnss_error: GnssError::Unknown,
        gnss_bias_sigma_m: None,
    };
    let regressor = fit(samples, &options, &mut |_| ControlFlow::Continue(()))?.load()?;
    let observation = Observation::new(row.time, None, Some(row.bounding_box), Some(row.fix))?;
    Ok(fuse(&observation, Some((&regressor, 1)), None, None).ok_or("no position")?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let (samples, row) = rows();
    let fused = train_and_fuse(&samples, &row)?;
    println!("{:?}, 95 % within {:.1} m", fused.fused, fused.r95_m);
    Ok(())
}

#[test]
fn the_position_is_within_the_stated_radius() {
    let (samples, row) = rows();
    let fused = train_and_fuse(&samples, &row).expect("fuses");
    let error_m = sightfix_domain::geo::distance_m(fused.fused, row.truth.expect("simulated"));
    assert!(error_m < fused.r95_m && fused.r95_m < 5.0, "{error_m} {}", fused.r95_m);
}
