//! The numerics against direct computations, and the stated error against the truth of simulated worlds.

use nalgebra::DMatrix;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::box_plausibility::RecentBoxes;
use super::fit::{FitReport, FitSettings, fit, own_miss_m2};
use super::known_rows::KnownFoot;
use super::map_rows::MapRows;
use super::noise::{Epoch, ReceiverNoise, ReceiverWhitener};
use super::posterior::{Gram, Posterior, TangentPrior};
use super::predictor::Predictor;
use super::projective_mean::{Box4, COEFFICIENTS};
use super::upright_camera::UprightCamera;
use crate::artifact::ModelParts;
use crate::artifact::tensors::{LARGEST_WEIGHTS_BYTES, Tensors};
use crate::domain::{Recipe, TargetClass};
use crate::encoder::features::features_of;
use crate::geo::{EastNorth, LocalPlane};
use crate::simulation::{Options, Scene, simulate, standard_normal};

const IMAGE_PX: (f64, f64) = (1280.0, 720.0);
const PERSON_M: (f64, f64) = (1.70, 0.05);

/// Boxes and fixes of walkers on the simulated square, each with a receiver of its own that keeps a bias
/// of `bias_m` per axis, and boxes with their true positions.
fn walkers(seed: u64, targets: usize, rows_each: usize, bias_m: f64) -> (MapRows, Vec<(Box4, [f64; 2])>) {
    let options = Options {
        seed,
        camera_seed: seed,
        targets,
        samples: targets * rows_each,
        ..Options::new(Scene::Square)
    };
    let world = simulate(&options);
    let plane = LocalPlane::new(world.rows[0].truth);
    let mut samples = world.training_samples();
    samples.sort_by(|one, other| (&one.target_id, one.time).cmp(&(&other.target_id, other.time)));
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let biases: Vec<[f64; 2]> = (0..targets)
        .map(|_| [bias_m * standard_normal(&mut rng), bias_m * standard_normal(&mut rng)])
        .collect();
    let mut rows = MapRows::default();
    let mut target = 0;
    for (at, sample) in samples.iter().enumerate() {
        target += usize::from(at > 0 && samples[at - 1].target_id != sample.target_id);
        let EastNorth { east_m, north_m } = plane.to_plane(sample.fix.position);
        let time_s = sample.time.as_microsecond() as f64 * 1e-6;
        rows.epochs.push(Epoch { time_s, sequence: target as u32 });
        rows.boxes.push(features_of(&sample.bounding_box));
        rows.labels_m.push([east_m + biases[target][0], north_m + biases[target][1]]);
    }
    let tests = simulate(&options.test(400)).rows.into_iter().filter_map(|row| {
        let EastNorth { east_m, north_m } = plane.to_plane(row.truth);
        Some((features_of(&row.bounding_box?), [east_m, north_m]))
    });
    (rows, tests.collect())
}

fn fitted(rows: &MapRows) -> (Predictor, FitReport) {
    let boxes: Vec<(u32, Box4)> =
        rows.epochs.iter().zip(&rows.boxes).map(|(epoch, sides)| (epoch.sequence, *sides)).collect();
    let upright = UprightCamera::new(&boxes, IMAGE_PX, PERSON_M);
    fit(rows, &settings(upright)).expect("rows that determine a map")
}

fn settings(upright: Option<UprightCamera>) -> FitSettings {
    FitSettings {
        bias_sigma_m: None,
        white_share: 0.15,
        receiver_m2: None,
        seed: 1,
        upright,
        known: Vec::new(),
    }
}

/// Mean error, m, and share of the truths inside the stated radius.
fn score(predictor: &Predictor, tests: &[(Box4, [f64; 2])], grown_px: f64) -> (f64, f64) {
    let (mut sum_m, mut inside) = (0.0, 0.0);
    for ([u, v, width, height], truth_m) in tests {
        let grown = [u - 0.5 * grown_px, *v, width + grown_px, height + grown_px];
        let prediction = predictor.predict(&grown, None);
        let [east_m, north_m] = prediction.position_m;
        let error_m = (east_m - truth_m[0]).hypot(north_m - truth_m[1]);
        sum_m += error_m;
        inside += f64::from(u8::from(error_m <= prediction.r95_scale * prediction.variance_m2().sqrt()));
    }
    (sum_m / tests.len() as f64, inside / tests.len() as f64)
}

