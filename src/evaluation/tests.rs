use std::ops::ControlFlow;

use super::*;
use crate::domain::{Observation, Recipe, SigmaM};
use crate::simulation::{Options, Scene, World, simulate, simulate_split};

fn options(methods: &str) -> EvaluateOptions {
    EvaluateOptions {
        methods: Method::list(methods).expect("names"),
        default_recipe: Recipe::Hybrid,
        seeds: 1,
        epochs: Some(40),
        image_size: None,
        gnss_sigma: Some(SigmaM::new(2.2).expect("valid")),
        box_shift_px: 0.0,
        cpu_s: || 0.0,
    }
}

fn test_rows(world: &World) -> Vec<TestRow> {
    world
        .rows
        .iter()
        .map(|row| TestRow {
            observation: Observation {
                time: row.time,
                target_id: Some(row.target_id.clone()),
                bounding_box: row.bounding_box,
                fix: row.fix,
            },
            truth: Some(row.truth),
        })
        .collect()
}

fn judge(train: &World, test: &World, options: &EvaluateOptions) -> Evaluation {
    let rows = test_rows(test);
    evaluate(&train.training_samples(), &rows, &Truth::Columns, options, &mut |_| ControlFlow::Continue(()))
        .expect("valid boxes")
}

#[test]
fn every_method_answers_interleaved_targets_with_holes() {
    let square = Options { samples: 800, targets: 3, ..Options::new(Scene::Square) };
    let test = Options { gnss_gaps: 0.2, occlusion: 0.2, targets: 5, ..square.test(500) };
    let test = simulate(&test);
    let names = "gnss,imm_ukf,dnn,dnn.denied,homography.denied,hybrid.one_step,hybrid.two_step,hybrid.denied,\
                 track,track.denied";
    let evaluation = judge(&simulate(&square), &test, &options(names));
    assert!(evaluation.report.failed.is_empty(), "{:?}", evaluation.report.failed);
    let n = |name: &str| evaluation.report.methods[name].metrics.n;
    let count = |holds: &dyn Fn(&TestRow) -> bool| test_rows(&test).iter().filter(|row| holds(row)).count();
    assert_eq!(n("gnss"), count(&|row| row.observation.fix.is_some()));
    assert_eq!(n("hybrid.denied"), count(&|row| row.observation.bounding_box.is_some()));
    let either = |row: &TestRow| row.observation.bounding_box.is_some() || row.observation.fix.is_some();
    assert_eq!(n("hybrid.two_step"), count(&either));
    let both = |row: &TestRow| row.observation.bounding_box.is_some() && row.observation.fix.is_some();
    assert_eq!(n("dnn"), count(&both));
    assert!(n("track") >= n("hybrid.two_step"));
    let mean_m = |name: &str| evaluation.report.methods[name].metrics.mean_m;
    assert!(mean_m("homography.denied") < mean_m("gnss"), "{}", evaluation.report.table());
}

#[test]
fn answers_repeat_and_seeds_spread() {
    let (train, test) = simulate_split(&Options { samples: 400, ..Options::new(Scene::Square) }, 100);
    let two = EvaluateOptions { seeds: 2, ..options("gnss,hybrid.denied") };
    let (first, again) = (judge(&train, &test, &two), judge(&train, &test, &two));
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
fn enlarged_boxes_hurt_the_camera_and_not_the_receiver() {
    let (train, test) = simulate_split(&Options { samples: 800, ..Options::new(Scene::Square) }, 200);
    let plain = judge(&train, &test, &options("gnss,homography.denied"));
    let shifted = EvaluateOptions { box_shift_px: 100.0, ..options("gnss,homography.denied") };
    let shifted = judge(&train, &test, &shifted);
    let mean_m = |evaluation: &Evaluation, name: &str| evaluation.report.methods[name].metrics.mean_m;
    assert!((mean_m(&plain, "gnss") - mean_m(&shifted, "gnss")).abs() < 1e-9);
    // The foot moves half the growth to the left.
    assert!(mean_m(&shifted, "homography.denied") > mean_m(&plain, "homography.denied") + 0.2);
}

#[test]
fn what_cannot_run_is_named_and_the_rest_goes_on() {
    let (train, test) = simulate_split(&Options { samples: 5, ..Options::new(Scene::Square) }, 50);
    let evaluation = judge(&train, &test, &options("gnss,dnn,homography.denied,hybrid.one_step"));
    assert_eq!(evaluation.report.methods.len(), 1);
    assert_eq!(evaluation.report.failed.len(), 3, "{:?}", evaluation.report.failed);
    // Without any truth nothing can be judged, and that is said.
    let mut rows = test_rows(&test);
    rows.iter_mut().for_each(|row| row.truth = None);
    let unjudged =
        evaluate(&[], &rows, &Truth::Columns, &options("gnss"), &mut |_| ControlFlow::Continue(()))
            .expect("valid boxes");
    assert!(unjudged.report.failed.contains_key("gnss"));
}

#[test]
fn steps_are_counted_to_the_end_and_breaking_stops_at_the_next() {
    let square = Options { samples: 300, ..Options::new(Scene::Square) };
    let (train, rows) = (simulate(&square).training_samples(), test_rows(&simulate(&square.test(50))));
    let options = EvaluateOptions { seeds: 2, ..options("gnss,hybrid.denied,hybrid.two_step") };
    let mut told = Vec::new();
    let whole = evaluate(&train, &rows, &Truth::Columns, &options, &mut |doing| {
        told.push((doing.done, doing.planned));
        ControlFlow::Continue(())
    });
    assert_eq!(whole.expect("valid boxes").report.methods.len(), 3);
    // One fit and three methods, with two seeds; the last step is told when it begins.
    assert!(told.iter().all(|&(_, planned)| planned == 8), "{told:?}");
    assert!(told.is_sorted() && told.first() == Some(&(0, 8)) && told.last() == Some(&(7, 8)), "{told:?}");

    let mut heard = 0;
    let broken_off = evaluate(&train, &rows, &Truth::Columns, &options, &mut |doing| {
        heard += usize::from(doing.done >= 2);
        if doing.done >= 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    let methods = broken_off.expect("valid boxes").report.methods;
    assert_eq!((methods.len(), heard), (1, 1), "nothing goes on after the break");
}
