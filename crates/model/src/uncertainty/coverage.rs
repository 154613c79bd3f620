//! The region of the training boxes, and the nominal error variance within it.
//!
//! A box is a point `z = (foot_x, foot_y, ln width, ln height)`, each coordinate divided by its unit. Up to
//! 64 training boxes are chosen as centres by farthest-point sampling (Gonzalez 1985), whose covering
//! radius `rho` is at most twice the optimum: every training box is within `rho` of a centre. The distance
//! of a box from the nearest centre in units of `rho` is at most 1 for training boxes and measures how far a
//! box extrapolates. The error variance at a box is interpolated between the centres by inverse distance
//! weighting (Shepard 1968) with the exponent 4.

use crate::artifact::tensors::Tensors;
use crate::domain::{BoundingBox, Error, Result};
use crate::statistics::std_dev;

/// Most centres; each adds some nanoseconds to every answer.
pub(crate) const MOST_CENTRES: usize = 64;
/// Outliers are removed only from sets with at least this many boxes.
const FEWEST_FOR_OUTLIERS: usize = 20 * MOST_CENTRES;
/// A centre with at most this many boxes consists of outliers.
const LARGEST_OUTLIER_GROUP: usize = 2;
/// At most one in this many boxes is removed as an outlier.
const BOXES_PER_OUTLIER: usize = 20;
/// Coordinates of a point.
const DIMENSIONS: usize = 4;
/// Least unit of a coordinate: px for the foot point, natural logarithm for the size. Jitter of a pixel
/// must not appear as a large distance where boxes hardly vary.
const LEAST_UNITS: [f32; DIMENSIONS] = [4.0, 4.0, 0.1, 0.1];
/// Least covering radius, in units.
const LEAST_RADIUS: f32 = 0.25;

type Point = [f32; DIMENSIONS];

/// The centres with their covering radius and error variances.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Coverage {
    /// Units of the coordinates.
    units: Point,
    /// Centres, in units.
    centres: Vec<Point>,
    /// Covering radius, in units.
    radius: f32,
    /// Nominal error variance per axis at each centre, m2.
    errors_m2: Vec<f32>,
}

impl Coverage {
    /// Chooses the centres. In large sets, boxes whose centre has hardly any others are removed as
    /// outliers, and the centres are chosen again.
    pub(crate) fn new(boxes: impl Iterator<Item = BoundingBox>) -> Self {
        let mut raw: Vec<Point> = boxes.map(coordinates).collect();
        let mut coverage = Self::of_points(&raw);
        let most_outliers = raw.len() / BOXES_PER_OUTLIER;
        let mut outliers = 0;
        while raw.len() >= FEWEST_FOR_OUTLIERS {
            let of_row: Vec<usize> =
                raw.iter().map(|raw| coverage.nearest_to(&in_units(raw, &coverage.units))).collect();
            let mut counts = vec![0; coverage.centres.len()];
            of_row.iter().for_each(|at| counts[*at] += 1);
            let isolated: usize = counts.iter().filter(|count| **count <= LARGEST_OUTLIER_GROUP).sum();
            outliers += isolated;
            if isolated == 0 || outliers > most_outliers {
                break;
            }
            let mut of_row = of_row.iter();
            raw.retain(|_| of_row.next().is_some_and(|at| counts[*at] > LARGEST_OUTLIER_GROUP));
            coverage = Self::of_points(&raw);
        }
        coverage
    }

    fn of_points(raw: &[Point]) -> Self {
        let units = std::array::from_fn(|axis| {
            let deviation = std_dev(raw.iter().map(|point| f64::from(point[axis])));
            (deviation as f32).max(LEAST_UNITS[axis])
        });
        let points: Vec<Point> = raw.iter().map(|point| in_units(point, &units)).collect();
        let mut coverage = Self { units, centres: Vec::new(), radius: 0.0, errors_m2: Vec::new() };
        let mut nearest = vec![f32::INFINITY; points.len()];
        let mut next = 0;
        while coverage.centres.len() < MOST_CENTRES && next < points.len() {
            let centre = points[next];
            coverage.centres.push(centre);
            for (distance, point) in nearest.iter_mut().zip(&points) {
                *distance = distance.min(squared_distance(&centre, point));
            }
            let farthest = nearest.iter().enumerate().max_by(|left, right| left.1.total_cmp(right.1));
            let Some((at, distance)) = farthest else { break };
            coverage.radius = distance.sqrt();
            if *distance <= 1e-6 {
                break;
            }
            next = at;
        }
        coverage.radius = coverage.radius.max(LEAST_RADIUS);
        coverage.errors_m2 = vec![1.0; coverage.centres.len()];
        coverage
    }

    /// The same centres with other error variances, m2.
    pub(crate) fn with_errors(self, errors_m2: Vec<f32>) -> Self {
        Self { errors_m2, ..self }
    }

    /// Number of centres.
    pub(crate) const fn len(&self) -> usize {
        self.centres.len()
    }