#[test]
fn innovations_of_the_three_part_noise_are_white_with_unit_variance() {
    let noise = ReceiverNoise {
        white_m2: 0.25,
        short_m2: 4.0,
        short_time_s: 30.0,
        session_m2: 2.0,
        session_time_s: 900.0,
    };
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let (mut epochs, mut column) = (Vec::new(), Vec::new());
    for sequence in 0..40 {
        let mut state = [2.0 * standard_normal(&mut rng), 2.0_f64.sqrt() * standard_normal(&mut rng)];
        for second in 0..250 {
            epochs.push(Epoch { time_s: f64::from(second), sequence });
            column.push(state[0] + state[1] + 0.5 * standard_normal(&mut rng));
            for (value, (variance_m2, time_s)) in state.iter_mut().zip([(4.0, 30.0), (2.0, 900.0)]) {
                let decay = f64::exp(-1.0 / time_s);
                *value = decay * *value
                    + f64::sqrt(variance_m2 * (1.0 - decay * decay)) * standard_normal(&mut rng);
            }
        }
    }
    ReceiverWhitener::new(&epochs, &noise, &vec![0.0; epochs.len()]).apply(&mut column);
    let count = column.len() as f64;
    let variance = column.iter().map(|value| value * value).sum::<f64>() / count;
    let correlation = column.windows(2).map(|pair| pair[0] * pair[1]).sum::<f64>() / count;
    // Four standard errors of 10,000 values.
    assert!((variance - 1.0).abs() < 0.06, "{variance}");
    assert!(correlation.abs() < 0.04, "{correlation}");
}

#[test]
fn subtracting_a_groups_gram_matrix_is_a_fit_without_it() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let kernel_columns = 6;
    let columns =
        DMatrix::from_fn(90, 2 * COEFFICIENTS + kernel_columns + 2, |_, _| standard_normal(&mut rng));
    let epochs: Vec<Epoch> =
        (0..90).map(|row| Epoch { time_s: f64::from(row), sequence: row as u32 / 30 }).collect();
    let noise = ReceiverNoise { short_m2: 1.0, short_time_s: 10.0, ..ReceiverNoise::white(0.5) };
    let gram = |rows: std::ops::Range<usize>| {
        let own = &epochs[rows.clone()];
        let whitener = ReceiverWhitener::new(own, &noise, &vec![0.0; own.len()]);
        Gram::new(columns.rows(rows.start, rows.len()).into_owned(), &whitener)
    };
    let prior = TangentPrior::independent(&[4.0; COEFFICIENTS]);
    let subtracted = Posterior::new(&gram(0..90).minus(&gram(60..90)), &prior).expect("positive definite");
    let direct = Posterior::new(&gram(0..60), &prior).expect("positive definite");
    let apart = (&subtracted.tangent - &direct.tangent).amax()
        + (&subtracted.kernel[0] - &direct.kernel[0]).amax()
        + (&subtracted.kernel[1] - &direct.kernel[1]).amax();
    assert!(apart < 1e-9, "{apart}");
}

#[test]
fn derivatives_by_the_edges_are_those_of_the_position() {
    let (rows, tests) = walkers(4000, 6, 100, 0.0);
    let (predictor, _) = fitted(&rows);
    for (sides, _) in tests.iter().step_by(40) {
        let mixture = predictor.mix(sides, true);
        let [u, v, width, height] = *sides;
        let edges = [u - 0.5 * width, v - height, u + 0.5 * width, v];
        for edge in 0..4 {
            let moved = |by_px: f64| {
                let mut edges = edges;
                edges[edge] += by_px;
                let [left, top, right, bottom] = edges;
                let sides = [0.5 * (left + right), bottom, right - left, bottom - top];
                predictor.mix(&sides, false).position_m
            };
            let (more, less) = (moved(0.01), moved(-0.01));
            for axis in 0..2 {
                let slope = (more[axis] - less[axis]) / 0.02;
                let apart = (slope - mixture.by_edge[axis][edge]).abs();
                assert!(apart < 1e-4 * (1.0 + slope.abs()), "edge {edge}, axis {axis}: {apart} of {slope}");
            }
        }
    }
}

