//! Properties of simulated worlds.

use super::*;
use crate::geo::{EastNorth, distance_m};
use crate::{AirportForm, Scene, TargetShape};

fn plane_of(scene: Scene, position: Position) -> EastNorth {
    LocalPlane::new(scene.origin()).to_plane(position)
}

fn gnss_errors_m(world: &World) -> Vec<f64> {
    let error = |row: &SimulatedRow| Some(distance_m(row.fix?.position, row.truth));
    world.rows.iter().filter_map(error).collect()
}

#[test]
fn the_airport_has_the_papers_noise_and_rows() {
    let (train, test) = simulate_split(&Options::default(), 400);
    assert_eq!((train.rows.len(), test.rows.len()), (10_000, 400));
    let errors_m = gnss_errors_m(&train);
    let mean_m = errors_m.iter().sum::<f64>() / errors_m.len() as f64;
    // A Rayleigh mean is sigma times sqrt(pi / 2): 36.97 m, known here to 0.5 %.
    assert!((mean_m - 36.97).abs() < 0.8, "{mean_m}");
    assert_eq!(train.training_samples().len(), 10_000);
}

#[test]
fn a_world_is_a_function_of_its_options() {
    for &scene in Scene::ALL {
        let options = Options { samples: 300, ..Options::new(scene) };
        assert_eq!(simulate(&options), simulate(&options));
        let other = simulate(&Options { seed: 2, ..options.clone() });
        assert_ne!(simulate(&options).rows, other.rows);
    }
}

#[test]
fn every_box_is_in_its_image_and_far_targets_are_smaller() {
    for &scene in Scene::ALL {
        let world = simulate(&Options { samples: 2_000, border_cuts: false, ..Options::new(scene) });
        assert_eq!(world.rows.len(), 2_000, "{scene}");
        let mut by_distance: Vec<(f64, f64)> = Vec::new();
        for row in &world.rows {
            let bounding_box =
                row.bounding_box.expect("nothing is occluded").within(world.image_size).expect("inside");
            assert!(!bounding_box.touches_border(Some(world.image_size)));
            let position = plane_of(scene, row.truth);
            by_distance.push((position.distance_m(EastNorth::default()), bounding_box.height_px()));
        }
        by_distance.sort_by(|one, other| one.0.total_cmp(&other.0));
        assert!(by_distance[0].1 > 1.3 * by_distance[1_999].1, "{scene} {by_distance:?}");
    }
}

#[test]
fn the_whole_line_is_in_the_view_of_every_square_camera() {
    for camera_seed in 0..20 {
        let options = Options { samples: 200, camera_seed, ..Options::new(Scene::Square) };
        let world = simulate(&options);
        let plane = LocalPlane::new(Scene::Square.origin());
        for end in [world.truth_lines[0][0], world.truth_lines[0][2]] {
            let nearest_m = world
                .rows
                .iter()
                .map(|row| plane.to_plane(row.truth).distance_m(plane.to_plane(end)))
                .fold(f64::INFINITY, f64::min);
            assert!(nearest_m < 3.0, "camera {camera_seed} misses an end by {nearest_m} m");
        }
    }
}

#[test]
fn each_option_has_its_effect() {
    let base = Options { samples: 4_000, targets: 3, ..Options::new(Scene::Square) };
    let plain = simulate(&base);
    let ids: std::collections::BTreeSet<_> = plain.rows.iter().map(|row| row.target_id.as_str()).collect();
    assert_eq!(ids.len(), 3);
    assert!(plain.rows.windows(2).all(|pair| pair[0].time <= pair[1].time));
    let share = |world: &World, holds: &dyn Fn(&SimulatedRow) -> bool| {
        world.rows.iter().filter(|row| holds(row)).count() as f64 / world.rows.len() as f64
    };
    let gaps = simulate(&Options { gnss_gaps: 0.2, ..base.clone() });
    let without_fix = share(&gaps, &|row| row.fix.is_none());
    assert!((0.1..0.3).contains(&without_fix), "{without_fix}");
    // Gaps do not change the boxes.
    assert!(gaps.rows.iter().zip(&plain.rows).all(|(one, other)| one.bounding_box == other.bounding_box));
    let occluded = simulate(&Options { occlusion: 0.2, ..base.clone() });
    let without_box = share(&occluded, &|row| row.bounding_box.is_none());
    assert!((0.03..0.12).contains(&without_box), "{without_box}");
    let outliers = simulate(&Options { outliers: 0.1, ..base.clone() });
    let far = gnss_errors_m(&outliers).iter().filter(|&&error_m| error_m > 10.0).count() as f64;
    assert!((0.03..0.07).contains(&(far / 4_000.0)), "{far}");
    let cuts = simulate(&Options { border_cuts: true, ..base });
    let cut = share(&cuts, &|row| row.bounding_box.is_some_and(|b| b.touches_border(Some(cuts.image_size))));
    assert!(cut > 0.02, "{cut}");
}

