//! A site of known cameras: what the fit recovers, and whether its stated errors are honest.

use super::*;
use crate::domain::{BoundingBox, GaussMarkovNoise, ImageSize, NoiseCorrelation};
use crate::geo::EastNorth;
use crate::simulation::{SimulatedReceiver, standard_normal, stream};

const CORRELATION: NoiseCorrelation = NoiseCorrelation { white_share: 0.08, time_constant_s: 30.0 };
const FOOT_SIGMA_PX: f64 = 2.0;

/// A pinhole camera on a mast, 7 m high, looking north from (east, 0), 13 degrees down.
fn foot_px(east_m: f64, at: EastNorth) -> [f64; 2] {
    let (sin_tilt, cos_tilt) = 13.0f64.to_radians().sin_cos();
    let depth_m = cos_tilt * at.north_m + sin_tilt * 7.0;
    let below_m = cos_tilt * 7.0 - sin_tilt * at.north_m;
    [640.0 + 1000.0 * (at.east_m - east_m) / depth_m, 360.0 + 1000.0 * below_m / depth_m]
}

fn is_in_view([u, v]: [f64; 2]) -> bool {
    (30.0..1250.0).contains(&u) && (30.0..700.0).contains(&v)
}

struct World {
    fixes: Vec<SiteFix>,
    pairs: Vec<SitePair>,
    /// Camera, box and true position.
    boxes: Vec<(usize, BoundingBox, EastNorth)>,
}

/// Walkers with phones that cross the views of two cameras 10 m apart.
fn world(seed: u64) -> World {
    world_with(seed, 0.0)
}

/// The same with an error of each person's foot in each camera that does not change, of that standard deviation per axis.
fn world_with(seed: u64, lasting_sigma_px: f64) -> World {
    let mut lasting = stream(seed, 1);
    let mut random = stream(seed, 0);
    let mut world = World { fixes: Vec::new(), pairs: Vec::new(), boxes: Vec::new() };
    for receiver in 0..12 {
        let error = GaussMarkovNoise::new(2.6, CORRELATION);
        let mut phone = SimulatedReceiver::seeded(error, seed, 100 + u64::from(receiver));
        let north_m = 14.0 + 1.6 * f64::from(receiver);
        let lasting_px: [[f64; 2]; 2] =
            std::array::from_fn(|_| [0; 2].map(|_| lasting_sigma_px * standard_normal(&mut lasting)));
        for second in 0..30 {
            let truth = EastNorth { east_m: -12.0 + 1.3 * f64::from(second), north_m };
            let mut boxes = Vec::new();
            for (camera, east_m) in [0.0, 10.0].into_iter().enumerate() {
                let mut foot = foot_px(east_m, truth);
                if !is_in_view(foot) {
                    continue;
                }
                foot = foot.map(|side| side + FOOT_SIGMA_PX * standard_normal(&mut random));
                foot = [0, 1].map(|axis| foot[axis] + lasting_px[camera][axis]);
                let bounding_box =
                    BoundingBox::new(foot[0] - 10.0, foot[1] - 60.0, 20.0, 60.0).expect("valid");
                boxes.push((camera, bounding_box));
                world.boxes.push((camera, bounding_box, truth));
            }
            if let [one, other] = boxes[..] {
                let (cameras, boxes) = ([one.0, other.0], [one.1, other.1]);
                world.pairs.push(SitePair { target: receiver, time_s: f64::from(second), cameras, boxes });
            }
            let position = phone.measure(truth, 1.0);
            if !boxes.is_empty() {
                world.fixes.push(SiteFix { receiver, time_s: f64::from(second), position, boxes });
            }
        }
    }
    world
}

fn fitted(world: &World, pairs: &[SitePair]) -> SiteMaps {
    fitted_with(world, pairs, &[])
}

