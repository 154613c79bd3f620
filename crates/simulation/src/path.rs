//! The lines that targets follow, and their motion along them.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::noise::{GaussMarkov, standard_normal};
use crate::geo::EastNorth;

/// A polyline in the plane.
#[derive(Debug, Clone)]
pub(super) struct Polyline {
    pub(super) points: Vec<EastNorth>,
}

/// Position of a target at one second, and its heading as a unit vector (east, north).
#[derive(Debug, Clone, Copy)]
pub(super) struct Pose {
    pub(super) position: EastNorth,
    pub(super) heading: [f64; 2],
}

/// Motion of a target along a path.
#[derive(Debug, Clone, Copy)]
pub(super) struct MotionProfile {
    /// Mean speed.
    pub(super) speed_m_s: f64,
    /// Standard deviation of a traverse's speed.
    pub(super) speed_sigma_m_s: f64,
    /// Standard deviation of the speed from one second to the next, relative to the traverse's speed.
    pub(super) speed_unrest: f64,
    /// Standard deviation of the lateral distance to the path, m.
    pub(super) lateral_deviation_m: f64,
    /// Longest halt in a traverse, s; 0 for none.
    pub(super) halt_s: f64,
    /// True if every second traverse is in the opposite direction.
    pub(super) both_ways: bool,
}

impl Polyline {
    /// Length in m.
    pub(super) fn length_m(&self) -> f64 {
        self.points.windows(2).map(|pair| pair[0].distance_m(pair[1])).sum()
    }

    /// The pose at a distance along the path, shifted to the left of it.
    pub(super) fn pose(&self, along_m: f64, left_offset_m: f64) -> Pose {
        let mut remaining_m = along_m.max(0.0);
        let last = self.points.len() - 2;
        for (index, pair) in self.points.windows(2).enumerate() {
            let length_m = pair[0].distance_m(pair[1]);
            if remaining_m <= length_m || index == last {
                let heading = [
                    (pair[1].east_m - pair[0].east_m) / length_m,
                    (pair[1].north_m - pair[0].north_m) / length_m,
                ];
                let step_m = remaining_m.min(length_m);
                let position = EastNorth {
                    east_m: pair[0].east_m + step_m * heading[0] - left_offset_m * heading[1],
                    north_m: pair[0].north_m + step_m * heading[1] + left_offset_m * heading[0],
                };
                return Pose { position, heading };
            }
            remaining_m -= length_m;
        }
        Pose { position: self.points[0], heading: [0.0, 1.0] }
    }

    /// One traverse from one end to the other, a pose per second.
    pub(super) fn traverse(
        &self,
        motion: &MotionProfile,
        backwards: bool,
        random: &mut ChaCha8Rng,
    ) -> Vec<Pose> {
        let length_m = self.length_m();
        let speed_m_s =
            (motion.speed_m_s + motion.speed_sigma_m_s * standard_normal(random)).max(0.4 * motion.speed_m_s);
        let halt_at_m = length_m * random.random_range(0.2..0.8);
        let mut remaining_halt_s = motion.halt_s * random.random_range(0.3..1.0);
        let mut deviation = GaussMarkov::new(20.0, random);
        let (mut along_m, mut poses) = (0.0, Vec::new());
        while along_m <= length_m {
            let halting = along_m > halt_at_m && remaining_halt_s >= 1.0;
            // The deviation of a halting target hardly changes.
            let lateral = deviation.advance(if halting { 0.05 } else { 1.0 }, random);
            let path_m = if backwards { length_m - along_m } else { along_m };
            let mut pose = self.pose(path_m, motion.lateral_deviation_m * lateral);
            if backwards {
                pose.heading = pose.heading.map(|part| -part);
            }
            poses.push(pose);
            if halting {
                remaining_halt_s -= 1.0;
            } else {
                along_m += speed_m_s * (1.0 + motion.speed_unrest * standard_normal(random)).max(0.2);
            }
        }
        poses
    }

    /// The polyline with all distances from the plane's origin multiplied.
    pub(super) fn scaled(&self, factor: f64) -> Self {
        let scaled =
            |point: &EastNorth| EastNorth { east_m: factor * point.east_m, north_m: factor * point.north_m };
        Self { points: self.points.iter().map(scaled).collect() }
    }

    /// Two straight legs joined by a curve about the corner.
    pub(super) fn bent(from: EastNorth, corner: EastNorth, to: EastNorth, radius_m: f64) -> Self {
        let unit = |tip: EastNorth| {
            let length_m = corner.distance_m(tip);
            [(tip.east_m - corner.east_m) / length_m, (tip.north_m - corner.north_m) / length_m]
        };
        let (back, ahead) = (unit(from), unit(to));
        let cosine = back[0] * ahead[0] + back[1] * ahead[1];
        let half_angle = 0.5 * cosine.clamp(-1.0, 1.0).acos();
        let cut_m = radius_m / half_angle.tan();
        // A quadratic Bezier curve tangent to both legs approximates an arc well enough for a taxiway.
        let mut points = vec![from];
        for step in 0..=24 {
            let part = f64::from(step) / 24.0;
            let (start, end) = (cut_m * (1.0 - part).powi(2), cut_m * part.powi(2));
            points.push(EastNorth {
                east_m: corner.east_m + start * back[0] + end * ahead[0],
                north_m: corner.north_m + start * back[1] + end * ahead[1],
            });
        }
        points.push(to);
        Self { points }
    }

    /// The parallel line at an offset to the left, m.
    pub(super) fn parallel(&self, left_offset_m: f64) -> Self {
        let mut along_m = 0.0;
        let mut points = Vec::with_capacity(self.points.len());
        for (index, &point) in self.points.iter().enumerate() {
            if index > 0 {
                along_m += self.points[index - 1].distance_m(point);
            }
            points.push(self.pose(along_m, left_offset_m).position);
        }
        Self { points }
    }
}

#[cfg(test)]
mod tests {
    use super::super::noise::stream;
    use super::*;

    fn corner() -> Polyline {
        let at = |east_m, north_m| EastNorth { east_m, north_m };
        Polyline { points: vec![at(0.0, 0.0), at(30.0, 0.0), at(30.0, 40.0)] }
    }

    #[test]
    fn a_traverse_goes_from_end_to_end_with_its_halt() {
        let motion = MotionProfile {
            speed_m_s: 1.2,
            speed_sigma_m_s: 0.0,
            speed_unrest: 0.05,
            lateral_deviation_m: 0.0,
            halt_s: 40.0,
            both_ways: true,
        };
        let poses = corner().traverse(&motion, false, &mut stream(1, 0));
        assert!(poses[0].position.distance_m(EastNorth::default()) < 1e-9);
        let end = EastNorth { east_m: 30.0, north_m: 40.0 };
        assert!(poses.last().expect("poses").position.distance_m(end) < 2.0);
        let halted =
            poses.windows(2).filter(|pair| pair[0].position.distance_m(pair[1].position) < 1e-9).count();
        assert!((10..=40).contains(&halted), "{halted}");
    }

    #[test]
    fn a_bend_is_longer_than_the_chord_and_shorter_than_the_corner() {
        let [from, turn, to] = corner().points[..] else { unreachable!("three points") };
        let bent = Polyline::bent(from, turn, to, 10.0).length_m();
        assert!(bent > 50.0 && bent < 70.0, "{bent}");
    }
}
