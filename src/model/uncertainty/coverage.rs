//! How far a box lies from those of the training samples.
//!
//! What never happens here: a judgement on positions; only boxes are compared.

use crate::domain::BoundingBox;

/// Representative boxes at most; each costs some nanoseconds in every answer.
pub(crate) const MOST_CENTRES: usize = 64;
/// From so many boxes on, centres with so few of them hold wild boxes, as long as those are no more
/// than one in so many of all.
const PLENTY: usize = 20 * MOST_CENTRES;
const ALONE: usize = 2;
const MOST_WILD: usize = 20;
/// Numbers per centre.
pub(crate) const DIMENSIONS: usize = 4;

/// A set of representative training boxes, and the radius about them that holds all of those.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Coverage {
    /// What coordinates are divided by: foot x, foot y (px), and the logarithms of the sides.
    pub(crate) units: [f32; DIMENSIONS],
    /// Centres in units.
    pub(crate) centres: Vec<[f32; DIMENSIONS]>,
    /// No training box is farther from its nearest centre, in units.
    pub(crate) radius: f32,
    /// Error variance of the regression at each centre, m2 per axis.
    pub(crate) errors_m2: Vec<f32>,
}

impl Coverage {
    /// Picks the centres by always taking the box farthest from those picked. Where there are
    /// plenty of boxes, those that stand alone are wild ones and are left out.
    pub(crate) fn new(boxes: impl Iterator<Item = BoundingBox>) -> Self {
        let mut raw: Vec<[f32; DIMENSIONS]> = boxes.map(coordinates).collect();
        let mut coverage = Self::of_points(&raw);
        let most_wild = raw.len() / MOST_WILD;
        let mut wild = 0;
        while raw.len() >= PLENTY {
            let point = |raw: &[f32; DIMENSIONS]| -> [f32; DIMENSIONS] {
                std::array::from_fn(|axis| raw[axis] / coverage.units[axis])
            };
            let of_row: Vec<usize> = raw.iter().map(|raw| coverage.nearest_to(&point(raw))).collect();
            let mut counts = vec![0; coverage.centres.len()];
            of_row.iter().for_each(|at| counts[*at] += 1);
            let alone: usize = counts.iter().filter(|count| **count <= ALONE).sum();
            wild += alone;
            if alone == 0 || wild > most_wild {
                break;
            }
            let mut of_row = of_row.iter();
            raw.retain(|_| of_row.next().is_some_and(|at| counts[*at] > ALONE));
            coverage = Self::of_points(&raw);
        }
        coverage
    }

    fn of_points(raw: &[[f32; DIMENSIONS]]) -> Self {
        let units = std::array::from_fn(|axis| {
            let deviation =
                crate::model::samples::rows::spread(raw.iter().map(|point| f64::from(point[axis])));
            // Sizes that hardly vary must not make a pixel's jitter look far away.
            (deviation as f32).max(if axis < 2 { 4.0 } else { 0.1 })
        });
        let points: Vec<[f32; DIMENSIONS]> =
            raw.iter().map(|point| std::array::from_fn(|axis| point[axis] / units[axis])).collect();
        let mut coverage = Self { units, centres: Vec::new(), radius: 0.0, errors_m2: Vec::new() };
        let mut nearest = vec![f32::INFINITY; points.len()];
        let mut next = 0;
        while coverage.centres.len() < MOST_CENTRES && next < points.len() {
            let centre = points[next];
            coverage.centres.push(centre);
            for (distance, point) in nearest.iter_mut().zip(&points) {
                *distance = distance.min(squared(&centre, point));
            }
            let farthest = nearest.iter().enumerate().max_by(|left, right| left.1.total_cmp(right.1));
            let Some((at, distance)) = farthest else { break };
            coverage.radius = distance.sqrt();
            if *distance <= 1e-6 {
                break;
            }
            next = at;
        }
        coverage.radius = coverage.radius.max(0.25);
        coverage.errors_m2 = vec![1.0; coverage.centres.len()];
        coverage
    }

    /// The first centres alone, which cover the same boxes more coarsely.
    pub(crate) fn coarse(&self, centres: usize) -> Self {
        let mut coarse = self.clone();
        coarse.centres.truncate(centres);
        coarse.errors_m2.truncate(centres);
        coarse
    }

    fn box_at(&self, centre: &[f32; DIMENSIONS]) -> Option<BoundingBox> {
        let [foot_x, foot_y, width, height]: [f64; DIMENSIONS] =
            std::array::from_fn(|axis| f64::from(centre[axis] * self.units[axis]));
        let (width, height) = (width.exp(), height.exp());
        BoundingBox::new(foot_x - 0.5 * width, foot_y - height, width, height).ok()
    }