#[test]
fn a_rotated_camera_shifts_its_boxes_from_that_instant_on() {
    let base = Options { samples: 600, ..Options::new(Scene::Square) };
    let plain = simulate(&base);
    let from = plain.rows[300].time;
    let rotated = simulate(&Options { pan_deg_from: Some((from, 2.0)), ..base });
    for (one, other) in plain.rows.iter().zip(&rotated.rows).take(300) {
        assert_eq!(one, other);
    }
    let shift_px = plain.rows[300].bounding_box.expect("seen").foot_px()[0]
        - rotated.rows[300].bounding_box.expect("seen").foot_px()[0];
    // 2 degrees at a focal length of about 1,080 px, rotated to the right: the image shifts to the left.
    assert!((30.0..60.0).contains(&shift_px), "{shift_px}");
}

#[test]
fn a_standing_target_does_not_move_and_a_new_line_is_new() {
    let base = Options { samples: 450, ..Options::new(Scene::Square) };
    let standing = simulate(&Options { route: Route::Standing, ..base.clone() });
    let point = standing.truth_point.expect("standing");
    assert!(standing.rows.iter().all(|row| distance_m(row.truth, point) < 1e-6));
    let plain = simulate(&base);
    let new_line = simulate(&Options { route: Route::NewLine, ..base });
    assert!(distance_m(plain.truth_lines[0][0], new_line.truth_lines[0][0]) > 1.9);
}

/// Mean error of the fixes of every target and day, m.
fn mean_errors(world: &World) -> std::collections::BTreeMap<(usize, i64), EastNorth> {
    let mut sums = std::collections::BTreeMap::new();
    for row in &world.rows {
        let Some(fix) = row.fix else { continue };
        let error = LocalPlane::new(row.truth).to_plane(fix.position);
        let (sum, count) =
            sums.entry((row.target, row.time.as_second() / 86_400)).or_insert((EastNorth::default(), 0.0));
        sum.east_m += error.east_m;
        sum.north_m += error.north_m;
        *count += 1.0;
    }
    let mean = |(sum, count): (EastNorth, f64)| EastNorth {
        east_m: sum.east_m / count,
        north_m: sum.north_m / count,
    };
    sums.into_iter().map(|(key, sum)| (key, mean(sum))).collect()
}

#[test]
fn a_receiver_keeps_its_bias_for_a_session_and_no_longer() {
    let base = Options {
        samples: 1_200,
        targets: 3,
        sessions: 2,
        gnss_sigma_m: 0.2,
        gnss_bias_sigma_m: 5.0,
        ..Options::new(Scene::Square)
    };
    let world = simulate(&base);
    assert_eq!(world.rows.len(), 1_200);
    assert!(world.rows.windows(2).all(|pair| pair[0].time <= pair[1].time));
    let biases = mean_errors(&world);
    assert_eq!(biases.len(), 6, "three receivers on two days: {biases:?}");
    for row in &world.rows {
        let error = LocalPlane::new(row.truth).to_plane(row.fix.expect("no gaps").position);
        let bias = biases[&(row.target, row.time.as_second() / 86_400)];
        assert!(error.distance_m(bias) < 1.2, "{error:?} {bias:?}");
    }
    let all: Vec<EastNorth> = biases.into_values().collect();
    for (index, one) in all.iter().enumerate() {
        assert!(all[index + 1..].iter().all(|other| one.distance_m(*other) > 0.5), "{all:?}");
    }
    // The bias changes the fixes alone, and the first session is the world of one session.
    let unbiased = simulate(&Options { gnss_bias_sigma_m: 0.0, sessions: 1, samples: 600, ..base });
    for (one, other) in world.rows.iter().zip(&unbiased.rows) {
        assert_eq!((one.time, one.bounding_box, one.truth), (other.time, other.bounding_box, other.truth));
    }
}