fn stored(predictor: &Predictor) -> ModelParts {
    let plane = LocalPlane::new(crate::geo::Position::new(11.0, 48.0).expect("within range"));
    let mut parts = ModelParts::new(Recipe::GaussianProcess, plane, predictor.features(), 1.0);
    predictor.put(&mut parts);
    parts
}

/// A predictor from the bytes of its file.
fn loaded(predictor: &Predictor) -> Predictor {
    let mut parts = stored(predictor);
    let bytes = parts.tensors.to_bytes().expect("safetensors");
    parts.tensors = Tensors::from_bytes(&bytes).expect("its own file");
    let loaded = Predictor::take(&mut parts).expect("its own tensors");
    parts.tensors.finish().expect("every tensor is taken");
    loaded
}

#[test]
fn a_stored_model_answers_as_the_fitted_one_and_is_the_same_for_the_same_rows() {
    let (rows, tests) = walkers(4001, 8, 90, 1.0);
    let (predictor, _) = fitted(&rows);
    let parts = stored(&predictor);
    let bytes = parts.tensors.to_bytes().expect("safetensors");
    println!("{} bytes of {LARGEST_WEIGHTS_BYTES}", bytes.len());
    assert!(bytes.len() < LARGEST_WEIGHTS_BYTES);
    let again = stored(&fitted(&rows).0);
    assert_eq!(bytes, again.tensors.to_bytes().expect("safetensors"), "another fit, other bits");
    assert_eq!(parts.parameters, again.parameters);
    let loaded = loaded(&predictor);
    for (sides, _) in &tests {
        let (one, other) = (predictor.predict(sides, None), loaded.predict(sides, None));
        let [east_m, north_m] = [0, 1].map(|axis| one.position_m[axis] - other.position_m[axis]);
        assert!(east_m.hypot(north_m) < 1e-3, "{east_m} {north_m}");
        assert!((one.variance_m2() / other.variance_m2() - 1.0).abs() < 1e-2);
    }
}

/// Errors that two answers share are no part of the error of their distance.
#[test]
fn the_error_of_a_distance_vanishes_with_the_distance_and_is_bounded_by_those_of_its_ends() {
    let (rows, tests) = walkers(4001, 8, 90, 1.0);
    let (predictor, _) = fitted(&rows);
    let trace_m2 = |[east_m2, _, north_m2]: [f64; 3]| east_m2 + north_m2;
    let error_m2 = |from: usize, to: usize| {
        let [from, to] = [from, to].map(|at| &tests[at].0);
        trace_m2(predictor.displacement_m2([from, to]))
    };
    let map_m2 = |at: usize| predictor.widening * trace_m2(predictor.mix(&tests[at].0, true).map_m2);
    let mut below_independent = 0;
    for at in 0..tests.len() - 1 {
        let (one_m2, other_m2) = (map_m2(at), map_m2(at + 1));
        let between_m2 = error_m2(at, at + 1);
        // Cauchy-Schwarz.
        assert!(between_m2.sqrt() <= one_m2.sqrt() + other_m2.sqrt() + 1e-9, "{at}");
        below_independent += usize::from(between_m2 < one_m2 + other_m2);
        assert!(error_m2(at, at).abs() < 1e-12);
    }
    assert!(2 * below_independent > tests.len(), "errors of neighbours are alike");
}

#[test]
fn a_loaded_model_misses_its_own_rows_as_the_fit_has_reported() {
    for (seed, targets) in [(4002, 1), (4003, 2), (4004, 8)] {
        let (rows, _) = walkers(seed, targets, 90, 1.0);
        let (predictor, report) = fitted(&rows);
        assert_eq!(report.gross_errors, 0);
        let receiver_m2 = report.parameters.noise.variance_m2();
        let own_m2 = own_miss_m2(&loaded(&predictor), &rows, receiver_m2);
        println!(
            "{targets} targets: {own_m2:.4} of {:.4} m2; left out {:.4}",
            report.own_m2, report.held_out_m2
        );
        assert!((own_m2 / report.own_m2 - 1.0).abs() < 1e-3);
        assert!(report.own_m2 <= report.held_out_m2);
    }
}

