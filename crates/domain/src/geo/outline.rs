//! An area on the ground.

use super::plane::{EastNorth, LocalPlane};
use super::position::Position;

/// An area between rings of corners in a plane; rings in another one are holes.
#[derive(Debug, Clone, PartialEq)]
pub struct Outline {
    plane: LocalPlane,
    rings: Vec<Vec<EastNorth>>,
    bounds_deg: [[f64; 2]; 2],
}

impl Outline {
    /// From rings in a plane, in any direction, without their first corner again at the end, and the longitude and latitude
    /// of their south-west and north-east corner.
    #[must_use]
    pub const fn new(plane: LocalPlane, rings: Vec<Vec<EastNorth>>, bounds_deg: [[f64; 2]; 2]) -> Self {
        Self { plane, rings, bounds_deg }
    }

    /// True if a position is in the area.
    #[must_use]
    pub fn contains(&self, position: Position) -> bool {
        let point = self.plane.to_plane_within_range(position);
        point.is_some_and(|point| is_inside(&self.rings, point))
    }

    /// South-west and north-east corner in degrees.
    #[must_use]
    pub const fn bounds_deg(&self) -> [[f64; 2]; 2] {
        self.bounds_deg
    }
}

/// True if a point is between rings, in any order: by the parity of crossings of all of them towards the east.
#[must_use]
pub fn is_inside(rings: &[Vec<EastNorth>], point: EastNorth) -> bool {
    let crosses = |from: &EastNorth, to: &EastNorth| {
        if (from.north_m > point.north_m) == (to.north_m > point.north_m) {
            return false;
        }
        let share = (point.north_m - from.north_m) / (to.north_m - from.north_m);
        point.east_m < from.east_m + share * (to.east_m - from.east_m)
    };
    let edges = rings.iter().flat_map(|ring| ring.iter().zip(ring.iter().cycle().skip(1)));
    edges.filter(|(from, to)| crosses(from, to)).count() % 2 == 1
}
