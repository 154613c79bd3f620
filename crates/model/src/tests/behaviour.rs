//! The errors of fitted models on a small simulated walk whose true positions are known.

use jiff::Timestamp;

use super::{options, silent};
use crate::domain::{BoundingBox, GnssError, Recipe, Sample, TargetId};
use crate::geo::{EastNorth, LocalPlane};
use crate::network::LossWeights;
use crate::simulation::walk;
use crate::{Artifact, FitOptions, FitOverrides, fit, fit_with};

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

#[test]
fn every_gaussian_process_holds_an_auto_encoder() {
    let samples = walk(6, 40, 2.0, 71);
    let artifact = fit(&samples, &options(Recipe::GaussianProcess), &mut silent).expect("fits");
    let regressor = artifact.load().expect("loads");
    assert!(artifact.metadata.error_scale > 0.0);
    assert!(artifact.metadata.parameters["auto_encoder.ratio_of_means_m2"] > 0.0);
    assert_eq!(artifact.metadata.epochs, 30);

    let usual = regressor.regress(&samples[100].bounding_box, None);
    let [left, top, width, height] = samples[100].bounding_box.sides_px();
    let wide = BoundingBox::new(left - width, top, 3.0 * width, height).expect("a box");
    let odd = regressor.regress(&wide, None);
    assert!(odd.reconstruction_error > 4.0 * usual.reconstruction_error && odd.outside_training);
}

#[test]
fn a_report_names_the_candidates_and_what_would_help() {
    let samples = walk(6, 40, 2.0, 72);
    let report = |samples: &[Sample]| {
        let artifact = fit(samples, &options(Recipe::Projective), &mut silent).expect("fits");
        artifact.metadata.report.expect("a report")
    };
    let one = report(&samples);
    println!("{one}");
    assert_eq!(one.candidates.len(), 4);
    assert!((one.candidates.iter().map(|own| own.weight).sum::<f64>() - 1.0).abs() < 1e-12);
    assert!(one.candidates.iter().all(|own| own.held_out_miss_m > 0.0 && !own.summary.is_empty()));
    assert!(one.advice.iter().any(|line| line.contains("walk once more on another day")));
    let next_day = samples.iter().cloned().map(|mut sample| {
        sample.time += jiff::SignedDuration::from_hours(24);
        let plane = LocalPlane::new(sample.fix.position);
        sample.fix.position = plane.to_position(EastNorth { east_m: 8.0, north_m: 0.0 });
        sample
    });
    let both: Vec<Sample> = samples.iter().cloned().chain(next_day).collect();
    let two = report(&both);
    println!("{two}");
    assert!(two.advice.iter().any(|line| line.contains("the 2 sessions disagree by")), "{:?}", two.advice);
}

#[test]
fn walks_on_one_line_are_reported_and_those_over_the_square_are_not() {
    let advice = |samples: &[Sample]| {
        let artifact = fit(samples, &options(Recipe::GaussianProcess), &mut silent).expect("fits");
        artifact.metadata.report.expect("a report").advice.join("; ")
    };
    let line = "cross the line on which all walks were";
    let one_pass: Vec<Sample> = walk(1, 60, 2.0, 72);
    assert!(advice(&one_pass).contains(line), "{}", advice(&one_pass));
    let square = advice(&walk(6, 40, 2.0, 72));
    assert!(!square.contains(line), "{square}");
}

#[test]
fn the_fixes_of_one_short_walk_are_not_taken_as_better_than_a_phones() {
    let mut sigmas_m: Vec<f64> = (0..8)
        .map(|seed| {
            let samples = walk(1, 25, 2.6, 300 + seed);
            let options = FitOptions { gnss_error: GnssError::Unknown, ..options(Recipe::GaussianProcess) };
            fit(&samples, &options, &mut silent).expect("fits").metadata.e_gnss_m2.sqrt()
        })
        .collect();
    sigmas_m.sort_by(f64::total_cmp);
    println!("{sigmas_m:.2?} m");
    assert!(sigmas_m[1] > 1.5 && sigmas_m[6] < 5.0, "{sigmas_m:?}");
}

#[test]
fn thinning_keeps_neighbours_together_and_counts_all_traverses() {
    use crate::samples::rows::TrainingRows;
    let rows = TrainingRows::new(&walk(10, 40, 2.0, 73)).expect("usable");
    let (all, traverses) = (rows.rows.len(), rows.traverses);
    let thinned = rows.thinned(all / 4);
    assert!(thinned.rows.len() <= all / 4 + 8, "{} of {all}", thinned.rows.len());
    assert_eq!(thinned.traverses, traverses);
    let neighbours = thinned.rows.windows(2).filter(|pair| pair[0].sample.abs_diff(pair[1].sample) == 1);
    assert!(neighbours.count() * 8 >= 6 * thinned.rows.len());
}

/// A candidate's model, and the squared bounded misses of its held-out rows by traverse.
struct Fitted {
    regressor: crate::Regressor,
    misses_m2: Vec<f64>,
}