#[test]
fn the_stated_radius_holds_where_every_receiver_keeps_a_bias() {
    let (mut covered, mut error_m, mut fewest) = (0.0, 0.0, 1.0_f64);
    let worlds = 6;
    for seed in 0..worlds {
        let targets = 6 + 2 * seed as usize;
        let (rows, tests) = walkers(4100 + seed, targets, 90, 1.5);
        let (predictor, report) = fitted(&rows);
        let (mean_m, inside) = score(&predictor, &tests, 0.0);
        println!(
            "{targets} targets: mean {mean_m:.2} m, {:.1} % inside; {:?}",
            100.0 * inside,
            report.candidates
        );
        covered += inside / worlds as f64;
        error_m += mean_m / worlds as f64;
        fewest = fewest.min(inside);
    }
    println!("mean {error_m:.2} m, {:.1} % inside", 100.0 * covered);
    assert!(covered >= 0.9 && fewest >= 0.6, "{covered} {fewest}");
    assert!(error_m < 1.3, "{error_m}");
}

#[test]
fn fixes_off_by_a_kilometre_change_the_map_by_a_twentieth_at_most() {
    let (rows, tests) = walkers(4200, 8, 120, 0.5);
    let (clean_m, clean_inside) = score(&fitted(&rows).0, &tests, 0.0);
    let mut wrong = rows.clone();
    for label in wrong.labels_m.iter_mut().step_by(20) {
        label[0] += 1_000.0;
    }
    let (predictor, report) = fitted(&wrong);
    let (mean_m, inside) = score(&predictor, &tests, 0.0);
    println!(
        "{clean_m:.3} m, {clean_inside:.2} inside; with gross errors {mean_m:.3} m, {inside:.2} inside, {} rows left out",
        report.gross_errors
    );
    assert!(mean_m <= 1.05 * clean_m + 0.02, "{clean_m} {mean_m}");
    assert!(report.gross_errors >= rows.boxes.len() / 25, "{}", report.gross_errors);
    assert!(inside >= clean_inside - 0.05, "{clean_inside} {inside}");
}

#[test]
fn a_box_unlike_training_gets_a_larger_radius_that_holds() {
    let (rows, tests) = walkers(4300, 8, 120, 0.0);
    let (predictor, _) = fitted(&rows);
    for grown_px in [10.0, 30.0] {
        let (mean_m, inside) = score(&predictor, &tests, grown_px);
        println!("grown by {grown_px} px: mean {mean_m:.2} m, {:.1} % inside", 100.0 * inside);
        assert!(inside > 0.9, "{inside}");
    }
}

#[test]
fn a_deviation_too_small_for_one_box_is_noticed_when_it_lasts() {
    let (rows, tests) = walkers(4400, 8, 120, 0.0);
    let (predictor, _) = fitted(&rows);
    let ([u, v, width, height], _) = tests[tests.len() / 2];
    let tall = |factor: f64| [u, v, width, height * factor];
    let weight = |factor: f64| predictor.predict(&tall(factor), None).deviation.weight;
    // The largest height that one box may have without being noticed.
    let factor =
        (0..200).map(|step| 1.0 + 0.002 * f64::from(step)).take_while(|factor| weight(*factor) <= 0.0);
    let tall = tall(factor.last().expect("the box itself"));
    let mut recent = RecentBoxes::default();
    let single = predictor.predict(&tall, None);
    let lasting = (0..10).map(|_| predictor.predict(&tall, Some(&mut recent))).last().expect("ten boxes");
    assert!(single.deviation.weight <= 0.0 && lasting.deviation.weight > 0.1, "{}", lasting.deviation.weight);
    assert!(lasting.variance_m2() > single.variance_m2());
}

/// Mean stated standard deviation per axis over boxes, m.
fn stated_m(predictor: &Predictor, tests: &[(Box4, [f64; 2])]) -> f64 {
    let sigma = |(sides, _): &(Box4, [f64; 2])| predictor.predict(sides, None).variance_m2().sqrt();
    tests.iter().map(sigma).sum::<f64>() / tests.len() as f64
}

