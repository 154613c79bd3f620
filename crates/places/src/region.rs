//! The geometry of a place in metres.

use std::f64::consts::TAU;

use geo::{Coord, LineString, Polygon, Validation};

use crate::domain::{Error, Result};
use crate::geo::{EastNorth, LocalPlane, Outline, PLANE_RANGE_M, PlaneCovariance, Position, is_inside};
use crate::geometry::Geometry;
use crate::normal::{Whitening, cumulative};

/// Corners of a place, in all of its rings.
const MAX_CORNERS: usize = 512;
/// Mean width of an area, m. Points of one parallel lie beside a straight line by less.
const LEAST_WIDTH_M: f64 = 0.01;
/// Radius of a point's place, m.
const MAX_RADIUS_M: f64 = 10_000.0;
/// Beyond this latitude a degree of longitude is no measure any more.
const MAX_LATITUDE_DEG: f64 = 85.0;
/// Corners by which a disc is approximated; its area differs by 0.2 %.
const DISC_CORNERS: usize = 64;
/// A border farther than this many standard deviations does not matter.
const FAR_SIGMAS: f64 = 6.0;

/// A place in its own plane.
#[derive(Debug, Clone)]
pub(crate) struct Region {
    plane: LocalPlane,
    shape: Shape,
    /// South-west and north-east corner in degrees.
    bounds_deg: [[f64; 2]; 2],
}

#[derive(Debug, Clone)]
enum Shape {
    /// Rings without their repeated last corner: the outer one counter-clockwise, holes clockwise.
    Area(Vec<Vec<EastNorth>>),
    Line(Vec<EastNorth>),
}

/// Where a target is beside the border of a place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BorderView {
    /// Distance from the border, m: positive inside an area, or on the left of a line.
    pub(crate) distance_m: f64,
    /// Standard deviation of the distance, m.
    pub(crate) sigma_m: f64,
    /// Rate of change of the distance, m/s.
    pub(crate) rate_mps: f64,
    /// Probability that the target is inside, or on the left.
    pub(crate) probability: f64,
    /// Probability that a target that crosses here does so between the ends of a line; 1 for an area.
    pub(crate) extent_probability: f64,
}

impl Region {
    pub(crate) fn of(geometry: &Geometry, radius_m: Option<f64>) -> Result<Self> {
        if radius_m.is_some() != matches!(geometry, Geometry::Point(_)) {
            return Err(Error::invalid("radius_m", "belongs to a point, and a point needs it"));
        }
        match geometry {
            Geometry::Polygon(rings) => Self::of_rings(rings),
            Geometry::LineString(points) => Self::of_line(points),
            Geometry::Point(centre) => Self::of_disc(*centre, radius_m.unwrap_or_default()),
        }
    }

    fn of_rings(rings: &[Vec<[f64; 2]>]) -> Result<Self> {
        check_corners(rings.iter().map(Vec::len).sum(), 4)?;
        for ring in rings {
            if ring.len() < 4 {
                return Err(invalid("a ring has three corners at least, and the first one again at its end"));
            }
            if ring.first() != ring.last() {
                return Err(invalid("a ring must end with its first corner"));
            }
        }
        let all: Vec<_> = rings.iter().flatten().copied().collect();
        let (plane, bounds_deg) = plane_of(&all)?;
        let rings = rings.iter().map(|ring| projected(&plane, ring)).collect::<Result<Vec<_>>>()?;
        let mut lines = rings.iter().map(|ring| line_string(ring));
        let outer = lines.next().unwrap_or_else(|| LineString::new(Vec::new()));
        let polygon = Polygon::new(outer, lines.collect());
        polygon.check_validation().map_err(|fault| invalid(format!("is not valid: {fault}")))?;
        let (area_m2, border_m) = (signed_area(&rings[0]).abs(), perimeter(&rings[0]));
        if 2.0 * area_m2 < LEAST_WIDTH_M * border_m {
            return Err(invalid("has no area: its corners lie on one line"));
        }
        let oriented = rings.into_iter().enumerate().map(|(number, mut ring)| {
            ring.pop();
            if (signed_area(&ring) > 0.0) != (number == 0) {
                ring.reverse();
            }
            ring
        });
        Ok(Self { plane, shape: Shape::Area(oriented.collect()), bounds_deg })
    }

