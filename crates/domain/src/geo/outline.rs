//! An area on the ground.

use super::plane::{EastNorth, LocalPlane};
use super::position::Position;

/// An area between rings of corners in a plane; rings in another one are holes.
#[derive(Debug, Clone, PartialEq)]
pub struct Outline {
    plane: LocalPlane,
    rings: Vec<Vec<EastNorth>>,
}

impl Outline {
    /// From rings in a plane, in any direction, without their first corner again at the end.
    #[must_use]
    pub const fn new(plane: LocalPlane, rings: Vec<Vec<EastNorth>>) -> Self {
        Self { plane, rings }
    }

    /// True if a position is in the area.
    #[must_use]
    pub fn contains(&self, position: Position) -> bool {
        let point = self.plane.to_plane_within_range(position);
        point.is_some_and(|point| self.rings.iter().filter(|ring| is_inside(ring, point)).count() % 2 == 1)
    }

    /// The westernmost and southernmost, and the easternmost and northernmost degrees of its corners.
    #[must_use]
    pub fn bounds_deg(&self) -> [[f64; 2]; 2] {
        let corners = self.rings.iter().flatten().map(|corner| self.plane.to_position(*corner));
        corners.fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], corner| {
            let [east, north] = [corner.longitude_deg(), corner.latitude_deg()];
            [[low[0].min(east), low[1].min(north)], [high[0].max(east), high[1].max(north)]]
        })
    }
}

/// True if a point is in a ring, by the parity of crossings towards the east.
#[must_use]
pub fn is_inside(ring: &[EastNorth], point: EastNorth) -> bool {
    let crosses = |from: &EastNorth, to: &EastNorth| {
        if (from.north_m > point.north_m) == (to.north_m > point.north_m) {
            return false;
        }
        let share = (point.north_m - from.north_m) / (to.north_m - from.north_m);
        point.east_m < from.east_m + share * (to.east_m - from.east_m)
    };
    let edges = ring.iter().zip(ring.iter().cycle().skip(1));
    edges.filter(|(from, to)| crosses(from, to)).count() % 2 == 1
}
