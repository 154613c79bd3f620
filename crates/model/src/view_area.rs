//! The area on the ground that a model's training boxes cover.

use super::regressor::{Regression, Regressor};
use crate::geo::{EastNorth, Position};
use crate::statistics::median;

/// The area that a model covers, with its error.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewArea {
    /// Convex hull of the positions of the training boxes' coverage centres, counterclockwise; fewer than
    /// three positions where these lie on a line.
    pub hull: Vec<Position>,
    /// Median over the same boxes of the stated 95 % radius of a position from the box alone, m.
    pub median_r95_m: f64,
}

impl Regressor {
    /// The area on the ground that the training boxes cover.
    #[must_use]
    pub fn view_area(&self) -> ViewArea {
        let boxes = self.training_boxes();
        let answers: Vec<_> = boxes.iter().map(|bounding_box| self.regress(bounding_box, None)).collect();
        let hull = convex_hull(answers.iter().map(|answer| answer.regressed).collect());
        ViewArea {
            hull: hull.into_iter().map(|point| self.plane().to_position(point)).collect(),
            median_r95_m: median(answers.iter().map(Regression::r95_m).collect()),
        }
    }
}

/// Andrew's monotone chain (1979): the hull's corners, counterclockwise, none of them on a side.
fn convex_hull(mut points: Vec<EastNorth>) -> Vec<EastNorth> {
    points.sort_by(|a, b| a.east_m.total_cmp(&b.east_m).then(a.north_m.total_cmp(&b.north_m)));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let mut hull = half_hull(points.iter());
    hull.pop();
    let mut upper = half_hull(points.iter().rev());
    upper.pop();
    hull.append(&mut upper);
    hull
}

fn half_hull<'a>(points: impl Iterator<Item = &'a EastNorth>) -> Vec<EastNorth> {
    let mut hull: Vec<EastNorth> = Vec::new();
    for &point in points {
        while let [.., before, last] = hull[..]
            && turn(before, last, point) <= 0.0
        {
            hull.pop();
        }
        hull.push(point);
    }
    hull
}

/// Positive for a turn to the left at `b`: twice the area of the triangle, m2.
fn turn(a: EastNorth, b: EastNorth, c: EastNorth) -> f64 {
    (b.east_m - a.east_m) * (c.north_m - a.north_m) - (b.north_m - a.north_m) * (c.east_m - a.east_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hull_of_a_filled_square_is_its_corners() {
        let grid = (0..25).map(|at| EastNorth { east_m: f64::from(at % 5), north_m: f64::from(at / 5) });
        let corners: Vec<_> =
            convex_hull(grid.collect()).iter().map(|corner| (corner.east_m, corner.north_m)).collect();
        assert_eq!(corners, [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]);
    }

    #[test]
    fn points_on_a_line_leave_its_ends() {
        let line = (0..5).map(|at| EastNorth { east_m: f64::from(at), north_m: 2.0 * f64::from(at) });
        assert_eq!(convex_hull(line.collect()).len(), 2);
    }
}