#[test]
fn a_stated_bias_replaces_the_prior_of_the_only_receiver_in_its_only_session() {
    let (mut unknown_m, mut small_m, mut large_m, mut covered) = (0.0, 0.0, 0.0, 0.0);
    let worlds = 4;
    for seed in 0..worlds {
        let (rows, tests) = walkers(4500 + seed, 1, 600, 0.0);
        let with = |bias_sigma_m: Option<f64>| {
            let settings = FitSettings { bias_sigma_m, ..settings(None) };
            fit(&rows, &settings).expect("rows that determine a map").0
        };
        let small = with(Some(0.05));
        unknown_m += stated_m(&with(None), &tests) / worlds as f64;
        small_m += stated_m(&small, &tests) / worlds as f64;
        large_m += stated_m(&with(Some(3.0)), &tests) / worlds as f64;
        covered += score(&small, &tests, 0.0).1 / worlds as f64;
    }
    println!("sigma without a stated bias {unknown_m:.2} m, of 0.05 m {small_m:.2} m, of 3 m {large_m:.2} m");
    println!("with 0.05 m, which is true, {:.1} % inside", 100.0 * covered);
    // Within ten minutes a bias that decorrelates over an hour changes a little, so somewhat below 3 m.
    assert!(small_m < 0.95 * unknown_m && large_m > 2.4, "{unknown_m} {small_m} {large_m}");
    assert!(covered > 0.75, "{covered}");
}

#[test]
fn a_bias_that_several_receivers_share_is_added_to_the_answers() {
    let (rows, tests) = walkers(4510, 6, 60, 0.5);
    let with = |bias_sigma_m: Option<f64>| {
        let settings = FitSettings { bias_sigma_m, ..settings(None) };
        fit(&rows, &settings).expect("rows that determine a map").0
    };
    let (none_m2, stated_m2) = (
        with(Some(1e-3)).predict(&tests[0].0, None).variance_m2(),
        with(Some(2.0)).predict(&tests[0].0, None).variance_m2(),
    );
    assert!((stated_m2 - none_m2 - 4.0).abs() < 1e-3, "{none_m2} {stated_m2}");
}

#[test]
fn more_receivers_are_worth_more_degrees_of_freedom() {
    let freedom = |receivers: usize| fitted(&walkers(4520, receivers, 200, 0.8).0).1.freedom;
    let (one, twelve) = (freedom(1), freedom(12));
    println!("{one:.1} degrees of freedom of one receiver, {twelve:.1} of twelve");
    assert!(one >= 4.0 && twelve > one, "{one} {twelve}");
}

#[test]
fn a_receiver_whose_error_is_white_keeps_no_bias() {
    let options = Options { seed: 4600, camera_seed: 4600, samples: 3_000, ..Options::new(Scene::Airport) };
    let world = simulate(&options);
    let plane = LocalPlane::new(world.rows[0].truth);
    let mut rows = MapRows::default();
    for sample in world.training_samples() {
        let EastNorth { east_m, north_m } = plane.to_plane(sample.fix.position);
        rows.epochs.push(Epoch { time_s: sample.time.as_microsecond() as f64 * 1e-6, sequence: 0 });
        rows.boxes.push(features_of(&sample.bounding_box));
        rows.labels_m.push([east_m, north_m]);
    }
    let settings = FitSettings { white_share: 1.0, ..settings(None) };
    let (_, report) = fit(&rows, &settings).expect("rows that determine a map");
    let receiver = report.receiver;
    println!("{receiver:?}");
    // Parts of an error of 29.5 m per axis.
    assert!(receiver.session_m2.sqrt() < 1.5, "{receiver:?}");
    assert!(receiver.white_m2.sqrt() > 25.0, "{receiver:?}");
}

