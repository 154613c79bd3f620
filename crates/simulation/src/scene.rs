//! The two scenes: camera, paths, bodies and motion of the targets, receivers.

use std::f64::consts::TAU;

use rand::{Rng, RngExt};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

use super::airport_form::AirportForm;
use super::camera::{PinholeCamera, Point};
use super::path::{MotionProfile, Polyline, Pose};
use super::shape::TargetShape;
use crate::domain::{Error, ImageSize};
use crate::geo::{EastNorth, Position};

/// A kind of site with its targets and receivers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Display, EnumString, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_scene)]
pub enum Scene {
    /// The paper's scenario 1: an aircraft of 35 m taxiing along a straight and a curve, white
    /// GNSS noise.
    Airport,
    /// A pedestrian on a square, with a halt and a corner, and a phone's time-correlated GNSS error.
    Square,
}

impl Scene {
    /// All scenes.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// Name in commands and reports.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }

    /// Class of its targets, and prefix of their ids.
    pub(super) const fn class(self) -> &'static str {
        match self {
            Self::Airport => "aircraft",
            Self::Square => "person",
        }
    }

    /// Position of the camera's mast: the origin of the plane.
    pub(super) fn origin(self) -> Position {
        let (longitude_deg, latitude_deg) = match self {
            Self::Airport => (11.786_1, 48.353_8),
            Self::Square => (24.745_3, 59.437_1),
        };
        Position::new(longitude_deg, latitude_deg).expect("constants within range")
    }

    /// Draws a camera. On the square a longer focal length makes the border truncate boxes; at the
    /// airport the aircraft enters and leaves across the border in any case.
    pub(super) fn camera(self, border_cuts: bool, random: &mut impl Rng) -> PinholeCamera {
        let (size, height_m, focal_px, tilt_deg) = match self {
            Self::Airport => ((1920, 1080), 30.0, 1660.0, 4.0),
            Self::Square => ((1280, 720), 7.0, if border_cuts { 1800.0 } else { 1080.0 }, 13.0),
        };
        PinholeCamera {
            image_size: ImageSize::new(size.0, size.1).expect("constants above 0"),
            height_m: height_m * random.random_range(0.9..1.1),
            focal_px: focal_px * random.random_range(0.96..1.04),
            pan_deg: 360.0 * random.random::<f64>(),
            tilt_deg: tilt_deg + random.random_range(-0.7..0.7),
            lens_distortion: 0.0,
        }
    }

    /// The lines that targets follow in turn, about the camera's optical axis.
    pub(super) fn paths(self, form: AirportForm, pan_deg: f64) -> Vec<Polyline> {
        let at = |right_m: f64, ahead_m: f64| rotated(right_m, ahead_m, pan_deg);
        match self {
            Self::Airport => {
                let (from, to) = (at(-250.0, 260.0), at(250.0, 330.0));
                let straight = Polyline { points: vec![from, to] };
                let bent = Polyline::bent(from, at(30.0, 299.0), at(10.0, 620.0), 90.0);
                form.paths(vec![straight, bent], at)
            }
            Self::Square => vec![Polyline { points: vec![at(-9.0, 19.0), at(11.0, 25.0), at(2.0, 50.0)] }],
        }
    }

    /// Offset of [`super::Route::NewLine`] from the training lines, m.
    pub(super) const fn new_line_offset_m(self) -> f64 {
        match self {
            Self::Airport => 20.0,
            Self::Square => 2.0,
        }
    }

    pub(super) const fn motion(self) -> MotionProfile {
        match self {
            Self::Airport => MotionProfile {
                speed_m_s: 9.0,
                speed_sigma_m_s: 1.5,
                speed_unrest: 0.05,
                lateral_deviation_m: 1.0,
                halt_s: 0.0,
                both_ways: false,
            },
            Self::Square => MotionProfile {
                speed_m_s: 1.25,
                speed_sigma_m_s: 0.12,
                speed_unrest: 0.05,
                lateral_deviation_m: 0.3,
                halt_s: 40.0,
                both_ways: true,
            },
        }
    }

    /// Pause between two traverses of a target, s.
    pub(super) fn pause_s(self, random: &mut impl Rng) -> i64 {
        match self {
            Self::Airport => random.random_range(60..180),
            Self::Square => random.random_range(40..90),
        }
    }

    /// Time constant of a receiver's error, s; `None` where that is white.
    pub(super) fn gnss_time_constant_s(self, random: &mut impl Rng) -> Option<f64> {
        match self {
            Self::Airport => None,
            Self::Square => Some(random.random_range(35.0..60.0)),
        }
    }

    /// The line of one traverse of [`super::Route::Area`], within the view of every camera of the scene.
    pub(super) fn area_path(self, pan_deg: f64, random: &mut impl Rng) -> Polyline {
        let (nearest_m, farthest_m, corners, min_leg_m) = match self {
            Self::Airport => (210.0, 560.0, 2, 200.0),
            Self::Square => (19.0, 48.0, 3, 8.0),
        };
        let mut points: Vec<EastNorth> = Vec::with_capacity(corners);
        while points.len() < corners {
            let ahead_m: f64 = random.random_range(nearest_m..farthest_m);
            let point = rotated(0.45 * ahead_m * random.random_range(-1.0..1.0), ahead_m, pan_deg);
            if points.last().is_none_or(|last| last.distance_m(point) >= min_leg_m) {
                points.push(point);
            }
        }
        Polyline { points }
    }

    /// Extents and antenna of a target of nominal size.
    #[must_use]
    pub const fn nominal_shape(self) -> TargetShape {
        let (length_m, width_m, height_m, antenna_ahead_m) = match self {
            Self::Airport => (35.0, 34.0, 11.8, 3.0),
            Self::Square => (0.56, 0.48, 1.72, 0.0),
        };
        TargetShape { length_m, width_m, height_m, antenna_ahead_m, antenna_left_m: 0.0 }
    }

    /// Points of the outline of a target of that shape; `scale` 1 is its nominal size.
    pub(super) fn body(
        self,
        pose: Pose,
        shape: &TargetShape,
        scale: f64,
        random: &mut impl Rng,
    ) -> Vec<Point> {
        let [east, north] = pose.heading;
        let nominal = self.nominal_shape();
        let [along, across, upward] = [
            shape.length_m / nominal.length_m,
            shape.width_m / nominal.width_m,
            shape.height_m / nominal.height_m,
        ];
        let corner = |ahead_m: f64, left_m: f64, up_m: f64| {
            let ahead_m = (ahead_m + nominal.antenna_ahead_m) * along - shape.antenna_ahead_m;
            let left_m = left_m * across - shape.antenna_left_m;
            Point {
                ground: EastNorth {
                    east_m: pose.position.east_m + scale * (ahead_m * east - left_m * north),
                    north_m: pose.position.north_m + scale * (ahead_m * north + left_m * east),
                },
                up_m: scale * (up_m * upward),
            }
        };
        match self {
            Self::Airport => aircraft(&corner),
            Self::Square => pedestrian(&corner, random),
        }
    }
}

