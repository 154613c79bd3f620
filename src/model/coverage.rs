//! How far a box lies from those of the training samples.
//!
//! What never happens here: a judgement on positions; only boxes are compared.

use crate::domain::BoundingBox;

/// Representative boxes at most; each costs some nanoseconds in every answer.
pub(super) const MOST_CENTRES: usize = 64;
/// Numbers per centre.
pub(super) const DIMENSIONS: usize = 4;

/// A set of representative training boxes, and the radius about them that holds all of those.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Coverage {
    /// What coordinates are divided by: foot x, foot y (px), and the logarithms of the sides.
    pub(super) units: [f32; DIMENSIONS],
    /// Centres in units.
    pub(super) centres: Vec<[f32; DIMENSIONS]>,
    /// No training box is farther from its nearest centre, in units.
    pub(super) radius: f32,
}

impl Coverage {
    /// Picks the centres by always taking the box farthest from those picked.
    pub(super) fn new(boxes: impl Iterator<Item = BoundingBox> + Clone) -> Self {
        let raw: Vec<[f32; DIMENSIONS]> = boxes.map(coordinates).collect();
        let units = std::array::from_fn(|axis| {
            let deviation = super::rows::spread(raw.iter().map(|point| f64::from(point[axis])));
            // Sizes that hardly vary must not make a pixel's jitter look far away.
            (deviation as f32).max(if axis < 2 { 4.0 } else { 0.1 })
        });
        let points: Vec<[f32; DIMENSIONS]> =
            raw.iter().map(|point| std::array::from_fn(|axis| point[axis] / units[axis])).collect();
        let mut coverage = Self { units, centres: Vec::new(), radius: 0.0 };
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
        coverage
    }

    /// Distance to the nearest centre in radii: up to 1 among the training boxes.
    #[inline]
    pub(super) fn distance(&self, bounding_box: &BoundingBox) -> f64 {
        let raw = coordinates(*bounding_box);
        let point: [f32; DIMENSIONS] = std::array::from_fn(|axis| raw[axis] / self.units[axis]);
        let least = self.centres.iter().map(|centre| squared(centre, &point)).fold(f32::INFINITY, f32::min);
        f64::from(least.sqrt() / self.radius)
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