    fn of_line(points: &[[f64; 2]]) -> Result<Self> {
        check_corners(points.len(), 2)?;
        let (plane, bounds_deg) = plane_of(points)?;
        let points = projected(&plane, points)?;
        if points.windows(2).any(|pair| pair[0].distance_m(pair[1]) <= 0.0) {
            return Err(invalid("two points of a line that follow each other must differ"));
        }
        if has_crossing(&points) {
            return Err(invalid("a line must not cross itself: its sides would be undefined"));
        }
        Ok(Self { plane, shape: Shape::Line(points), bounds_deg })
    }

    fn of_disc(centre: [f64; 2], radius_m: f64) -> Result<Self> {
        if !(radius_m > 0.0 && radius_m <= MAX_RADIUS_M) {
            return Err(Error::invalid("radius_m", format!("must be above 0, and {MAX_RADIUS_M} at most")));
        }
        let (plane, _) = plane_of(&[centre])?;
        let ring = disc(radius_m);
        let degrees = |point: &EastNorth| {
            let position = plane.to_position(*point);
            [position.longitude_deg(), position.latitude_deg()]
        };
        let bounds_deg = bounds_of(&ring.iter().map(degrees).collect::<Vec<_>>())?;
        Ok(Self { plane, shape: Shape::Area(vec![ring]), bounds_deg })
    }

    pub(crate) const fn is_line(&self) -> bool {
        matches!(self.shape, Shape::Line(_))
    }

    /// The area; `None` of a line.
    pub(crate) fn outline(&self) -> Option<Outline> {
        match &self.shape {
            Shape::Area(rings) => Some(Outline::new(self.plane, rings.clone(), self.bounds_deg)),
            Shape::Line(_) => None,
        }
    }

    pub(crate) const fn bounds_deg(&self) -> [[f64; 2]; 2] {
        self.bounds_deg
    }

    /// The view of a target at a position, with its velocity, m/s, and the covariance of its position, m2; `None` beyond
    /// the range of the plane.
    pub(crate) fn view(
        &self,
        position: Position,
        velocity_mps: [f64; 2],
        covariance: PlaneCovariance,
    ) -> Option<BorderView> {
        let point = self.plane.to_plane_within_range(position)?;
        let (border, distance_m) = match &self.shape {
            Shape::Area(rings) => nearest_of_rings(rings, point)?,
            Shape::Line(points) => nearest_of_line(points, point)?,
        };
        let normal = border.normal;
        let sigma_m = sigma_along(covariance, normal);
        let probability = match &self.shape {
            Shape::Area(rings) => area_probability(rings, point, distance_m, covariance),
            Shape::Line(_) => cumulative(distance_m / sigma_m.max(f64::MIN_POSITIVE)),
        };
        let along_sigma_m = sigma_along(covariance, [normal[1], -normal[0]]).max(f64::MIN_POSITIVE);
        let within = |margin_m: f64| cumulative(margin_m / along_sigma_m);
        Some(BorderView {
            distance_m,
            sigma_m,
            rate_mps: velocity_mps[0] * normal[0] + velocity_mps[1] * normal[1],
            probability,
            extent_probability: border
                .margins_m
                .map_or(1.0, |[start_m, end_m]| (within(start_m) + within(end_m) - 1.0).max(0.0)),
        })
    }
}

/// The part of a border that is nearest to a point.
struct Border {
    /// Unit vector towards the inside, or to the left.
    normal: [f64; 2],
    /// Distances along a line from its start and to its end, m, negative beyond them.
    margins_m: Option<[f64; 2]>,
}

