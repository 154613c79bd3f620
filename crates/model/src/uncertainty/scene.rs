//! The scene of a model: the ground that its training boxes were on. A target in view is there or near it, so no
//! answer lies far outside, and no error is larger than the scene.

use crate::artifact::ModelParts;
use crate::domain::{Error, Result};
use crate::geo::{EastNorth, PlaneCovariance};

/// West, east, south and north end of the training positions, m.
const NAMES: [&str; 4] = ["scene_west_m", "scene_east_m", "scene_south_m", "scene_north_m"];
/// Share of the training positions on either side that the ends ignore: those of false boxes near the horizon.
const IGNORED_SHARE: f64 = 0.025;
/// The scene reaches beyond the training positions by their own range, by this at least, m: a target may be beyond
/// what few samples of one place have shown.
const LEAST_MARGIN_M: f64 = 100.0;
/// Distance from the training boxes in covering radii from which on a box may be of anything: four times that at which it
/// is outside of the training. At twice that ordinary boxes of a crowd had larger errors than they need.
pub(crate) const CREDIBLE_RATIO: f64 = 6.0;

/// Ends of the training positions, and of the scene about them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Scene {
    /// Least and greatest value of each axis of the training positions, m.
    range_m: [[f64; 2]; 2],
}

impl Scene {
    /// That of the positions of a model's training boxes; `None` without any.
    pub(crate) fn of(positions: &[EastNorth]) -> Option<Self> {
        let ends = |of: fn(&EastNorth) -> f64| {
            let mut values: Vec<f64> = positions.iter().map(of).collect();
            values.sort_by(f64::total_cmp);
            let ignored = (IGNORED_SHARE * values.len() as f64) as usize;
            Some([*values.get(ignored)?, *values.get(values.len().checked_sub(1 + ignored)?)?])
        };
        Some(Self { range_m: [ends(|point| point.east_m)?, ends(|point| point.north_m)?] })
    }

    /// Adds the scene to the parts of a model.
    pub(crate) fn put(&self, parts: &mut ModelParts) {
        for (name, end_m) in NAMES.into_iter().zip(self.range_m.as_flattened()) {
            parts.set(name, *end_m);
        }
    }

    /// The scene of a model; `None` before it is known.
    ///
    /// # Errors
    /// Names the parameter that is missing although others are there, or cannot be used.
    pub(crate) fn read(parts: &ModelParts) -> Result<Option<Self>> {
        if !NAMES.iter().any(|name| parts.parameters.contains_key(*name)) {
            return Ok(None);
        }
        let [west, east, south, north] = NAMES;
        let axis = |low: &str, high: &str| {
            let ends_m = [parts.parameter(low)?, parts.parameter(high)?];
            let message = || format!("must be at least {low}");
            let is_ordered = ends_m[0] <= ends_m[1];
            is_ordered
                .then_some(ends_m)
                .ok_or_else(|| Error::invalid(format!("metadata.parameters.{high}"), message()))
        };
        Ok(Some(Self { range_m: [axis(west, east)?, axis(south, north)?] }))
    }

    /// Centre of the training positions, m.
    pub(crate) fn centre_m(&self) -> [f64; 2] {
        self.range_m.map(|[low, high]| 0.5 * (low + high))
    }

    /// Variance of a position anywhere in their range, m2.
    pub(crate) fn variance_m2(&self) -> [f64; 2] {
        self.range_m.map(|[low, high]| (high - low).powi(2) / 12.0)
    }

    /// Least and greatest value of each axis of the scene, m.
    pub(crate) fn bounds_m(&self) -> [[f64; 2]; 2] {
        self.range_m.map(|[low, high]| {
            let margin_m = (high - low).max(LEAST_MARGIN_M);
            [low - margin_m, high + margin_m]
        })
    }

    /// The nearest point of the scene.
    pub(crate) fn nearest(&self, EastNorth { east_m, north_m }: EastNorth) -> EastNorth {
        let [[west_m, east_end_m], [south_m, north_end_m]] = self.bounds_m();
        EastNorth { east_m: east_m.clamp(west_m, east_end_m), north_m: north_m.clamp(south_m, north_end_m) }
    }

    /// Distance from a point of the scene to the farthest other, m.
    pub(crate) fn reach_m(&self, EastNorth { east_m, north_m }: EastNorth) -> f64 {
        let [east, north] = self.bounds_m();
        let farthest = |[low, high]: [f64; 2], at_m: f64| (at_m - low).max(high - at_m);
        farthest(east, east_m).hypot(farthest(north, north_m))
    }

    /// A box's position within the scene, with its error: the larger, the farther the box is from those of training
    /// (`extrapolation_ratio`), and no larger than the scene. `radius_m` gives the 95 % radius of a covariance, m.
    ///
    /// A box of which training says nothing may be of anything in the scene: with the weight w of that case the error has
    /// the covariance `V + w ((y - m) (y - m)' + V_scene)`, the moments of the mixture.
    #[inline]
    pub(crate) fn limit(
        &self,
        position: EastNorth,
        covariance: PlaneCovariance,
        extrapolation_ratio: f64,
        radius_m: impl Fn(PlaneCovariance) -> f64,
    ) -> Limited {
        let nearest = self.nearest(position);
        let weight = if nearest == position { implausibility(extrapolation_ratio) } else { 1.0 };
        let mut covariance = covariance;
        if weight > 0.0 {
            let [[centre_east_m, centre_north_m], [east_m2, north_m2]] =
                [self.centre_m(), self.variance_m2()];
            let anywhere = PlaneCovariance { east_m2, north_m2, east_north_m2: 0.0 };
            let moved =
                PlaneCovariance::outer(nearest.east_m - centre_east_m, nearest.north_m - centre_north_m);
            covariance = covariance.plus(anywhere.plus(moved).scaled(weight));
        }
        let factor = (self.reach_m(nearest) / radius_m(covariance)).min(1.0).powi(2);
        Limited { position: nearest, covariance: covariance.scaled(factor), factor }
    }
}

/// A position within the scene.
pub(crate) struct Limited {
    pub(crate) position: EastNorth,
    pub(crate) covariance: PlaneCovariance,
    /// By which the covariance and each of its parts were made smaller, at most 1.
    pub(crate) factor: f64,
}

/// Weight of the case that a box is of anything: 0 near the boxes of training, to 1.
#[inline]
fn implausibility(extrapolation_ratio: f64) -> f64 {
    let share = CREDIBLE_RATIO / extrapolation_ratio.max(CREDIBLE_RATIO);
    1.0 - share * share
}
