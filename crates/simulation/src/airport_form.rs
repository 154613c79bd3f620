//! Airports that differ from the scene's own in their camera, their ground or their runway.

use strum::{Display, EnumString, IntoStaticStr, VariantArray};

use super::camera::PinholeCamera;
use super::path::Polyline;
use crate::domain::Error;
use crate::geo::EastNorth;

/// Factor of the telephoto lens on the focal length, and on the distance of the lines.
const TELEPHOTO: f64 = 2.5;
/// Factor of the high tower on the camera's height.
const TOWER: f64 = 3.0;
/// Rise of the slope to the right of the optical axis, without a unit.
const SLOPE: f64 = 0.03;
/// Height of the step, m, and the width of the ramp to it.
const STEP_M: f64 = 2.0;
const RAMP_M: f64 = 20.0;
/// Factors of the fisheye lens on the focal length and its radial displacement at the image's corner.
const FISHEYE_FOCAL: f64 = 0.7;
const FISHEYE_DISTORTION: f64 = -0.25;

/// How an airport differs from the scene's own.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Default,
    Display,
    EnumString,
    IntoStaticStr,
    VariantArray,
)]
#[strum(serialize_all = "kebab-case", parse_err_ty = Error, parse_err_fn = unknown_form)]
pub enum AirportForm {
    /// It does not.
    #[default]
    Plain,
    /// The lines are 2.5 times as far away, under a lens of 2.5 times the focal length.
    Telephoto,
    /// The camera is three times as high.
    HighTower,
    /// The ground rises by 3 % to the right of the camera's optical axis.
    Slope,
    /// The straight line is an arc instead.
    CurvedRunway,
    /// The ground to the right of the optical axis is 2 m higher than that to the left.
    Step,
    /// The lens has 0.7 times the focal length and 25 % of barrel distortion.
    Fisheye,
}

impl AirportForm {
    /// All forms.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// The scene's camera in this form.
    pub(super) fn camera(self, own: PinholeCamera) -> PinholeCamera {
        match self {
            Self::Telephoto => PinholeCamera {
                focal_px: TELEPHOTO * own.focal_px,
                tilt_deg: own.tilt_deg / TELEPHOTO,
                ..own
            },
            Self::HighTower => {
                PinholeCamera { height_m: TOWER * own.height_m, tilt_deg: TOWER * own.tilt_deg, ..own }
            }
            Self::Fisheye => PinholeCamera {
                focal_px: FISHEYE_FOCAL * own.focal_px,
                lens_distortion: FISHEYE_DISTORTION,
                ..own
            },
            Self::Plain | Self::Slope | Self::CurvedRunway | Self::Step => own,
        }
    }

    /// The scene's lines in this form; `at` gives the point so far to the right of and along the optical axis, m.
    pub(super) fn paths(self, own: Vec<Polyline>, at: impl Fn(f64, f64) -> EastNorth) -> Vec<Polyline> {
        match self {
            Self::Telephoto => own.iter().map(|path| path.scaled(TELEPHOTO)).collect(),
            Self::CurvedRunway => {
                let arc = Polyline::bent(at(-250.0, 260.0), at(0.0, 480.0), at(250.0, 330.0), 320.0);
                own.into_iter().skip(1).chain([arc]).collect()
            }
            _ => own,
        }
    }

    /// Height of the ground above the foot of the mast, m, so far to the right of the optical axis.
    pub(super) fn ground_m(self, right_m: f64) -> f64 {
        match self {
            Self::Slope => SLOPE * right_m,
            Self::Step => STEP_M * (0.5 + right_m / RAMP_M).clamp(0.0, 1.0),
            _ => 0.0,
        }
    }
}

fn unknown_form(_: &str) -> Error {
    let known: Vec<&str> = AirportForm::ALL.iter().map(Into::into).collect();
    Error::invalid("airport_form", format!("must be one of {}", known.join(", ")))
}