    /// Nominal error variance per axis at each centre, m2.
    pub(crate) fn errors_m2(&self) -> impl Iterator<Item = f64> + '_ {
        self.errors_m2.iter().map(|error_m2| f64::from(*error_m2))
    }

    /// The first centres alone, which cover the same boxes with a larger radius.
    pub(crate) fn truncated_to(&self, centres: usize) -> Self {
        let mut truncated = self.clone();
        truncated.centres.truncate(centres);
        truncated.errors_m2.truncate(centres);
        truncated
    }

    /// The boxes at all centres, in their order; `None` where the coordinates are not a valid box.
    pub(crate) fn boxes(&self) -> impl Iterator<Item = Option<BoundingBox>> + '_ {
        self.centres.iter().map(|centre| box_at(centre, &self.units))
    }

    /// Index of the nearest centre.
    pub(crate) fn nearest(&self, bounding_box: &BoundingBox) -> usize {
        self.nearest_to(&in_units(&coordinates(*bounding_box), &self.units))
    }

    fn nearest_to(&self, point: &Point) -> usize {
        let distances = self.centres.iter().map(|centre| squared_distance(centre, point)).enumerate();
        distances.min_by(|one, other| one.1.total_cmp(&other.1)).map_or(0, |(at, _)| at)
    }

    pub(crate) fn put(&self, tensors: &mut Tensors) {
        let centres = self.centres.iter().flatten().copied().collect();
        tensors.put_f32("coverage.centres", &[self.centres.len(), DIMENSIONS], centres);
        tensors.put_f32("coverage.errors_m2", &[self.centres.len()], self.errors_m2.clone());
        tensors.put_f32("coverage.units", &[DIMENSIONS], self.units.to_vec());
        tensors.put_f32("coverage.radius", &[1], vec![self.radius]);
    }

    /// # Errors
    /// Names the tensor that is missing or cannot be used.
    pub(crate) fn take(tensors: &mut Tensors) -> Result<Self> {
        let count = tensors.rows("coverage.centres").unwrap_or(1);
        if count == 0 || count > MOST_CENTRES {
            return Err(Error::invalid("weights", format!("must have 1 to {MOST_CENTRES} coverage.centres")));
        }
        let centres = tensors.take_f32("coverage.centres", &[count, DIMENSIONS])?;
        let units = tensors.take_f32("coverage.units", &[DIMENSIONS])?;
        let radius = tensors.take_f32("coverage.radius", &[1])?[0];
        let errors_m2 = tensors.take_f32("coverage.errors_m2", &[count])?;
        if errors_m2.iter().any(|error_m2| *error_m2 <= 0.0) {
            return Err(Error::invalid("weights", "coverage.errors_m2 must be above 0"));
        }
        if radius <= 0.0 || units.iter().any(|unit| *unit <= 0.0) {
            return Err(Error::invalid("weights", "coverage.radius and coverage.units must be above 0"));
        }
        let units = std::array::from_fn(|axis| units[axis]);
        Ok(Self { units, centres: centres.as_chunks().0.to_vec(), radius, errors_m2 })
    }

    /// The same in the layout for look-ups.
    pub(crate) fn table(&self) -> CoverageTable {
        let groups = self
            .centres
            .chunks(LANES)
            .zip(self.errors_m2.chunks(LANES))
            .map(|(centres, errors_m2)| {
                // Lanes without a centre are so far away that their weight vanishes.
                let mut group = Group { axes: [[FAR; LANES]; DIMENSIONS], errors_m2: [1.0; LANES] };
                for (lane, (centre, error_m2)) in centres.iter().zip(errors_m2).enumerate() {
                    for (axis, coordinate) in group.axes.iter_mut().zip(centre) {
                        axis[lane] = *coordinate;
                    }
                    group.errors_m2[lane] = *error_m2;
                }
                group
            })
            .collect();
        let largest_m2 = self.errors_m2.iter().fold(0.0f32, |largest, error_m2| largest.max(*error_m2));
        CoverageTable { units: self.units, radius: self.radius, groups, largest_m2 }
    }
}

/// Centres of a group, which are processed in parallel.
const LANES: usize = 8;
/// Coordinate of an empty lane, in units.
const FAR: f32 = 1e12;
/// Squared distance that is added to every other, in squared radii, so that the weight at a centre is
/// finite.
pub(crate) const SOFTENING: f32 = 1e-3;

#[derive(Debug, Clone, PartialEq)]
struct Group {
    axes: [[f32; LANES]; DIMENSIONS],
    errors_m2: [f32; LANES],
}

impl Group {
    /// Squared distance of each centre from a point, in squared units.
    #[inline(always)]
    fn squared_distances(&self, point: &Point) -> [f32; LANES] {
        let mut sums = [0.0; LANES];
        for (axis, coordinate) in self.axes.iter().zip(point) {
            for (sum, centre) in sums.iter_mut().zip(axis) {
                let difference = centre - coordinate;
                *sum += difference * difference;
            }
        }
        sums
    }
}

