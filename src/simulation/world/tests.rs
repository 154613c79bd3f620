//! Properties of simulated worlds.

use super::*;
use crate::geo::{EastNorth, distance_m};
use crate::simulation::Scene;

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