    /// The boxes at all centres, in their order; `None` where a centre is none.
    pub(crate) fn boxes(&self) -> impl Iterator<Item = Option<BoundingBox>> + '_ {
        self.centres.iter().map(|centre| self.box_at(centre))
    }

    /// Index of the nearest centre.
    pub(crate) fn nearest(&self, bounding_box: &BoundingBox) -> usize {
        self.nearest_to(&self.point(bounding_box))
    }

    fn nearest_to(&self, point: &[f32; DIMENSIONS]) -> usize {
        let distances = self.centres.iter().map(|centre| squared(centre, point)).enumerate();
        distances.min_by(|one, other| one.1.total_cmp(&other.1)).map_or(0, |(at, _)| at)
    }

    #[inline]
    fn point(&self, bounding_box: &BoundingBox) -> [f32; DIMENSIONS] {
        let raw = coordinates(*bounding_box);
        std::array::from_fn(|axis| raw[axis] / self.units[axis])
    }

    /// The same, laid out for answers.
    pub(crate) fn table(&self) -> CoverageTable {
        let groups = self
            .centres
            .chunks(LANES)
            .zip(self.errors_m2.chunks(LANES))
            .map(|(centres, errors_m2)| {
                // Lanes without a centre are too far away to weigh anything.
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
        let worst_m2 = self.errors_m2.iter().fold(0.0f32, |worst, error_m2| worst.max(*error_m2));
        CoverageTable { units: self.units, radius: self.radius, groups, worst_m2 }
    }
}

const LANES: usize = 8;
const FAR: f32 = 1e12;

#[derive(Debug, Clone, PartialEq)]
struct Group {
    axes: [[f32; LANES]; DIMENSIONS],
    errors_m2: [f32; LANES],
}

/// A [`Coverage`] whose centres stand beside each other in lanes, so that one look takes some tens
/// of nanoseconds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CoverageTable {
    units: [f32; DIMENSIONS],
    radius: f32,
    groups: Vec<Group>,
    worst_m2: f32,
}

impl CoverageTable {
    /// Distance to the nearest centre in radii (up to 1 among the training boxes), and the error
    /// variance there, blended between centres by the inverse fourth power of their distance, m2;
    /// then the index of that centre.
    #[expect(
        clippy::needless_range_loop,
        reason = "in this form the compiler makes vectors of the lanes, with iterators it does not (4 times slower)"
    )]
    #[inline]
    pub(crate) fn look_up(&self, bounding_box: &BoundingBox) -> (f64, f64, usize) {
        let raw = coordinates(*bounding_box);
        // A few percent of a radius, squared, so that a box upon a centre has a finite weight.
        let soft = 1e-3 * self.radius * self.radius;
        let (mut least, mut sums, mut weights) = ([f32::INFINITY; LANES], [0.0f32; LANES], [0.0f32; LANES]);
        let point: [f32; DIMENSIONS] = std::array::from_fn(|axis| raw[axis] / self.units[axis]);
        let mut nearest = [0u32; LANES];
        for (at, group) in (0u32..).zip(&self.groups) {
            for lane in 0..LANES {
                let mut distance = 0.0;
                for axis in 0..DIMENSIONS {
                    let miss = group.axes[axis][lane] - point[axis];
                    distance += miss * miss;
                }
                let near = 1.0 / (distance + soft);
                nearest[lane] = if distance < least[lane] { at } else { nearest[lane] };
                least[lane] = if distance < least[lane] { distance } else { least[lane] };
                sums[lane] += near * near * group.errors_m2[lane];
                weights[lane] += near * near;
            }
        }
        let mut lane = 0;
        for other in 1..LANES {
            lane = if least[other] < least[lane] { other } else { lane };
        }
        let (least, nearest) = (least[lane], nearest[lane] as usize * LANES + lane);
        let weight: f32 = weights.iter().sum();
        // Far away all weights vanish in f32; the factor on the distance rules there anyway.
        let error_m2 = if weight > 1e-30 { sums.iter().sum::<f32>() / weight } else { self.worst_m2 };
        (f64::from(least.sqrt() / self.radius), f64::from(error_m2), nearest)
    }

    /// Pixels of the foot point that make one radius.
    #[inline]
    pub(crate) fn radius_px(&self) -> f64 {
        f64::from(self.radius * self.units[0].min(self.units[1]))
    }
}

fn coordinates(bounding_box: BoundingBox) -> [f32; DIMENSIONS] {
    let [foot_x, foot_y] = bounding_box.foot_px();
    [
        foot_x as f32,
        foot_y as f32,
        (bounding_box.width_px() as f32).ln(),
        (bounding_box.height_px() as f32).ln(),
    ]
}

#[inline(always)]
fn squared(left: &[f32; DIMENSIONS], right: &[f32; DIMENSIONS]) -> f32 {
    left.iter().zip(right).map(|(one, other)| (one - other) * (one - other)).sum()
}
