//! Walkers and vehicles along the street.

use std::f64::consts::TAU;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::layout::{LANES_M, PAVEMENT_M, STREET_END_M};
use crate::camera::Point;
use crate::geo::EastNorth;
use crate::noise::standard_normal;
use crate::path::Pose;
use crate::scene::Scene;

/// Time constant of a target's deviations from its mean speed, s.
const SPEED_TIME_S: f64 = 5.0;
/// Share of the waypoints at which a walker halts, and for how long, s.
const HALT_SHARE: f64 = 0.25;
const HALT_S: [f64; 2] = [3.0, 15.0];
/// Length, width and height of a vehicle, m.
const VEHICLE_M: [f64; 3] = [4.4, 1.8, 1.5];

/// A target that goes from waypoint to waypoint without end.
pub(super) struct Mover {
    is_vehicle: bool,
    street_m: f64,
    pose: Pose,
    waypoint: EastNorth,
    mean_speed_m_s: f64,
    /// Deviation of the speed, relative to the mean.
    speed_deviation: f64,
    halt_s: f64,
    random: ChaCha8Rng,
    /// Random numbers of the outline, drawn per camera: it must not change the motion.
    gait: ChaCha8Rng,
}

impl Mover {
    pub(super) fn new(is_vehicle: bool, street_m: f64, mut random: ChaCha8Rng, gait: ChaCha8Rng) -> Self {
        let mean_speed_m_s =
            if is_vehicle { random.random_range(6.0..9.0) } else { random.random_range(1.0..1.6) };
        let position = EastNorth::default();
        let pose = Pose { position, heading: [1.0, 0.0] };
        let mut mover = Self {
            is_vehicle,
            street_m,
            pose,
            waypoint: position,
            mean_speed_m_s,
            speed_deviation: 0.0,
            halt_s: 0.0,
            random,
            gait,
        };
        mover.pose.position = mover.anywhere();
        mover.waypoint = mover.next_waypoint();
        mover
    }

    /// Class, and prefix of the name.
    pub(super) const fn class(&self) -> &'static str {
        if self.is_vehicle { "vehicle" } else { "person" }
    }

    pub(super) const fn pose(&self) -> Pose {
        self.pose
    }

    /// Moves on for some seconds.
    pub(super) fn advance(&mut self, seconds: f64) {
        let decay = (-seconds / SPEED_TIME_S).exp();
        self.speed_deviation = decay * self.speed_deviation
            + 0.1 * (1.0 - decay * decay).sqrt() * standard_normal(&mut self.random);
        if self.halt_s > 0.0 {
            self.halt_s -= seconds;
            return;
        }
        let mut remaining_m = (self.mean_speed_m_s * (1.0 + self.speed_deviation)).max(0.0) * seconds;
        loop {
            let distance_m = self.pose.position.distance_m(self.waypoint);
            if distance_m > remaining_m {
                let part = remaining_m / distance_m;
                let step = |from: f64, to: f64| from + part * (to - from);
                self.pose.heading = [
                    (self.waypoint.east_m - self.pose.position.east_m) / distance_m,
                    (self.waypoint.north_m - self.pose.position.north_m) / distance_m,
                ];
                self.pose.position = EastNorth {
                    east_m: step(self.pose.position.east_m, self.waypoint.east_m),
                    north_m: step(self.pose.position.north_m, self.waypoint.north_m),
                };
                return;
            }
            remaining_m -= distance_m;
            self.pose.position = self.waypoint;
            self.waypoint = self.next_waypoint();
            if !self.is_vehicle && self.random.random::<f64>() < HALT_SHARE {
                self.halt_s = self.random.random_range(HALT_S[0]..HALT_S[1]);
                return;
            }
        }
    }

    /// Goes where another one goes, at a distance (m) from it.
    pub(super) const fn accompany(&mut self, leader: Pose, offset_m: EastNorth) {
        let EastNorth { east_m, north_m } = leader.position;
        let position = EastNorth { east_m: east_m + offset_m.east_m, north_m: north_m + offset_m.north_m };
        self.pose = Pose { position, ..leader };
    }

    /// Points of the outline.
    pub(super) fn body(&mut self) -> Vec<Point> {
        if !self.is_vehicle {
            let shape = Scene::Square.nominal_shape();
            return Scene::Square.body(self.pose, &shape, 1.0, &mut self.gait);
        }
        let [length_m, width_m, height_m] = VEHICLE_M;
        let [east, north] = self.pose.heading;
        let corner = |number: usize| {
            let side = |bit: usize| if number >> bit & 1 == 1 { 0.5 } else { -0.5 };
            let (ahead_m, left_m) = (side(0) * length_m, side(1) * width_m);
            Point {
                ground: EastNorth {
                    east_m: self.pose.position.east_m + ahead_m * east - left_m * north,
                    north_m: self.pose.position.north_m + ahead_m * north + left_m * east,
                },
                up_m: (side(2) + 0.5) * height_m,
            }
        };
        (0..8).map(corner).collect()
    }

    fn anywhere(&mut self) -> EastNorth {
        let east_m = self.random.random_range(-STREET_END_M..self.street_m + STREET_END_M);
        EastNorth { east_m, north_m: self.lane_m() }
    }

    /// Some way along the street; vehicles turn at its ends.
    fn next_waypoint(&mut self) -> EastNorth {
        let (west_m, east_m) = (-STREET_END_M, self.street_m + STREET_END_M);
        if self.is_vehicle {
            let goes_east = self.pose.position.east_m < 0.5 * (west_m + east_m);
            let lane = LANES_M[usize::from(goes_east)];
            return EastNorth { east_m: if goes_east { east_m } else { west_m }, north_m: lane };
        }
        let direction = (TAU * self.random.random::<f64>()).cos().signum();
        let step_m = direction * self.random.random_range(10.0..40.0);
        let along_m = self.pose.position.east_m + step_m;
        let turned_m = if (west_m..east_m).contains(&along_m) { along_m } else { along_m - 2.0 * step_m };
        EastNorth { east_m: turned_m.clamp(west_m, east_m), north_m: self.lane_m() }
    }

    fn lane_m(&mut self) -> f64 {
        if self.is_vehicle {
            LANES_M[usize::from(self.random.random::<bool>())]
        } else {
            self.random.random_range(PAVEMENT_M[0]..PAVEMENT_M[1])
        }
    }
}
