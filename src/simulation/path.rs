//! The lines that targets follow, and how far along a target is at each second.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::noise::{GaussMarkov, standard_normal};
use crate::geo::EastNorth;

/// A polyline in the plane.
#[derive(Debug, Clone)]
pub(super) struct Path {
    pub(super) points: Vec<EastNorth>,
}

/// A target at one second: its place and where it heads (unit vector east, north).
#[derive(Debug, Clone, Copy)]
pub(super) struct Pose {
    pub(super) place: EastNorth,
    pub(super) heading: [f64; 2],
}

/// How a target moves along a path.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gait {
    pub(super) speed_mps: f64,
    pub(super) speed_spread_mps: f64,
    /// Standard deviation of the distance to the path, m.
    pub(super) wander_m: f64,
    /// Longest halt in a pass, s; 0 for none.
    pub(super) halt_s: f64,
    /// Whether every second pass goes backwards.
    pub(super) both_ways: bool,
}

impl Path {
    /// Length in m.
    pub(super) fn length_m(&self) -> f64 {
        self.points.windows(2).map(|pair| pair[0].distance_m(pair[1])).sum()
    }

    /// The place at a distance along the path, aside of it to the left, and the path's direction.
    pub(super) fn pose(&self, along_m: f64, aside_m: f64) -> Pose {
        let mut left_m = along_m.max(0.0);
        let last = self.points.len() - 2;
        for (index, pair) in self.points.windows(2).enumerate() {
            let length_m = pair[0].distance_m(pair[1]);
            if left_m <= length_m || index == last {
                let heading = [
                    (pair[1].east_m - pair[0].east_m) / length_m,
                    (pair[1].north_m - pair[0].north_m) / length_m,
                ];
                let step_m = left_m.min(length_m);
                let place = EastNorth {
                    east_m: pair[0].east_m + step_m * heading[0] - aside_m * heading[1],
                    north_m: pair[0].north_m + step_m * heading[1] + aside_m * heading[0],
                };
                return Pose { place, heading };
            }
            left_m -= length_m;
        }
        Pose { place: self.points[0], heading: [0.0, 1.0] }
    }

    /// One pass, a pose a second from one end to the other.
    pub(super) fn pass(&self, gait: &Gait, backwards: bool, random: &mut ChaCha8Rng) -> Vec<Pose> {
        let length_m = self.length_m();
        let speed_mps =
            (gait.speed_mps + gait.speed_spread_mps * standard_normal(random)).max(0.4 * gait.speed_mps);
        let halt_at_m = length_m * random.random_range(0.2..0.8);
        let mut halt_left_s = gait.halt_s * random.random_range(0.3..1.0);
        let mut wander = GaussMarkov::new(20.0, random);
        let (mut along_m, mut poses) = (0.0, Vec::new());
        while along_m <= length_m {
            let halting = along_m > halt_at_m && halt_left_s >= 1.0;
            // A standing target does not wander.
            let aside = wander.advance(if halting { 0.05 } else { 1.0 }, random);
            let place_m = if backwards { length_m - along_m } else { along_m };
            let mut pose = self.pose(place_m, gait.wander_m * aside);
            if backwards {
                pose.heading = pose.heading.map(|part| -part);
            }
            poses.push(pose);
            if halting {
                halt_left_s -= 1.0;
            } else {
                along_m += speed_mps * (1.0 + 0.05 * standard_normal(random)).max(0.2);
            }
        }
        poses
    }

    /// A line with a round bend: straight to a corner, then an arc, then straight to the end.
    pub(super) fn bent(from: EastNorth, corner: EastNorth, to: EastNorth, radius_m: f64) -> Self {
        let unit = |tip: EastNorth| {
            let length_m = corner.distance_m(tip);
            [(tip.east_m - corner.east_m) / length_m, (tip.north_m - corner.north_m) / length_m]
        };
        let (back, ahead) = (unit(from), unit(to));
        let cosine = back[0] * ahead[0] + back[1] * ahead[1];
        let half_angle = 0.5 * cosine.clamp(-1.0, 1.0).acos();
        let cut_m = radius_m / half_angle.tan();
        // A quadratic curve touching both legs is close enough to an arc for a taxiway.
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

    /// The same line moved to its left, m.
    pub(super) fn aside(&self, aside_m: f64) -> Self {
        let mut along_m = 0.0;
        let mut points = Vec::with_capacity(self.points.len());
        for (index, &point) in self.points.iter().enumerate() {
            if index > 0 {
                along_m += self.points[index - 1].distance_m(point);
            }
            points.push(self.pose(along_m, aside_m).place);
        }
        Self { points }
    }
}

#[cfg(test)]
mod tests {
    use super::super::noise::stream;
    use super::*;

    fn corner() -> Path {
        let at = |east_m, north_m| EastNorth { east_m, north_m };
        Path { points: vec![at(0.0, 0.0), at(30.0, 0.0), at(30.0, 40.0)] }
    }

    #[test]
    fn a_pass_goes_from_end_to_end_with_its_halt() {
        let gait =
            Gait { speed_mps: 1.2, speed_spread_mps: 0.0, wander_m: 0.0, halt_s: 40.0, both_ways: true };
        let poses = corner().pass(&gait, false, &mut stream(1, 0));
        assert!(poses[0].place.distance_m(EastNorth::default()) < 1e-9);
        let end = EastNorth { east_m: 30.0, north_m: 40.0 };
        assert!(poses.last().expect("poses").place.distance_m(end) < 2.0);
        let still = poses.windows(2).filter(|pair| pair[0].place.distance_m(pair[1].place) < 1e-9).count();
        assert!((10..=40).contains(&still), "{still}");
    }

    #[test]
    fn a_bend_is_no_shorter_than_the_chord_and_no_longer_than_the_corner() {
        let [from, turn, to] = corner().points[..] else { unreachable!("three points") };
        let bent = Path::bent(from, turn, to, 10.0).length_m();
        assert!(bent > 50.0 && bent < 70.0, "{bent}");
    }
}
