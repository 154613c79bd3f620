//! The cameras of a site trained together: one homography of the foot point per camera, all in one least-squares
//! problem.
//!
//! A fix measures the mean position over the cameras that see its receiver, and two cameras that see one target
//! at one time are compared in pixels. So the maps agree with each other better than the fixes could make them,
//! and the covariance of all parameters says which part of a position's error the cameras have in common.
//! The files in the order of their layers: `input`, `rows`, `ground_map`, `least_squares`, `maps`, `stored`, `fit`.

mod fit;
mod ground_map;
mod input;
mod least_squares;
mod maps;
pub(crate) mod rows;
mod stored;
#[cfg(test)]
mod tests;

pub use fit::fit_site;
pub(crate) use fit::fit_site_observed;
pub use input::{RECEIVER_CORRELATION, SiteFitError, SiteFitInput, SiteFix, SiteKnownPoint, SitePair};
pub use maps::{SiteMaps, SitePosition};
pub use rows::box_at;
pub(crate) use stored::JointMap;
