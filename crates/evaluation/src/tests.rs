use std::ops::ControlFlow;

use super::*;
use crate::baselines::homography;
use crate::domain::{GnssError, Recipe, Sample, SigmaM};
use crate::geo::LocalPlane;
use crate::model::{FitOptions, fit};
use crate::simulation::{Options, Scene, World, simulate, simulate_split, walk};

fn options(methods: &str) -> EvaluateOptions {
    EvaluateOptions {
        methods: Method::list(methods).expect("names"),
        default_recipe: Recipe::Hybrid,
        seeds: 1,
        epochs: Some(40),
        image_size: None,
        gnss_sigma: Some(SigmaM::new(2.2).expect("valid")),
        gnss_bias_sigma: None,
        box_shift_px: 0.0,
        cpu_s: || 0.0,
    }
}

fn test_rows(world: &World) -> Vec<TestRow> {
    world
        .rows
        .iter()
        .filter_map(|row| Some(TestRow { observation: row.observation()?, truth: Some(row.truth) }))
        .collect()
}

fn evaluated(train: &World, test: &World, options: &EvaluateOptions) -> Evaluation {
    let rows = test_rows(test);
    evaluate(&train.training_samples(), &rows, &Truth::Columns, options, &mut |_| ControlFlow::Continue(()))
        .expect("valid boxes")
}

#[test]
fn every_method_predicts_for_interleaved_targets_with_gaps() {
    let square = Options { samples: 800, targets: 3, ..Options::new(Scene::Square) };
    let test = Options { gnss_gaps: 0.2, occlusion: 0.2, targets: 5, ..square.test(500) };
    let test = simulate(&test);
    let names = "gnss,imm_ukf,dnn,dnn.denied,homography.denied,hybrid.one_step,hybrid.two_step,hybrid.denied,\
                 track,track.denied";
    let evaluation = evaluated(&simulate(&square), &test, &options(names));
    assert!(evaluation.report.failed.is_empty(), "{:?}", evaluation.report.failed);
    let n = |name: &str| evaluation.report.methods[name].metrics.n;
    let count = |holds: &dyn Fn(&TestRow) -> bool| test_rows(&test).iter().filter(|row| holds(row)).count();
    assert_eq!(n("gnss"), count(&|row| row.observation.fix().is_some()));
    assert_eq!(n("hybrid.denied"), count(&|row| row.observation.bounding_box().is_some()));
    let either = |row: &TestRow| row.observation.bounding_box().is_some() || row.observation.fix().is_some();
    assert_eq!(n("hybrid.two_step"), count(&either));
    let both = |row: &TestRow| row.observation.bounding_box().is_some() && row.observation.fix().is_some();
    assert_eq!(n("dnn"), count(&both));
    assert!(n("track") >= n("hybrid.two_step"));
    let mean_m = |name: &str| evaluation.report.methods[name].metrics.mean_m;
    assert!(mean_m("homography.denied") < mean_m("gnss"), "{}", evaluation.report.table());
}

#[test]
fn predictions_are_repeatable_and_seeds_differ() {
    let (train, test) = simulate_split(&Options { samples: 400, ..Options::new(Scene::Square) }, 100);
    let two = EvaluateOptions { seeds: 2, ..options("gnss,hybrid.denied") };
    let (first, again) = (evaluated(&train, &test, &two), evaluated(&train, &test, &two));
    let means = |evaluation: &Evaluation, name: &str| evaluation.report.methods[name].seed_means_m.clone();
    for name in ["gnss", "hybrid.denied"] {
        let (one, other) = (means(&first, name), means(&again, name));
        assert!(one.iter().zip(&other).all(|(one, other)| one.to_bits() == other.to_bits()), "{name}");
    }
    let [one, other] = means(&first, "hybrid.denied")[..] else { unreachable!("two seeds") };
    assert!((one - other).abs() > 0.0);
    assert_eq!(first.traces, again.traces);
}