#[test]
fn boxes_without_a_fix_sharpen_the_geometry_of_few_receivers() {
    let (mut paired_m, mut all_m) = (0.0, 0.0);
    for seed in 4700..4704 {
        let (rows, tests) = walkers(seed, 20, 40, 1.5);
        let few: Vec<usize> = (0..rows.boxes.len()).filter(|row| rows.epochs[*row].sequence < 2).collect();
        let paired = rows.picked(&few);
        let upright = |rows: &MapRows| {
            let boxes: Vec<(u32, Box4)> =
                rows.epochs.iter().zip(&rows.boxes).map(|(epoch, sides)| (epoch.sequence, *sides)).collect();
            UprightCamera::new(&boxes, IMAGE_PX, PERSON_M)
        };
        let error_m = |upright: Option<UprightCamera>| {
            let (predictor, _) = fit(&paired, &settings(upright)).expect("rows that determine a map");
            score(&predictor, &tests, 0.0).0
        };
        let (with_paired_m, with_all_m) = (error_m(upright(&paired)), error_m(upright(&rows)));
        println!("two receivers: {with_paired_m:.2} m, with the boxes of 18 others {with_all_m:.2} m");
        paired_m += with_paired_m / 4.0;
        all_m += with_all_m / 4.0;
    }
    println!("mean {paired_m:.2} m, with all boxes {all_m:.2} m");
    assert!(all_m < paired_m, "{all_m} {paired_m}");
}

/// Frigate says `person`, ONVIF and Axis `Human`, DeepStream `Person`, KITTI `Pedestrian` and `Car`.
#[test]
fn heights_are_known_by_the_names_of_all_detectors() {
    let height_m = |class: &str| {
        let class = TargetClass::new(class).expect("a class");
        super::target_height_m(std::iter::repeat_n(Some(&class), 3)).0
    };
    for (class, expected) in
        [("person", 1.70), ("Human", 1.70), ("Person", 1.70), ("Pedestrian", 1.70), ("Car", 1.50)]
    {
        let class = TargetClass::new(class).expect("a class");
        assert!(super::GroundCamera::knows_height_of(&class), "{class:?}");
        assert_eq!(height_m(class.as_str()), expected, "{class:?}");
    }
    assert!(!super::GroundCamera::knows_height_of(&TargetClass::new("ship").expect("a class")));
}

/// Four boxes far apart from each other, as an operator would click places.
fn known_points(tests: &[(Box4, [f64; 2])], sigma_m: f64) -> Vec<KnownFoot> {
    let along = |weights: [f64; 2]| {
        let of = |(sides, _): &&(Box4, [f64; 2])| weights[0] * sides[0] + weights[1] * sides[1];
        tests.iter().max_by(|one, other| of(one).total_cmp(&of(other))).expect("boxes")
    };
    let corners = [[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]].map(along);
    let point = |([u, v, ..], truth_m): &(Box4, [f64; 2])| KnownFoot {
        image_px: [*u, *v],
        position_m: *truth_m,
        variance_m2: sigma_m * sigma_m,
    };
    corners.map(point).to_vec()
}

#[test]
fn known_points_take_away_the_bias_of_one_receiver_and_a_wrong_one_does_little() {
    let (mut without_m, mut with_m, mut wrong_m, mut covered, mut stated) = (0.0, 0.0, 0.0, 0.0, [0.0; 2]);
    let worlds = 6;
    for seed in 0..worlds {
        let (rows, tests) = walkers(4800 + seed, 1, 600, 2.0);
        let fitted = |known: Vec<KnownFoot>| {
            let settings = FitSettings { known, ..settings(None) };
            fit(&rows, &settings).expect("rows that determine a map").0
        };
        let points = known_points(&tests, 0.3);
        let mut one_wrong = points.clone();
        one_wrong[0].position_m[0] += 30.0;
        let (plain, with, wrong) = (fitted(Vec::new()), fitted(points), fitted(one_wrong));
        without_m += score(&plain, &tests, 0.0).0 / worlds as f64;
        let (error_m, inside) = score(&with, &tests, 0.0);
        with_m += error_m / worlds as f64;
        covered += inside / worlds as f64;
        wrong_m += score(&wrong, &tests, 0.0).0 / worlds as f64;
        stated[0] += stated_m(&plain, &tests) / worlds as f64;
        stated[1] += stated_m(&with, &tests) / worlds as f64;
    }
    println!(
        "{without_m:.2} m, with four points {with_m:.2} m ({covered:.2} inside), one wrong {wrong_m:.2} m"
    );
    println!("stated per axis {:.2} m, with four points {:.2} m", stated[0], stated[1]);
    assert!(with_m < 0.5 * without_m && wrong_m < 0.8 * without_m, "{without_m} {with_m} {wrong_m}");
    assert!(covered > 0.85 && stated[1] < 0.6 * stated[0], "{covered} {stated:?}");
}