#[test]
fn the_foot_of_a_large_target_is_far_from_its_antenna_depending_on_the_aspect() {
    let shape = TargetShape {
        length_m: 37.0,
        width_m: 34.0,
        height_m: 12.0,
        antenna_ahead_m: 14.0,
        antenna_left_m: 0.0,
    };
    // Columns between the foot of the box and the antenna's place on the ground, by heading.
    let offsets_px = |target_shape| {
        let options =
            Options { target_shape, samples: 1_500, box_noise_px: 0.0, ..Options::new(Scene::Airport) };
        let camera = options.camera(&mut stream(1, 0));
        let plane = LocalPlane::new(Scene::Airport.origin());
        let offset = |row: &SimulatedRow| {
            let seen = row.bounding_box.filter(|seen| !seen.touches_border(Some(camera.image_size)))?;
            let ground = plane.to_plane(row.truth);
            let antenna_px = camera.project(crate::camera::Point { ground, up_m: 0.0 })?;
            Some(seen.foot_px()[0] - antenna_px[0])
        };
        let offsets: Vec<f64> = simulate(&options).rows.iter().filter_map(offset).collect();
        let (low, high) = offsets
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &one| (low.min(one), high.max(one)));
        high - low
    };
    let (nominal_px, large_px) = (offsets_px(None), offsets_px(Some(shape)));
    println!("range of the offset: nominal {nominal_px:.1} px, antenna 14 m ahead {large_px:.1} px");
    assert!(large_px > nominal_px + 20.0, "{nominal_px} {large_px}");
    // A scene's own shape is the scene's target.
    let own = Options { samples: 300, ..Options::new(Scene::Airport) };
    let stated = Options { target_shape: Some(Scene::Airport.nominal_shape()), ..own.clone() };
    assert_eq!(simulate(&own).rows, simulate(&stated).rows);
}

#[test]
fn a_tracker_breaks_ids_and_gives_them_to_others() {
    let base = Options { samples: 2_400, targets: 8, route: Route::Area, ..Options::new(Scene::Square) };
    let stable = simulate(&base);
    let broken = simulate(&Options { tracker_id_lifetime_s: Some(20.0), ..base });
    let mut targets_of: std::collections::BTreeMap<&str, std::collections::BTreeSet<usize>> =
        std::collections::BTreeMap::new();
    let mut ids_of = vec![std::collections::BTreeSet::new(); 8];
    let mut at_once = std::collections::BTreeSet::new();
    for (row, same) in broken.rows.iter().zip(&stable.rows) {
        targets_of.entry(row.target_id.as_str()).or_default().insert(row.target);
        ids_of[row.target].insert(row.target_id.as_str());
        assert!(at_once.insert((row.time, row.target_id.as_str())), "an id stands for one target at a time");
        // Nothing but the ids differs.
        assert_eq!(SimulatedRow { target_id: same.target_id.clone(), ..row.clone() }, *same);
    }
    let shared = targets_of.values().filter(|targets| targets.len() > 1).count();
    println!("{} ids for 8 targets, {shared} of them for several", targets_of.len());
    assert!(ids_of.iter().all(|ids| ids.len() > 2), "{ids_of:?}");
    assert!(2 * shared > targets_of.len(), "{targets_of:?}");
}