/// The position of a box relative to the training boxes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CoverageLookup {
    /// Distance to the nearest centre in covering radii: up to 1 for training boxes.
    pub(crate) extrapolation_ratio: f64,
    /// Nominal error variance per axis, m2.
    pub(crate) nominal_m2: f64,
    /// Index of the nearest centre.
    pub(crate) nearest: usize,
}

/// A [`Coverage`] with the centres in lanes, so that a look-up takes some tens of nanoseconds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CoverageTable {
    pub(crate) units: Point,
    pub(crate) radius: f32,
    groups: Vec<Group>,
    pub(crate) largest_m2: f32,
}

impl CoverageTable {
    /// [`CoverageLookup::extrapolation_ratio`] alone.
    #[inline]
    pub(crate) fn extrapolation_ratio(&self, bounding_box: &BoundingBox) -> f64 {
        let point = in_units(&coordinates(*bounding_box), &self.units);
        let mut least = [f32::INFINITY; LANES];
        for group in &self.groups {
            for (least, distance) in least.iter_mut().zip(group.squared_distances(&point)) {
                *least = if distance < *least { distance } else { *least };
            }
        }
        let least = least.into_iter().fold(f32::INFINITY, f32::min);
        f64::from(least.sqrt() / self.radius)
    }

    /// Looks up a box.
    #[inline]
    pub(crate) fn look_up(&self, bounding_box: &BoundingBox) -> CoverageLookup {
        let softening = SOFTENING * self.radius * self.radius;
        let (mut least, mut sums, mut weights) = ([f32::INFINITY; LANES], [0.0f32; LANES], [0.0f32; LANES]);
        let point = in_units(&coordinates(*bounding_box), &self.units);
        let mut nearest = [0u32; LANES];
        for (at, group) in (0u32..).zip(&self.groups) {
            let distances = group.squared_distances(&point);
            for lane in 0..LANES {
                let distance = distances[lane];
                let closeness = 1.0 / (distance + softening);
                nearest[lane] = if distance < least[lane] { at } else { nearest[lane] };
                least[lane] = if distance < least[lane] { distance } else { least[lane] };
                sums[lane] += closeness * closeness * group.errors_m2[lane];
                weights[lane] += closeness * closeness;
            }
        }
        let mut lane = 0;
        for other in 1..LANES {
            lane = if least[other] < least[lane] { other } else { lane };
        }
        let weight: f32 = weights.iter().sum();
        // Far from all centres the weights underflow; there the extrapolation ratio dominates the error.
        let nominal_m2 = if weight > 1e-30 { sums.iter().sum::<f32>() / weight } else { self.largest_m2 };
        CoverageLookup {
            extrapolation_ratio: f64::from(least[lane].sqrt() / self.radius),
            nominal_m2: f64::from(nominal_m2),
            nearest: nearest[lane] as usize * LANES + lane,
        }
    }

    /// Centres, in units, with their error variances, m2: in the order of [`CoverageLookup::nearest`].
    pub(crate) fn centres(&self) -> impl Iterator<Item = (Point, f32)> + '_ {
        let lanes = self.groups.iter().flat_map(|group| (0..LANES).map(move |lane| (group, lane)));
        lanes
            .map(|(group, lane)| (group.axes.map(|axis| axis[lane]), group.errors_m2[lane]))
            .filter(|(centre, _)| centre[0] < FAR)
    }

    /// The boxes at all centres that are valid.
    pub(crate) fn boxes(&self) -> impl Iterator<Item = BoundingBox> + '_ {
        self.centres().filter_map(|(centre, _)| box_at(&centre, &self.units))
    }

    /// Displacement of the foot point that makes one covering radius, px.
    #[inline]
    pub(crate) fn radius_px(&self) -> f64 {
        f64::from(self.radius * self.units[0].min(self.units[1]))
    }
}

#[inline]
fn coordinates(bounding_box: BoundingBox) -> Point {
    let [foot_x, foot_y] = bounding_box.foot_px();
    [
        foot_x as f32,
        foot_y as f32,
        (bounding_box.width_px() as f32).ln(),
        (bounding_box.height_px() as f32).ln(),
    ]
}

/// `None` where the coordinates are not a valid box.
fn box_at(centre: &Point, units: &Point) -> Option<BoundingBox> {
    let [foot_x, foot_y, width, height]: [f64; DIMENSIONS] =
        std::array::from_fn(|axis| f64::from(centre[axis] * units[axis]));
    let (width, height) = (width.exp(), height.exp());
    BoundingBox::new(foot_x - 0.5 * width, foot_y - height, width, height).ok()
}

#[inline]
fn in_units(coordinates: &Point, units: &Point) -> Point {
    std::array::from_fn(|axis| coordinates[axis] / units[axis])
}

#[inline(always)]
fn squared_distance(left: &Point, right: &Point) -> f32 {
    left.iter().zip(right).map(|(one, other)| (one - other) * (one - other)).sum()
}
