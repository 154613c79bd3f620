//! Still pictures of an empty site: a quay with paving, a roadway and water, drawn pixel by pixel on the ground.

use super::layout::{self, SiteCamera};
use super::options::SiteOptions;
use crate::geo::EastNorth;

type Colour = [f64; 3];

const SKY: Colour = [196.0, 214.0, 228.0];
const WATER: Colour = [86.0, 118.0, 134.0];
const EDGE: Colour = [120.0, 116.0, 108.0];
const ASPHALT: Colour = [112.0, 114.0, 116.0];
const MARKING: Colour = [214.0, 212.0, 204.0];
const PAVING: Colour = [176.0, 169.0, 157.0];
const JOINT: Colour = [141.0, 134.0, 124.0];

/// Where the paving, the roadway and the edge of the quay end, north of the cameras, m.
const PAVING_END_M: f64 = 36.0;
const ROADWAY_END_M: f64 = 44.0;
const EDGE_END_M: f64 = 47.0;
/// The line between the lanes, m.
const LINE_M: f64 = 40.0;
/// Side of a slab, and width of the joints, m.
const SLAB_M: f64 = 3.0;
const JOINT_M: f64 = 0.12;
/// Distance at which details have faded to 1/e, m.
const HAZE_M: f64 = 220.0;

/// A picture without targets: rows of pixels from the upper left corner, each of red, green and blue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Still {
    /// Width, px.
    pub width_px: u32,
    /// Height, px.
    pub height_px: u32,
    /// `3 * width_px * height_px` bytes.
    pub rgb: Vec<u8>,
}

/// The picture that each camera of a site has while nobody is in view, at half the resolution of its image.
#[must_use]
pub fn site_stills(options: &SiteOptions) -> Vec<Still> {
    layout::cameras(options).iter().map(still).collect()
}

fn still(camera: &SiteCamera) -> Still {
    let size = camera.image_size();
    let (width_px, height_px) = (size.width_px() / 2, size.height_px() / 2);
    let mut rgb = Vec::with_capacity(3 * width_px as usize * height_px as usize);
    for row in 0..height_px {
        for column in 0..width_px {
            let (column_px, row_px) = (2.0 * f64::from(column) + 1.0, 2.0 * f64::from(row) + 1.0);
            let colour =
                camera.ground_at(column_px, row_px).map_or(SKY, |ground| ground_colour(camera, ground));
            rgb.extend(colour.map(|part| part.round() as u8));
        }
    }
    Still { width_px, height_px, rgb }
}

/// The colour of a point of the ground, paler with the distance.
fn ground_colour(camera: &SiteCamera, ground: EastNorth) -> Colour {
    let clarity = (-camera.distance_m(ground) / HAZE_M).exp();
    blend(SKY, material(ground, clarity), clarity.sqrt())
}

/// The colour of the ground. Fine patterns fade with the clarity, or they would flicker in the distance.
fn material(EastNorth { east_m, north_m }: EastNorth, clarity: f64) -> Colour {
    if north_m < PAVING_END_M {
        let is_joint = east_m.rem_euclid(SLAB_M) < JOINT_M || north_m.rem_euclid(SLAB_M) < JOINT_M;
        blend(PAVING, if is_joint { JOINT } else { PAVING }, clarity)
    } else if north_m < ROADWAY_END_M {
        let is_marked = (north_m - LINE_M).abs() < 0.08 && east_m.rem_euclid(6.0) < 3.0;
        if is_marked { MARKING } else { ASPHALT }
    } else if north_m < EDGE_END_M {
        EDGE
    } else {
        let wave = (0.8 * north_m + 1.7 * (0.11 * east_m).sin()).sin();
        WATER.map(|part| part + 7.0 * clarity * wave)
    }
}

fn blend(from: Colour, to: Colour, share: f64) -> Colour {
    std::array::from_fn(|part| from[part] + share * (to[part] - from[part]))
}