/// Distance and standard deviation are m and m2; the probability that the target is in the area.
fn area_probability(
    rings: &[Vec<EastNorth>],
    point: EastNorth,
    distance_m: f64,
    covariance: PlaneCovariance,
) -> f64 {
    let reach_m = FAR_SIGMAS * covariance.principal_m2()[0].sqrt();
    let whitening = Whitening::of(point, covariance).filter(|_| distance_m.abs() <= reach_m);
    let Some(whitening) = whitening else { return f64::from(u8::from(distance_m > 0.0)) };
    rings.iter().map(|ring| whitening.signed_probability(ring)).sum::<f64>().clamp(0.0, 1.0)
}

fn sigma_along(covariance: PlaneCovariance, [east, north]: [f64; 2]) -> f64 {
    let PlaneCovariance { east_m2, north_m2, east_north_m2 } = covariance;
    (east * east * east_m2 + north * north * north_m2 + 2.0 * east * north * east_north_m2).max(0.0).sqrt()
}

/// A point beside a segment.
struct Beside {
    /// Distance from the nearest point of the segment, m.
    away_m: f64,
    /// Distance from the line through the segment, m, positive on the left.
    left_m: f64,
    /// Distance along the segment from its start to the foot of the point, m.
    along_m: f64,
    length_m: f64,
    /// Unit vector to the left.
    left: [f64; 2],
}

fn beside(from: EastNorth, to: EastNorth, point: EastNorth) -> Beside {
    let (edge, offset) = (to.minus(from), point.minus(from));
    let length_m = from.distance_m(to);
    let [east, north] = [edge.east_m / length_m, edge.north_m / length_m];
    let along_m = offset.east_m * east + offset.north_m * north;
    let left_m = offset.north_m * east - offset.east_m * north;
    let past_m = (along_m - along_m.clamp(0.0, length_m)).abs();
    Beside { away_m: left_m.hypot(past_m), left_m, along_m, length_m, left: [-north, east] }
}

/// The nearest border of an area, and the distance from it, positive inside.
fn nearest_of_rings(rings: &[Vec<EastNorth>], point: EastNorth) -> Option<(Border, f64)> {
    let edges = rings.iter().flat_map(|ring| ring.iter().zip(ring.iter().cycle().skip(1)));
    let nearest =
        edges.map(|(from, to)| beside(*from, *to, point)).min_by(|a, b| a.away_m.total_cmp(&b.away_m))?;
    let distance_m = if is_inside(rings, point) { nearest.away_m } else { -nearest.away_m };
    Some((Border { normal: nearest.left, margins_m: None }, distance_m))
}

/// The nearest segment of a line, and the distance from the line through it, positive on its left.
fn nearest_of_line(points: &[EastNorth], point: EastNorth) -> Option<(Border, f64)> {
    let mut before_m = 0.0;
    let mut nearest: Option<(Beside, f64)> = None;
    for pair in points.windows(2) {
        let segment = beside(pair[0], pair[1], point);
        let length_m = segment.length_m;
        // At a bend two segments are equally near; the one that the point is farther beside tells its side.
        let is_nearer = nearest.as_ref().is_none_or(|(other, _)| {
            segment.away_m < other.away_m - 1e-9
                || (segment.away_m < other.away_m + 1e-9 && segment.left_m.abs() > other.left_m.abs())
        });
        if is_nearer {
            nearest = Some((segment, before_m));
        }
        before_m += length_m;
    }
    let (segment, start_m) = nearest?;
    let along_m = start_m + segment.along_m;
    let margins_m = Some([along_m, before_m - along_m]);
    Some((Border { normal: segment.left, margins_m }, segment.left_m))
}

fn signed_area(ring: &[EastNorth]) -> f64 {
    let edges = ring.iter().zip(ring.iter().cycle().skip(1));
    edges.map(|(from, to)| from.east_m * to.north_m - to.east_m * from.north_m).sum::<f64>() * 0.5
}

/// Length of a closed ring, m.
fn perimeter(ring: &[EastNorth]) -> f64 {
    ring.windows(2).map(|pair| pair[0].distance_m(pair[1])).sum()
}

