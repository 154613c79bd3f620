//! The errors of fitted models on a small simulated walk whose true positions are known.

use jiff::Timestamp;

use super::{options, silent, walk};
use crate::domain::{BoundingBox, Recipe, Sample, TargetId};
use crate::evaluation::baselines::homography;
use crate::geo::{EastNorth, LocalPlane};
use crate::model::network::LossWeights;
use crate::model::{Artifact, FitOverrides, fit, fit_with};

/// Mean distance to the truth of regressed and fused positions, and the share of truths inside the
/// stated 95 % radius.
fn scores(artifact: &Artifact, tests: &[Sample]) -> [f64; 3] {
    let regressor = artifact.load().expect("loads");
    let mut sums = [0.0; 3];
    for sample in tests {
        let plane = regressor.plane();
        let truth = plane.to_plane(sample.truth.expect("truth"));
        let fix = plane.to_plane(sample.fix.position);
        let answer = regressor.regress(&sample.bounding_box, Some(fix));
        let weight = regressor.e_gnss_m2() / (regressor.e_gnss_m2() + answer.e_regression_m2);
        let fused = EastNorth {
            east_m: weight * answer.regressed.east_m + (1.0 - weight) * fix.east_m,
            north_m: weight * answer.regressed.north_m + (1.0 - weight) * fix.north_m,
        };
        let miss_m = answer.regressed.distance_m(truth);
        sums[0] += miss_m;
        sums[1] += fused.distance_m(truth);
        sums[2] += f64::from(u8::from(miss_m <= answer.r95_scale * answer.e_regression_m2.sqrt()));
    }
    sums.map(|sum| sum / tests.len() as f64)
}

#[test]
fn the_default_has_a_smaller_error_than_the_receiver_and_states_it() {
    let tests = walk(8, 40, 2.0, 99);
    for seed in [11, 12, 13] {
        let samples = walk(24, 40, 2.0, seed);
        let artifact = fit(&samples, &options(Recipe::Auto), &mut silent).expect("fits");
        let [regressed_m, fused_m, inside] = scores(&artifact, &tests);
        // The receiver's own mean distance is 2.5 m; a fit that reproduces its fixes fails.
        assert!(regressed_m < 1.2, "{regressed_m}");
        assert!(fused_m < 1.25 * regressed_m, "{fused_m} {regressed_m}");
        assert!(inside > 0.85, "{inside}");
        assert_eq!(artifact.metadata.candidates.len(), 7);
    }
}

#[test]
fn few_passes_are_no_worse_than_the_homography() {
    let tests = walk(8, 40, 2.0, 98);
    let (mut own_m, mut homography_m) = (0.0, 0.0);
    for seed in 20..26 {
        let samples = walk(4, 10, 2.0, seed);
        let artifact = fit(&samples, &options(Recipe::Auto), &mut silent).expect("fits");
        own_m += scores(&artifact, &tests)[0];
        let plane = LocalPlane::new(samples[0].fix.position);
        let pairs: Vec<_> =
            samples.iter().map(|sample| (sample.bounding_box, plane.to_plane(sample.fix.position))).collect();
        let homography = homography::fit(&pairs, 1).expect("fits");
        let miss_m = |sample: &Sample| {
            let truth = plane.to_plane(sample.truth.expect("truth"));
            homography.project(&sample.bounding_box).map_or(30.0, |point| point.distance_m(truth).min(30.0))
        };
        homography_m += tests.iter().map(miss_m).sum::<f64>() / tests.len() as f64;
    }
    assert!(own_m < 1.2 * homography_m, "{own_m} {homography_m}");
}

#[test]
fn a_shifted_box_raises_the_error() {
    let samples = walk(16, 40, 2.0, 31);
    let artifact = fit(&samples, &options(Recipe::Auto), &mut silent).expect("fits");
    let regressor = artifact.load().expect("loads");
    let (mut as_seen, mut enlarged) = (0.0, 0.0);
    for sample in &samples {
        let [left, top, width, height] = sample.bounding_box.sides_px();
        let larger = BoundingBox::new(left - 60.0, top - 60.0, width + 60.0, height + 60.0).expect("a box");
        as_seen += regressor.regress(&sample.bounding_box, None).e_regression_m2;
        enlarged += regressor.regress(&larger, None).e_regression_m2;
    }
    assert!(enlarged > 5.0 * as_seen, "{enlarged} {as_seen}");
}