fn fitted_with(world: &World, pairs: &[SitePair], known_points: &[SiteKnownPoint]) -> SiteMaps {
    let size = Some(ImageSize::new(1280, 720).expect("valid"));
    let input = SiteFitInput {
        image_sizes: &[size, size],
        fixes: &world.fixes,
        pairs,
        known_points,
        correlation: CORRELATION,
    };
    fit_site(&input).expect("a solution")
}

fn disagreement_m(maps: &SiteMaps, world: &World) -> f64 {
    let apart = |pair: &SitePair| {
        let [one, other] = [0, 1].map(|at| maps.locate(pair.cameras[at], &pair.boxes[at]).position);
        one.distance_m(other)
    };
    world.pairs.iter().map(apart).sum::<f64>() / world.pairs.len() as f64
}

#[test]
fn cameras_that_are_held_to_each_other_agree() {
    let (mut held_m, mut free_m) = (0.0, 0.0);
    for seed in 1..=3 {
        let world = world(seed);
        let held = fitted(&world, &world.pairs);
        held_m += disagreement_m(&held, &world);
        free_m += disagreement_m(&fitted(&world, &[]), &world);
        assert!((held.foot_sigma_px() / FOOT_SIGMA_PX - 1.0).abs() < 0.4, "{}", held.foot_sigma_px());
    }
    println!("{:.3} m, {:.3} m without pairs", held_m / 3.0, free_m / 3.0);
    // The boxes' own noise is in both.
    assert!(held_m < free_m, "{held_m} {free_m}");
}

/// Over redrawn errors, 95 % of true positions lie within the stated ellipse, and the difference of two cameras
/// within that of the parts which they do not share.
#[test]
fn the_stated_parts_of_the_error_are_honest() {
    let (mut inside, mut relative_inside) = ([0.0, 0.0], [0.0, 0.0]);
    for seed in 1..=12 {
        let world = world(seed);
        let maps = fitted(&world, &world.pairs);
        for (camera, bounding_box, truth) in &world.boxes {
            let located = maps.locate(*camera, bounding_box);
            let error = located.position.minus(*truth);
            inside[0] += f64::from(u8::from(located.covariance_m2().mahalanobis_squared(error) <= 5.99));
            inside[1] += 1.0;
        }
        for pair in &world.pairs {
            let [one, other] = [0, 1].map(|at| maps.locate(pair.cameras[at], &pair.boxes[at]));
            let parts = |it: &SitePosition| it.box_noise_m2.plus(it.lasting_noise_m2).plus(it.relative_m2);
            let covariance = parts(&one).plus(parts(&other));
            let squared = covariance.mahalanobis_squared(one.position.minus(other.position));
            relative_inside[0] += f64::from(u8::from(squared <= 5.99));
            relative_inside[1] += 1.0;
            assert!(one.common_m2.per_axis_m2() > 0.05, "{one:?}");
        }
    }
    let [coverage, relative] = [inside, relative_inside].map(|[hits, all]| hits / all);
    println!("coverage {coverage:.3}, of differences between cameras {relative:.3}");
    assert!((0.8..=1.0).contains(&coverage), "{coverage}");
    assert!((0.85..=1.0).contains(&relative), "{relative}");
}

#[test]
fn the_lasting_part_of_the_feet_is_told_from_the_noise() {
    let share_of = |lasting_px| {
        let shares = (1..=6).map(|seed| {
            let world = world_with(seed, lasting_px);
            fitted(&world, &world.pairs).foot_lasting_share()
        });
        shares.sum::<f64>() / 6.0
    };
    let (of_noise, of_both) = (share_of(0.0), share_of(FOOT_SIGMA_PX));
    println!("share {of_noise:.3} of white noise, {of_both:.3} where half of the variance lasts");
    assert!(of_noise < 0.1, "{of_noise}");
    // The maps follow a part of what lasts: twelve people cross the view.
    assert!((0.25..0.6).contains(&of_both), "{of_both}");
}