#[test]
fn enlarged_boxes_increase_the_error_of_the_camera_only() {
    let (train, test) = simulate_split(&Options { samples: 800, ..Options::new(Scene::Square) }, 200);
    let plain = evaluated(&train, &test, &options("gnss,homography.denied"));
    let shifted = EvaluateOptions { box_shift_px: 100.0, ..options("gnss,homography.denied") };
    let shifted = evaluated(&train, &test, &shifted);
    let mean_m = |evaluation: &Evaluation, name: &str| evaluation.report.methods[name].metrics.mean_m;
    assert!((mean_m(&plain, "gnss") - mean_m(&shifted, "gnss")).abs() < 1e-9);
    // The foot moves half the growth to the left.
    assert!(mean_m(&shifted, "homography.denied") > mean_m(&plain, "homography.denied") + 0.2);
}

#[test]
fn a_method_that_cannot_run_is_named_and_the_others_run() {
    let (train, test) = simulate_split(&Options { samples: 5, ..Options::new(Scene::Square) }, 50);
    let evaluation = evaluated(&train, &test, &options("gnss,dnn,homography.denied,hybrid.one_step"));
    assert_eq!(evaluation.report.methods.len(), 1);
    assert_eq!(evaluation.report.failed.len(), 3, "{:?}", evaluation.report.failed);
    // Without any truth no prediction can be scored, and the report states that.
    let mut rows = test_rows(&test);
    rows.iter_mut().for_each(|row| row.truth = None);
    let unscored =
        evaluate(&Vec::new(), &rows, &Truth::Columns, &options("gnss"), &mut |_| ControlFlow::Continue(()))
            .expect("valid boxes");
    assert!(unscored.report.failed.contains_key("gnss"));
}

#[test]
fn steps_are_counted_and_a_break_stops_at_the_next_one() {
    let square = Options { samples: 300, ..Options::new(Scene::Square) };
    let (train, rows) = (simulate(&square).training_samples(), test_rows(&simulate(&square.test(50))));
    let options = EvaluateOptions { seeds: 2, ..options("gnss,hybrid.denied,hybrid.two_step") };
    let mut reported = Vec::new();
    let whole = evaluate(&train, &rows, &Truth::Columns, &options, &mut |progress| {
        reported.push((progress.done, progress.planned));
        ControlFlow::Continue(())
    });
    assert_eq!(whole.expect("valid boxes").report.methods.len(), 3);
    // One fit and three methods, with two seeds; a step is reported when it starts.
    assert!(reported.iter().all(|&(_, planned)| planned == 8), "{reported:?}");
    assert!(reported.is_sorted(), "{reported:?}");
    assert_eq!((reported.first(), reported.last()), (Some(&(0, 8)), Some(&(7, 8))), "{reported:?}");

    let mut calls = 0;
    let interrupted = evaluate(&train, &rows, &Truth::Columns, &options, &mut |progress| {
        calls += usize::from(progress.done >= 2);
        if progress.done >= 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    let methods = interrupted.expect("valid boxes").report.methods;
    assert_eq!((methods.len(), calls), (1, 1), "nothing goes on after the break");
}

#[test]
fn a_fit_to_few_passes_is_no_worse_than_the_homography() {
    let tests = walk(8, 40, 2.0, 98);
    let fit_options = FitOptions {
        recipe: Recipe::Auto,
        seed: 7,
        epochs: Some(30),
        image_size: None,
        gnss_error: GnssError::Known(SigmaM::new(2.0).expect("valid")),
        gnss_bias_sigma_m: None,
    };
    let (mut own_m, mut homography_m) = (0.0, 0.0);
    for seed in 20..26 {
        let samples = walk(4, 10, 2.0, seed);
        let artifact = fit(&samples, &fit_options, &mut |_| ControlFlow::Continue(())).expect("fits");
        let regressor = artifact.load().expect("loads");
        let plane = LocalPlane::new(samples[0].fix.position);
        let pairs: Vec<_> =
            samples.iter().map(|sample| (sample.bounding_box, plane.to_plane(sample.fix.position))).collect();
        let homography = homography::fit(&pairs, 1).expect("fits");
        let truth = |plane: &LocalPlane, sample: &Sample| plane.to_plane(sample.truth.expect("truth"));
        for sample in &tests {
            let regressed = regressor.regress(&sample.bounding_box, None).regressed;
            own_m += regressed.distance_m(truth(regressor.plane(), sample));
            let projected = homography.project(&sample.bounding_box);
            homography_m += projected.map_or(30.0, |point| point.distance_m(truth(&plane, sample)).min(30.0));
        }
    }
    assert!(own_m < 1.2 * homography_m, "{own_m} {homography_m}");
}