#[test]
fn gross_errors_and_cut_boxes_are_where_they_were_asked_for() {
    let base = Options { samples: 2_000, ..Options::new(Scene::Airport) };
    let plain = simulate(&base);
    let gross = simulate(&Options { gross_fixes: 0.05, ..base.clone() });
    let mut far = 0;
    for (one, other) in gross.rows.iter().zip(&plain.rows) {
        assert_eq!(one.bounding_box, other.bounding_box);
        let moved_m = distance_m(one.fix.expect("a fix").position, other.fix.expect("a fix").position);
        assert!(moved_m == 0.0 || (moved_m - 1_000.0).abs() < 1.0, "{moved_m}");
        far += usize::from(moved_m > 0.0);
    }
    assert!((60..140).contains(&far), "{far} of 2,000");
    let is_cut = |world: &World| {
        let size = Some(world.image_size);
        world.rows.iter().any(|row| row.bounding_box.is_some_and(|seen| seen.touches_border(size)))
    };
    let (train, test) = simulate_split(&Options { without_cut_boxes: true, ..base }, 400);
    assert!(!is_cut(&train) && is_cut(&test));
}

#[test]
fn targets_of_an_area_cover_it() {
    for &scene in Scene::ALL {
        let world = simulate(&Options { route: Route::Area, samples: 2_000, ..Options::new(scene) });
        assert_eq!(world.rows.len(), 2_000, "{scene}");
        assert!(world.truth_lines.is_empty());
        let ahead_m: Vec<f64> = world
            .rows
            .iter()
            .map(|row| plane_of(scene, row.truth).distance_m(EastNorth::default()))
            .collect();
        let (near_m, far_m) =
            ahead_m.iter().fold((f64::INFINITY, 0.0_f64), |(near, far), &one| (near.min(one), far.max(one)));
        assert!(far_m > 2.0 * near_m, "{scene} {near_m} {far_m}");
    }
}

#[test]
fn every_form_of_the_airport_has_boxes_of_its_own_on_the_same_truth_or_other_lines() {
    let base = Options { samples: 600, border_cuts: false, ..Options::new(Scene::Airport) };
    let plain = simulate(&base);
    let boxes = |world: &World| -> Vec<_> { world.rows.iter().map(|row| row.bounding_box).collect() };
    for &airport_form in AirportForm::ALL {
        let world = simulate(&Options { airport_form, ..base.clone() });
        assert_eq!(world.rows.len(), 600, "{airport_form}");
        assert_eq!(airport_form == AirportForm::Plain, boxes(&world) == boxes(&plain), "{airport_form}");
        let has_own_lines = [AirportForm::Telephoto, AirportForm::CurvedRunway].contains(&airport_form);
        assert_eq!(has_own_lines, world.truth_lines != plain.truth_lines, "{airport_form}");
        assert_eq!(airport_form.to_string().parse::<AirportForm>().expect("its name"), airport_form);
    }
}

#[test]
fn a_slope_raises_what_stands_on_its_right_side() {
    let options =
        Options { samples: 600, border_cuts: false, box_noise_px: 0.0, ..Options::new(Scene::Airport) };
    let slope = Options { airport_form: AirportForm::Slope, ..options.clone() };
    let of_both = simulate(&options).rows.into_iter().zip(simulate(&slope).rows);
    let mut compared = 0;
    for (flat, raised) in of_both.take_while(|(flat, raised)| flat.truth == raised.truth) {
        let [flat, raised] = [flat, raised].map(|row| row.bounding_box.expect("a box").foot_px());
        // The middle of the image is on the optical axis; the antenna is some metres from the foot.
        if (flat[0] - 960.0).abs() > 200.0 {
            assert_eq!(flat[0] > 960.0, raised[1] < flat[1], "{flat:?} {raised:?}");
            compared += 1;
        }
    }
    assert!(compared > 10, "{compared}");
}

#[test]
fn a_receiver_with_a_time_constant_errs_alike_from_second_to_second() {
    let white = Options { samples: 600, gnss_sigma_m: 6.0, ..Options::new(Scene::Airport) };
    let coloured = Options { gnss_time_constant_s: Some(45.0), ..white.clone() };
    let change_m = |options: &Options| {
        let errors_m = gnss_errors_m(&simulate(options));
        let changes = errors_m.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        changes.sum::<f64>() / (errors_m.len() - 1) as f64
    };
    assert!(4.0 * change_m(&coloured) < change_m(&white));
}