#[test]
fn a_camera_without_fixes_is_fitted_by_its_neighbour() {
    let world = world(4);
    let only_first = |fix: &SiteFix| {
        let boxes: Vec<(usize, BoundingBox)> =
            fix.boxes.iter().copied().filter(|(camera, _)| *camera == 0).collect();
        (!boxes.is_empty()).then(|| SiteFix { boxes, ..fix.clone() })
    };
    let fixes = world.fixes.iter().filter_map(only_first).collect();
    let one_sided = World { fixes, pairs: world.pairs.clone(), boxes: Vec::new() };
    let maps = fitted(&one_sided, &one_sided.pairs);
    assert!(disagreement_m(&maps, &one_sided) < 0.5);
    let size = [None, None];
    let input = SiteFitInput {
        image_sizes: &size,
        fixes: &one_sided.fixes,
        pairs: &[],
        known_points: &[],
        correlation: CORRELATION,
    };
    assert_eq!(fit_site(&input).err(), Some(SiteFitError::TooFewRows { camera: 1 }));
}

/// Exact fixes beside boxes that scatter: the feet's noise is no reason to bend a map.
#[test]
fn the_noise_of_the_feet_does_not_bend_the_maps() {
    let (mut sum_m, mut count) = (0.0, 0.0);
    for seed in 1..=4 {
        let mut world = world(seed);
        for fix in &mut world.fixes {
            let own = world.boxes.iter().find(|(camera, own, _)| (*camera, *own) == fix.boxes[0]);
            fix.position = own.expect("a box of the world").2;
        }
        let maps = fitted(&world, &world.pairs);
        for (camera, _, truth) in &world.boxes {
            let [u, v] = foot_px(if *camera == 0 { 0.0 } else { 10.0 }, *truth);
            let exact = BoundingBox::new(u - 10.0, v - 60.0, 20.0, 60.0).expect("valid");
            sum_m += maps.locate(*camera, &exact).position.distance_m(*truth);
            count += 1.0;
        }
    }
    let mean_m: f64 = sum_m / count;
    println!("{mean_m:.3} m");
    // Without the noise of the feet the mean is 0.33 m.
    assert!(mean_m < 0.2, "{mean_m}");
}

/// What all receivers have in common is seen by four known points of one camera, in both cameras.
#[test]
fn known_points_of_one_camera_take_the_bias_away_from_both() {
    let bias = EastNorth { east_m: 2.0, north_m: -1.5 };
    let (mut without_m, mut with_m, mut wrong_m) = (0.0, 0.0, 0.0);
    for seed in 1..=4 {
        let mut world = world(seed);
        for fix in &mut world.fixes {
            fix.position.east_m += bias.east_m;
            fix.position.north_m += bias.north_m;
        }
        let error_m = |maps: &SiteMaps| {
            let apart = |(camera, own, truth): &(usize, BoundingBox, EastNorth)| {
                maps.locate(*camera, own).position.distance_m(*truth)
            };
            world.boxes.iter().map(apart).sum::<f64>() / world.boxes.len() as f64 / 4.0
        };
        let of_first: Vec<_> = world.boxes.iter().filter(|(camera, ..)| *camera == 0).collect();
        let point = |(_, _, truth): &&(usize, BoundingBox, EastNorth)| SiteKnownPoint {
            camera: 0,
            image_px: foot_px(0.0, *truth),
            position: *truth,
            variance_m2: 0.04,
        };
        let mut points: Vec<SiteKnownPoint> =
            of_first.iter().step_by(of_first.len() / 6).map(point).collect();
        without_m += error_m(&fitted(&world, &world.pairs));
        with_m += error_m(&fitted_with(&world, &world.pairs, &points));
        points[0].position.east_m += 40.0;
        wrong_m += error_m(&fitted_with(&world, &world.pairs, &points));
    }
    println!("{without_m:.2} m, with known points {with_m:.2} m, one of them wrong {wrong_m:.2} m");
    assert!(with_m < 0.5 * without_m && wrong_m < 0.6 * without_m, "{without_m} {with_m} {wrong_m}");
}