fn fitted_candidate(
    name: &'static str,
    samples: &[Sample],
    fit_options: &FitOptions,
    bound_m2: f64,
) -> Fitted {
    let mut misses_m2 = Vec::new();
    let overrides = FitOverrides { candidate: Some(name), loss_weights: None };
    let artifact = fit_with(samples, fit_options, overrides, &mut |event| {
        if let crate::FitEvent::HeldOut(errors) = event {
            // Spells of 20 neighbours: their errors are correlated.
            let of_segment = |segment: &[crate::domain::HeldOutSampleError]| {
                segment.iter().map(|error| (0.5 * error.distance_m.powi(2)).min(bound_m2)).sum()
            };
            misses_m2 = errors.chunks(20).map(of_segment).collect();
        }
        std::ops::ControlFlow::Continue(())
    });
    Fitted { regressor: artifact.expect("fits").load().expect("loads"), misses_m2 }
}

/// The comparison in docs/explanation/method.md: choosing one candidate against averaging all by the shares of a
/// Bayesian bootstrap.
#[test]
#[ignore = "a measurement of minutes"]
fn averaging_all_candidates_against_choosing_one() {
    use crate::simulation::{Options, Scene, simulate};
    use rand::{RngExt, SeedableRng};
    const NAMES: [&str; 7] = [
        "gaussian_process",
        "projective/foot",
        "projective/sides",
        "projective/sides+smoothed",
        "projective/residual",
        "hybrid",
        "hybrid+smoothed",
    ];
    let (mut chosen_log, mut mean_log, mut first_log, mut worlds) = (0.0, 0.0, 0.0, 0.0);
    for (scene, targets, rows) in [
        (Scene::Airport, 1, 1_500),
        (Scene::Airport, 3, 1_500),
        (Scene::Square, 1, 900),
        (Scene::Square, 8, 720),
        (Scene::Square, 16, 1_440),
    ] {
        let simulated =
            Options { seed: 1_040, camera_seed: 1_040, targets, samples: rows, ..Options::new(scene) };
        let samples = simulate(&simulated).training_samples();
        let fit_options =
            FitOptions { gnss_error: GnssError::Unknown, epochs: None, ..options(Recipe::Auto) };
        let bound_m2 = if scene == Scene::Airport { 1e4 } else { 60.0 };
        let fitted: Vec<Fitted> =
            NAMES.iter().map(|name| fitted_candidate(name, &samples, &fit_options, bound_m2)).collect();
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let mut weights = vec![0.0; NAMES.len()];
        for _ in 0..500 {
            let draw: Vec<f64> =
                fitted[0].misses_m2.iter().map(|_| -(1.0 - rng.random::<f64>()).ln()).collect();
            let score = |own: &Fitted| {
                own.misses_m2.iter().zip(&draw).map(|(miss, weight)| miss * weight).sum::<f64>()
            };
            let scores: Vec<f64> = fitted.iter().map(score).collect();
            let best =
                (0..scores.len()).min_by(|one, other| scores[*one].total_cmp(&scores[*other])).unwrap_or(0);
            weights[best] += 1.0 / 500.0;
        }
        let artifact = fit(&samples, &fit_options, &mut silent).expect("fits");
        let chosen = artifact.load().expect("loads");
        let (mut chosen_m, mut mean_m, mut first_m, mut count) = (0.0, 0.0, 0.0, 0.0);
        for row in simulate(&simulated.test(300)).rows {
            let Some(bounding_box) = row.bounding_box else { continue };
            let truth = |plane: &LocalPlane| plane.to_plane(row.truth);
            let miss_m = |regressor: &crate::Regressor| {
                regressor.regress(&bounding_box, None).regressed.distance_m(truth(regressor.plane()))
            };
            let (mut east_m, mut north_m) = (0.0, 0.0);
            for (own, weight) in fitted.iter().zip(&weights) {
                let point = own.regressor.regress(&bounding_box, None).regressed;
                let truth = truth(own.regressor.plane());
                east_m += weight * (point.east_m - truth.east_m);
                north_m += weight * (point.north_m - truth.north_m);
            }
            chosen_m += miss_m(&chosen);
            first_m += miss_m(&fitted[0].regressor);
            mean_m += east_m.hypot(north_m);
            count += 1.0;
        }
        let weights: Vec<String> =
            NAMES.iter().zip(&weights).map(|(name, weight)| format!("{name} {weight:.2}")).collect();
        println!(
            "{scene}, {targets} targets: chosen {:.3} m, averaged {:.3} m, gaussian_process {:.3} m; {}",
            chosen_m / count,
            mean_m / count,
            first_m / count,
            weights.join(", ")
        );
        chosen_log += f64::ln(chosen_m / count);
        mean_log += f64::ln(mean_m / count);
        first_log += f64::ln(first_m / count);
        worlds += 1.0;
    }
    let geometric = |sum: f64| (sum / worlds).exp();
    println!(
        "geometric mean: chosen {:.3} m, averaged {:.3} m, gaussian_process {:.3} m",
        geometric(chosen_log),
        geometric(mean_log),
        geometric(first_log)
    );
}
