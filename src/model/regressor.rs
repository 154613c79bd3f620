//! A model that answers: one box in, one position with its error out, without allocation.
//!
//! What never happens here: candle, training, GNSS fusion (that is the floor above).

use crate::domain::{BoundingBox, Error, ImageSize, Recipe, Result};
use crate::geo::{EastNorth, LocalPlane};
use crate::model::artifact::Parts;
use crate::model::artifact::TrackBeliefs;
use crate::model::encoder::hybrid::HybridRegressor;
use crate::model::encoder::paper::PaperRegressor;
use crate::model::encoder::projection::{SIDES, sides_of};
use crate::model::encoder::projective::ProjectiveRegressor;
use crate::model::uncertainty::coverage::CoverageTable;
use crate::model::uncertainty::local_boxes::Cells;

/// Radius that holds 95 % of a circular normal distribution, in standard deviations per axis.
pub const R95_PER_SIGMA: f64 = 2.447_746_830_680_816;
/// Up to this many radii of the training boxes the error is that of the nearest of them; beyond it
/// a box is outside.
const OUTSIDE_RADII: f64 = 1.5;

/// Share of a regression's error that is new with each box, where the model does not say.
const UNKNOWN_UNREST_SHARE: f64 = 0.3;

/// The one-step answer for one box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Regression {
    /// Position in the model's plane.
    pub regressed: EastNorth,
    /// eX of (2), in the recipe's units.
    pub reconstruction_error: f64,
    /// Error variance per axis, m2; above 0.
    pub e_regression_m2: f64,
    /// Whether the box is unlike those of the training samples.
    pub outside_training: bool,
    /// `r95_m = r95_scale * sqrt(e)` of the regressed and of the fused position.
    pub r95_scale: f64,
}

impl Regression {
    /// The error variance per axis, m2, at the size that the 95 % radius promises.
    #[must_use]
    pub fn variance_m2(&self) -> f64 {
        (self.r95_scale / R95_PER_SIGMA).powi(2) * self.e_regression_m2
    }
}

/// How much of the error given to unusual boxes training has shown to be there.
#[derive(Debug, Clone, Copy)]
struct Shown {
    /// Up to this error variance, m2.
    upto_m2: f64,
    /// So much of it.
    factor: f64,
}

impl Default for Shown {
    fn default() -> Self {
        Self { upto_m2: 0.0, factor: 1.0 }
    }
}

/// What the training boxes say of one box.
struct Near {
    /// Distance to the nearest of them, in radii.
    radii: f64,
    /// Error variance there, m2.
    usual_m2: f64,
    /// What a box that looks like none of them adds, m2.
    astray_m2: f64,
}

#[derive(Debug, Clone)]
enum Kind {
    Paper(Box<PaperRegressor>),
    Hybrid(Box<HybridRegressor>),
    Projective(Box<ProjectiveRegressor>),
}

/// A loaded model: flat weights, shared freely between threads.
#[derive(Debug, Clone)]
pub struct Regressor {
    plane: LocalPlane,
    e_gnss_m2: f64,
    r95_scale: f64,
    /// Es, m2 per unit of reconstruction error beyond the usual.
    error_scale: f64,
    reconstruction_usual: f64,
    border_factor: f64,
    unrest_share: f64,
    /// What training has shown of unusual boxes, those in full sight and those at the border.
    shown: [Shown; 2],
    image_size: Option<ImageSize>,
    coverage: CoverageTable,
    track_beliefs: Option<TrackBeliefs>,
    /// Added to every error variance, m2 per axis.
    added_m2: f64,
    cells: Cells,
    kind: Kind,
}