/// An airliner of 35 m, relative to its antenna on the roof, 3 m ahead of the centre.
fn aircraft(corner: &dyn Fn(f64, f64, f64) -> Point) -> Vec<Point> {
    let mut body = vec![
        corner(14.5, 0.0, 3.0),
        corner(9.5, 0.0, 0.0),
        corner(-19.0, 0.0, 11.8),
        corner(-20.5, 0.0, 11.8),
        corner(-20.5, 0.0, 4.5),
    ];
    for side in [-1.0, 1.0] {
        body.extend([
            corner(9.0, side * 2.0, 5.5),
            corner(9.0, side * 2.0, 1.5),
            corner(-10.0, side * 2.0, 5.8),
            corner(-4.5, side * 3.8, 0.0),
            corner(-8.0, side * 17.0, 4.2),
            corner(-18.5, side * 6.0, 5.5),
        ]);
    }
    body
}

/// A person of 1.72 m; arms and legs vary the box's width with every step.
fn pedestrian(corner: &dyn Fn(f64, f64, f64) -> Point, random: &mut impl Rng) -> Vec<Point> {
    let stride_m = 0.28 * (TAU * random.random::<f64>()).sin().abs();
    let mut body = vec![corner(0.0, 0.0, 1.72)];
    for side in [-1.0, 1.0] {
        body.extend([
            corner(0.0, side * 0.24, 1.4),
            corner(0.0, side * 0.24, 0.8),
            corner(side * stride_m, side * 0.08, 0.0),
            corner(side * 0.8 * stride_m, side * 0.24, 0.9),
        ]);
    }
    body
}

/// A point given relative to the camera's foot, to the right of and along its optical axis, in the
/// east-north plane.
fn rotated(right_m: f64, ahead_m: f64, pan_deg: f64) -> EastNorth {
    let (sin_pan, cos_pan) = pan_deg.to_radians().sin_cos();
    EastNorth {
        east_m: cos_pan * right_m + sin_pan * ahead_m,
        north_m: cos_pan * ahead_m - sin_pan * right_m,
    }
}

fn unknown_scene(_: &str) -> Error {
    Error::invalid("scene", "must be one of airport, square")
}
