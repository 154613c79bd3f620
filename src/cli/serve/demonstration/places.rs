//! The places of the demonstration: where events are reported and targets counted.

use std::collections::BTreeMap;

use crate::geo::{EastNorth, LocalPlane};
use crate::places::settings::{EventKind, Geometry, PlaceSettings, Rule};
use crate::simulation::SiteOptions;

/// A border or a line, m east and north of the square's first mast.
type Points = &'static [(f64, f64)];

/// The quay in front of the cameras, and a line across it.
const QUAY: Points = &[(5.0, 20.0), (30.0, 20.0), (30.0, 32.0), (5.0, 32.0), (5.0, 20.0)];
const GATE: Points = &[(15.0, 16.0), (15.0, 40.0)];

/// The places of the square, by id.
pub(super) fn of_square(options: &SiteOptions) -> [(&'static str, PlaceSettings); 2] {
    let plane = LocalPlane::new(options.origin);
    let degrees = |points: Points| -> Vec<[f64; 2]> {
        let at = |&(east_m, north_m): &(f64, f64)| {
            let position = plane.to_position(EastNorth { east_m, north_m });
            [position.longitude_deg(), position.latitude_deg()]
        };
        points.iter().map(at).collect()
    };
    [
        (
            "demo-quay",
            settings("Quay", Geometry::Polygon(vec![degrees(QUAY)]), &[EventKind::Enter, EventKind::Leave]),
        ),
        ("demo-gate", settings("Gate", Geometry::LineString(degrees(GATE)), &[EventKind::Cross])),
    ]
}

fn settings(display_name: &str, geometry: Geometry, kinds: &[EventKind]) -> PlaceSettings {
    PlaceSettings {
        display_name: display_name.to_owned(),
        labels: BTreeMap::from([("demonstration".to_owned(), "simulated".to_owned())]),
        geometry,
        radius_m: None,
        probability: PlaceSettings::DEFAULT_PROBABILITY,
        rules: kinds.iter().copied().map(Rule::of).collect(),
    }
}