fn line_string(points: &[EastNorth]) -> LineString {
    points.iter().map(|point| Coord { x: point.east_m, y: point.north_m }).collect()
}

/// True if two segments that do not follow each other have a point in common.
fn has_crossing(points: &[EastNorth]) -> bool {
    let line = line_string(points);
    let segments: Vec<_> = line.lines().collect();
    segments.iter().enumerate().any(|(number, segment)| {
        segments[number + 1..].iter().skip(1).any(|other| geo::Intersects::intersects(segment, other))
    })
}

fn invalid(message: impl Into<String>) -> Error {
    Error::invalid("geometry.coordinates", message)
}

fn check_corners(count: usize, least: usize) -> Result<()> {
    if count < least {
        return Err(invalid(format!("must have {least} points at least")));
    }
    if count > MAX_CORNERS {
        return Err(invalid(format!("has {count} points; {MAX_CORNERS} are taken, so simplify it")));
    }
    Ok(())
}

/// The plane about the middle of some coordinates, and their bounds in degrees.
fn plane_of(coordinates: &[[f64; 2]]) -> Result<(LocalPlane, [[f64; 2]; 2])> {
    let bounds = bounds_of(coordinates)?;
    let [[west, south], [east, north]] = bounds;
    let middle = Position::new(0.5 * (west + east), 0.5 * (south + north))
        .map_err(|fault| invalid(fault.to_string()))?;
    Ok((LocalPlane::new(middle), bounds))
}

fn bounds_of(coordinates: &[[f64; 2]]) -> Result<[[f64; 2]; 2]> {
    let mut bounds = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
    for [longitude_deg, latitude_deg] in coordinates {
        Position::new(*longitude_deg, *latitude_deg).map_err(|fault| invalid(fault.to_string()))?;
        if latitude_deg.abs() > MAX_LATITUDE_DEG {
            return Err(invalid(format!("is too near a pole; latitudes go to {MAX_LATITUDE_DEG} degrees")));
        }
        bounds[0] = [bounds[0][0].min(*longitude_deg), bounds[0][1].min(*latitude_deg)];
        bounds[1] = [bounds[1][0].max(*longitude_deg), bounds[1][1].max(*latitude_deg)];
    }
    if bounds[1][0] - bounds[0][0] > 180.0 {
        return Err(invalid("lies across the antimeridian; cut it there into two places"));
    }
    Ok(bounds)
}

fn projected(plane: &LocalPlane, coordinates: &[[f64; 2]]) -> Result<Vec<EastNorth>> {
    let project = |[longitude_deg, latitude_deg]: &[f64; 2]| {
        let position = Position::new(*longitude_deg, *latitude_deg).ok()?;
        plane.to_plane_within_range(position)
    };
    coordinates
        .iter()
        .map(|coordinate| {
            let message =
                format!("is too large; no point may be farther than {PLANE_RANGE_M} m from its middle");
            project(coordinate).ok_or_else(|| invalid(message))
        })
        .collect()
}

/// Probability that the difference of two positions is shorter than a distance, m. The difference has that covariance, m2.
pub(crate) fn probability_within(difference: EastNorth, covariance: PlaneCovariance, distance_m: f64) -> f64 {
    let reach_m = distance_m + FAR_SIGMAS * covariance.principal_m2()[0].sqrt();
    if difference.distance_m(EastNorth::default()) > reach_m {
        return 0.0;
    }
    let ring = disc(distance_m);
    Whitening::of(difference, covariance).map_or(0.0, |whitening| whitening.signed_probability(&ring))
}

/// Corners of a disc about the origin, counter-clockwise, m.
fn disc(radius_m: f64) -> Vec<EastNorth> {
    let corner = |number: usize| {
        let (north, east) = (TAU * number as f64 / DISC_CORNERS as f64).sin_cos();
        EastNorth { east_m: east * radius_m, north_m: north * radius_m }
    };
    (0..DISC_CORNERS).map(corner).collect()
}
