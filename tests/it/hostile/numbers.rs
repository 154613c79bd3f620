//! Poles, antimeridian, huge and denormal numbers.

use proptest::prelude::*;
use sightfix::domain::{Receivers, TimeBounds};
use sightfix::exchange::wire;
use sightfix::geo::{EastNorth, LocalPlane, Position, distance_m};

use super::targets::check_fusion;

/// Numbers at which arithmetic changes its ways.
fn edge() -> impl Strategy<Value = f64> {
    let edges = [
        0.0,
        -0.0,
        f64::MIN_POSITIVE,
        5e-324,
        -5e-324,
        f64::EPSILON,
        1.0,
        -1.0,
        1e38,
        1e39,
        f64::MAX,
        f64::MIN,
        f64::INFINITY,
        f64::NEG_INFINITY,
        f64::NAN,
        1e-39,
        1e9,
        1e15,
    ];
    prop_oneof![prop::sample::select(edges.to_vec()), any::<f64>(), -2e4..2e4]
}

fn longitude() -> impl Strategy<Value = f64> {
    let edges = [-180.0, 180.0, 179.999_999_999, -179.999_999_999, 0.0, 5e-324, 180.0_f64.next_up(), 103.98];
    prop_oneof![3 => prop::sample::select(edges.to_vec()), 3 => -180.0..=180.0_f64, 1 => edge()]
}

fn latitude() -> impl Strategy<Value = f64> {
    let edges = [-90.0, 90.0, 89.999_999_999, -89.999_999_999, 0.0, 5e-324, 90.0_f64.next_up(), 30.628];
    prop_oneof![3 => prop::sample::select(edges.to_vec()), 3 => -90.0..=90.0_f64, 1 => edge()]
}

fn position() -> impl Strategy<Value = Position> {
    (longitude(), latitude())
        .prop_filter_map("on the earth", |(longitude, latitude)| Position::new(longitude, latitude).ok())
}

fn wire_box() -> impl Strategy<Value = wire::BoundingBox> {
    let side = || prop_oneof![edge(), 0.0..2_000.0_f64];
    (side(), side(), side(), side()).prop_map(|(left_px, top_px, width_px, height_px)| wire::BoundingBox {
        left_px,
        top_px,
        width_px,
        height_px,
    })
}

fn wire_fix() -> impl Strategy<Value = wire::Fix> {
    (longitude(), latitude(), prop::option::of(edge()))
        .prop_map(|(longitude_deg, latitude_deg, sigma_m)| wire::Fix { longitude_deg, latitude_deg, sigma_m })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4_000))]

    #[test]
    fn what_is_accepted_is_fused_to_a_finite_position(
        bounding_box in prop::option::of(wire_box()),
        fix in prop::option::of(wire_fix()),
    ) {
        let observation = wire::Observation {
            time: "2026-01-01T00:00:00Z".into(), target_id: None, receiver_id: None, tracker_id: None, bounding_box,
            fix, class: None,
        };
        let bounds = TimeBounds::at("2026-06-01T00:00:00Z".parse().expect("an instant"));
        if let Ok(observation) = observation.to_domain(&bounds, None, &Receivers::default()) {
            check_fusion(&observation);
        }
    }

    #[test]
    fn a_plane_about_any_origin_maps_to_positions_and_back(
        origin in position(),
        east_m in -15_000.0..15_000.0_f64,
        north_m in -15_000.0..15_000.0_f64,
    ) {
        let plane = LocalPlane::new(origin);
        let point = EastNorth { east_m, north_m };
        let position = plane.to_position(point);
        prop_assert!(position.longitude_deg().abs() <= 180.0 && position.latitude_deg().abs() <= 90.0);
        let back = plane.to_plane(position);
        prop_assert!(back.distance_m(point) < 1e-3, "{origin:?} {point:?} {back:?}");
        let (in_plane_m, geodesic_m) = (east_m.hypot(north_m), distance_m(origin, position));
        prop_assert!((in_plane_m - geodesic_m).abs() < 1e-3 + 1e-5 * geodesic_m, "{in_plane_m} {geodesic_m}");
    }

    #[test]
    fn distances_are_symmetric_and_no_longer_than_half_the_earth(one in position(), other in position()) {
        let there_m = distance_m(one, other);
        prop_assert!((0.0..20_004_000.0).contains(&there_m), "{there_m}");
        prop_assert!((there_m - distance_m(other, one)).abs() < 1e-3);
        let [west, east] = [-180.0, 180.0].map(|deg| Position::new(deg, one.latitude_deg()).expect("valid"));
        prop_assert!(distance_m(west, east) < 1e-3, "the antimeridian is one line");
        prop_assert!((distance_m(one, west) - distance_m(one, east)).abs() < 1e-3);
    }
}