impl Regressor {
    /// Parameters that tell how far, and how much, the error given to unusual boxes was there in
    /// training; by [`Self::sight`].
    pub(super) const SHOWN_NAMES: [[&'static str; 2]; 2] =
        [["extra_shown_m2", "extra_factor"], ["border_extra_shown_m2", "border_extra_factor"]];

    pub(super) fn build(mut parts: Parts) -> Result<Self> {
        let coverage = parts.take_coverage()?;
        let cells = parts.take_cells(&coverage)?;
        let coverage = coverage.table();
        let kind = match parts.recipe {
            Recipe::Paper => Kind::Paper(Box::new(PaperRegressor::build(&mut parts)?)),
            Recipe::Hybrid => Kind::Hybrid(Box::new(HybridRegressor::build(&mut parts)?)),
            Recipe::Projective => Kind::Projective(Box::new(ProjectiveRegressor::build(&mut parts)?)),
            Recipe::Auto => {
                let message = "must be the recipe that auto has chosen: paper, hybrid or projective";
                return Err(Error::invalid("metadata.recipe", message));
            }
        };
        let image_size = image_size_of(&parts)?;
        let r95_scale = parts.positive_parameter("r95_scale")?;
        let track_beliefs = TrackBeliefs::read(&parts)?;
        let (reconstruction_usual, border_factor) = match kind {
            Kind::Paper(_) => (0.0, 1.0),
            _ => (
                parts.positive_parameter("reconstruction_usual")?,
                parts.positive_parameter("border_factor")?,
            ),
        };
        // Models of before do not tell it.
        let or = |name: &str, unknown: f64| match parts.parameters.contains_key(name) {
            true => parts.parameter(name),
            false => Ok(unknown),
        };
        let unrest_share = or("unrest_share", UNKNOWN_UNREST_SHARE)?.clamp(0.0, 1.0);
        let mut shown = [Shown::default(); 2];
        for (shown, [upto_m2, factor]) in shown.iter_mut().zip(Self::SHOWN_NAMES) {
            *shown = Shown { upto_m2: or(upto_m2, 0.0)?.max(0.0), factor: or(factor, 1.0)?.max(0.0) };
        }
        let Parts { plane, e_gnss_m2, error_scale, tensors, .. } = parts;
        tensors.finish()?;
        Ok(Self {
            plane,
            e_gnss_m2,
            r95_scale,
            error_scale,
            reconstruction_usual,
            border_factor,
            unrest_share,
            shown,
            image_size,
            coverage,
            track_beliefs,
            added_m2: 0.0,
            cells,
            kind,
        })
    }

    /// The same model, less sure of all it says: for a camera that was moved since.
    #[must_use]
    pub fn with_added_error(&self, added_m2: f64) -> Self {
        Self { added_m2, ..self.clone() }
    }

    /// The plane in which it answers.
    #[must_use]
    pub const fn plane(&self) -> &LocalPlane {
        &self.plane
    }

    /// The receiver's error variance per axis, m2.
    #[must_use]
    pub const fn e_gnss_m2(&self) -> f64 {
        self.e_gnss_m2
    }

    /// What a track should believe of receiver and model, if the model tells it.
    #[must_use]
    pub const fn track_beliefs(&self) -> Option<TrackBeliefs> {
        self.track_beliefs
    }

    /// Share of its error variance that is new with each box, 0 to 1; the rest is the same wherever
    /// the target comes by again.
    #[must_use]
    pub const fn unrest_share(&self) -> f64 {
        self.unrest_share
    }

    /// Size of the image that it was trained on, if known.
    pub(super) const fn image_size(&self) -> Option<ImageSize> {
        self.image_size
    }

    /// Where the target in a box stands, and how sure that is. The fix only matters to the network
    /// of the recipe `paper` that has it among its inputs.
    #[must_use]
    pub fn regress(&self, bounding_box: &BoundingBox, fix: Option<EastNorth>) -> Regression {
        let near = self.near(bounding_box);
        let (regressed, reconstruction_error, e_m2) = match &self.kind {
            // To the letter: the error is Es * eX and nothing else.
            Kind::Paper(paper) => paper.regress(&self.plane, bounding_box, fix),
            Kind::Hybrid(hybrid) => self.judged(bounding_box, &near, hybrid.regress(bounding_box)),
            Kind::Projective(projective) => {
                self.judged(bounding_box, &near, projective.regress(bounding_box))
            }
        };
        Regression {
            regressed,
            reconstruction_error,
            // The bounds keep every weight and radius finite whatever the net says.
            e_regression_m2: (e_m2 + self.added_m2).clamp(1e-6, 1e12),
            outside_training: near.radii > OUTSIDE_RADII,
            r95_scale: self.r95_scale,
        }
    }

    /// Position, and the sides (foot x, foot y, width, height, px) that the decoder rebuilds from it;
    /// those of the box itself where the recipe has no such decoder.
    pub(super) fn encode(&self, bounding_box: &BoundingBox) -> (EastNorth, [f64; SIDES]) {
        match &self.kind {
            Kind::Paper(paper) => (paper.regress(&self.plane, bounding_box, None).0, sides_of(bounding_box)),
            Kind::Hybrid(hybrid) => hybrid.regress(bounding_box),
            Kind::Projective(projective) => projective.regress(bounding_box),
        }
    }

    #[inline]
    fn near(&self, bounding_box: &BoundingBox) -> Near {
        let (radii, usual_m2, centre) = self.coverage.look_up(bounding_box);
        Near { radii, usual_m2, astray_m2: self.cells.astray_m2(centre, bounding_box) }
    }

    /// Reconstruction error, in squared box heights, and error variance: what is usual at that
    /// place, what the box's contradiction adds, wider beyond the training boxes and at the border.
    #[inline]
    fn judged(
        &self,
        bounding_box: &BoundingBox,
        near: &Near,
        (regressed, rebuilt): (EastNorth, [f64; SIDES]),
    ) -> (EastNorth, f64, f64) {
        let reconstruction_error = reconstruction_error(bounding_box, &rebuilt);
        let beyond = (near.radii - OUTSIDE_RADII).max(0.0);
        let border = if bounding_box.touches_border(self.image_size) { self.border_factor } else { 1.0 };
        let extra_m2 = self.unusual_m2(bounding_box, near, reconstruction_error);
        // What training has shown of such boxes counts as it was there, the rest in full.
        let shown = self.shown[self.sight(bounding_box)];
        let shown_m2 = extra_m2.min(shown.upto_m2);
        let e_m2 = near.usual_m2 * border * (1.0 + beyond * beyond)
            + shown.factor * shown_m2
            + (extra_m2 - shown_m2);
        (regressed, reconstruction_error, e_m2)
    }

    /// 0 for a box in full sight, 1 for one at the border of the image.
    #[inline]
    pub(super) fn sight(&self, bounding_box: &BoundingBox) -> usize {
        usize::from(bounding_box.touches_border(self.image_size))
    }

    /// Error variance that a box's unusual looks add, by geometry alone, m2.
    #[inline]
    fn unusual_m2(&self, bounding_box: &BoundingBox, near: &Near, reconstruction_error: f64) -> f64 {
        let excess = (reconstruction_error - self.reconstruction_usual).max(0.0);
        let beyond = (near.radii - OUTSIDE_RADII).max(0.0);
        // A box beyond those of training may be a wrong box; then its foot is as far from the truth.
        let astray = beyond * self.coverage.radius_px() / bounding_box.height_px();
        near.astray_m2 + self.error_scale * (excess + astray * astray)
    }

    /// The same before it is known how much of it there is, for calibration.
    pub(super) fn extra_m2(&self, bounding_box: &BoundingBox) -> f64 {
        let (_, rebuilt) = self.encode(bounding_box);
        let near = self.near(bounding_box);
        self.unusual_m2(bounding_box, &near, reconstruction_error(bounding_box, &rebuilt))
    }
}

/// Mean square of what the decoder missed of the sides, in squared box heights.
#[inline]
fn reconstruction_error(bounding_box: &BoundingBox, rebuilt: &[f64; SIDES]) -> f64 {
    let sides = sides_of(bounding_box);
    let squares = sides.iter().zip(rebuilt).map(|(one, other)| (one - other) * (one - other));
    squares.sum::<f64>() / (SIDES as f64 * bounding_box.height_px() * bounding_box.height_px())
}

fn image_size_of(parts: &Parts) -> Result<Option<ImageSize>> {
    if !parts.parameters.contains_key("image_width_px") {
        return Ok(None);
    }
    let side = |name: &str| parts.positive_parameter(name).map(|side_px| side_px as u32);
    let size = ImageSize::new(side("image_width_px")?, side("image_height_px")?);
    size.map(Some).map_err(|error| error.under("metadata.parameters.image"))
}