#[test]
fn rows_of_one_instant_still_fit() {
    let mut samples = walk(4, 30, 2.0, 41);
    for (at, sample) in samples.iter_mut().enumerate() {
        sample.time = Timestamp::from_second(1_600_000_000).expect("time");
        sample.target_id = TargetId::new(&format!("player-{at}")).expect("name");
    }
    let artifact = fit(&samples, &options(Recipe::Auto), &mut silent).expect("fits");
    assert_eq!((artifact.metadata.targets, artifact.metadata.passes), (120, 120));
}

#[test]
fn inconsistent_edges_raise_the_error_and_those_of_the_training_do_not() {
    let samples = walk(24, 40, 2.0, 51);
    let tests = walk(8, 40, 2.0, 52);
    let artifact = fit(&samples, &options(Recipe::Projective), &mut silent).expect("fits");
    let regressor = artifact.load().expect("loads");
    let error_m2 = |bounding_box: &BoundingBox| regressor.regress(bounding_box, None).e_regression_m2;
    let (mut as_seen, mut higher) = (Vec::new(), Vec::new());
    for sample in &tests {
        let [left, top, width, height] = sample.bounding_box.sides_px();
        let taller = BoundingBox::new(left, top - 0.4 * height, width, 1.4 * height).expect("a box");
        as_seen.push(error_m2(&sample.bounding_box));
        higher.push(error_m2(&taller));
    }
    let raised = as_seen.iter().zip(&higher).filter(|(as_seen, higher)| higher > as_seen).count();
    assert!(raised * 10 > 9 * tests.len(), "{raised} of {}", tests.len());
    as_seen.sort_by(f64::total_cmp);
    assert!(as_seen[tests.len() * 9 / 10] < 4.0 * as_seen[tests.len() / 2], "{as_seen:?}");
}

#[test]
fn overrides_choose_candidate_and_loss_weights_and_an_unknown_candidate_is_refused() {
    let samples = walk(6, 40, 2.0, 61);
    let own = LossWeights { reconstruction: 0.5, regression: 1.0 };
    let fitted = |candidate, loss_weights| {
        fit_with(&samples, &options(Recipe::Auto), FitOverrides { candidate, loss_weights }, &mut silent)
    };
    let plain = fitted(Some("hybrid"), None).expect("fits");
    assert_eq!(plain.metadata.candidates.len(), 1);
    assert_eq!(plain.weights, fitted(Some("hybrid"), Some(own)).expect("fits").weights);
    let other = LossWeights { reconstruction: 5.0, regression: 1.0 };
    assert_ne!(plain.weights, fitted(Some("hybrid"), Some(other)).expect("fits").weights);
    assert!(fitted(Some("nothing"), None).is_err());
}

/// Two recordings of the same ground, the fixes of one shifted: which is right cannot be determined, and
/// the stated error of the map between them must contain both.
#[test]
fn sessions_that_contradict_each_other_raise_the_error() {
    let (first, second) = (walk(24, 40, 2.0, 21), walk(24, 40, 2.0, 22));
    let mean_error_m = |shift_m: f64| {
        let next_day = second.iter().cloned().map(|mut sample| {
            sample.time += jiff::SignedDuration::from_hours(24);
            let plane = LocalPlane::new(sample.fix.position);
            sample.fix.position = plane.to_position(EastNorth { east_m: shift_m, north_m: 0.0 });
            sample
        });
        let both: Vec<Sample> = first.iter().cloned().chain(next_day).collect();
        let artifact = fit(&both, &options(Recipe::Projective), &mut silent).expect("fits");
        let regressor = artifact.load().expect("loads");
        let error_m = |sample: &Sample| regressor.regress(&sample.bounding_box, None).e_regression_m2.sqrt();
        first.iter().map(error_m).sum::<f64>() / first.len() as f64
    };
    let (alike_m, apart_m) = (mean_error_m(0.0), mean_error_m(4.0));
    // The map lies between the two, 2 m from each.
    assert!(alike_m < 0.8 && apart_m > 1.2 && apart_m < 3.0, "{alike_m} m, {apart_m} m");
}
