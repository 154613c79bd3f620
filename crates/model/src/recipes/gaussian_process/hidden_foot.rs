//! Boxes whose lower part something else hides: too short for their width and their place.
//!
//! Hypotheses about a box (left, top, width, height): it is whole; a share x of the target's height is hidden below it,
//! so the target's box has the height h / (1 - x) and its foot is lower; or it is of anything. The densities of log width
//! and log height at the hypothetical foot are those of the training boxes (`box_plausibility`), which have the heights
//! of different targets in them, with x uniform. Bayes' rule gives the probability that the foot is hidden. What hides a
//! foot mostly hides it in the next box, too, so the prior probability of a target's next box is the mean of what its latest
//! boxes tell one by one. Otherwise the boxes of a hidden foot that look whole by chance would tell its position alone, as
//! they state the smallest errors. What they tell is not multiplied, for a short target is short in every box.

use super::box_plausibility::{BoxPlausibility, RECENT_BOXES, RecentBoxes};
use super::projective_mean::Box4;
use crate::domain::BoundingBox;
use crate::encoder::features::features_of;

/// Prior probability that a foot is hidden, and that a box is of anything.
const HIDDEN: f64 = 0.05;
const ANYTHING: f64 = 0.01;
/// Density of a box of anything: uniform over a factor of 20 in width and in height.
const ANYTHING_DENSITY: f64 = 0.11;
/// Largest hidden share of a height.
const LARGEST_SHARE: f64 = 0.7;
/// A box at most this many standard deviations too short is whole.
const WHOLE_SIGMAS: f64 = 1.5;
/// Hypothetical heights, spaced evenly in the logarithm.
const STEPS: usize = 40;
/// Below this probability a foot is taken as seen.
const LEAST_PROBABILITY: f64 = 0.02;

/// A box whose foot may be hidden.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HiddenFoot {
    /// Probability that it is.
    pub probability: f64,
    /// The target's boxes if it is, with their weights, which sum to 1: mean and spread of the completed height.
    pub completed: [(f64, BoundingBox); 3],
}

impl HiddenFoot {
    /// `None` for a box that is most probably whole. `recent` is that of its target and takes the box in.
    #[inline]
    pub(crate) fn of(
        bounding_box: &BoundingBox,
        plausibility: &BoxPlausibility,
        recent: Option<&mut RecentBoxes>,
    ) -> Option<Self> {
        let prior = recent.as_ref().map_or(HIDDEN, |recent| recent.hidden.max(HIDDEN));
        let sides = features_of(bounding_box);
        let seen = plausibility.deviation(&sides);
        let is_whole = prior <= HIDDEN && seen.normalized[1] > -WHOLE_SIGMAS;
        let density = (!is_whole).then(|| hidden_density(plausibility, &sides));
        let posterior = |prior: f64| {
            let hidden = prior * density.map_or(0.0, |(density, ..)| density);
            let whole = (1.0 - prior - ANYTHING) * plausibility.density(&seen);
            hidden / (hidden + whole + ANYTHING * ANYTHING_DENSITY)
        };
        if let Some(recent) = recent {
            recent.hidden += (posterior(HIDDEN) - recent.hidden) / RECENT_BOXES as f64;
        }
        let (_, mean, variance) = density?;
        let probability = posterior(prior);
        if probability < LEAST_PROBABILITY {
            return None;
        }
        let at = |log_taller: f64| {
            let [left_px, top_px, width_px, height_px] = bounding_box.sides_px();
            BoundingBox::new(left_px, top_px, width_px, height_px * log_taller.max(0.0).exp()).ok()
        };
        // Three points with the moments of a normal distribution (Gauss and Hermite).
        let apart = (3.0 * variance).sqrt();
        let completed =
            [(2.0 / 3.0, at(mean)?), (1.0 / 6.0, at(mean - apart)?), (1.0 / 6.0, at(mean + apart)?)];
        Some(Self { probability, completed })
    }
}

/// Density of a box whose foot is hidden; mean and variance of the logarithm by which its target is taller.
fn hidden_density(plausibility: &BoxPlausibility, &[u, v, width, height]: &Box4) -> (f64, f64, f64) {
    let step = -(1.0 - LARGEST_SHARE).ln() / STEPS as f64;
    let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
    for at in 0..STEPS {
        let log_taller = (at as f64 + 0.5) * step;
        let whole = height * log_taller.exp();
        let deviation = plausibility.deviation(&[u, v + whole - height, width, whole]);
        // The share is uniform: dx = (1 - x) d ln(h / (1 - x)).
        let density = plausibility.density(&deviation) * (-log_taller).exp() * step / LARGEST_SHARE;
        sum += density;
        first += density * log_taller;
        second += density * log_taller * log_taller;
    }
    let mean = first / sum;
    (sum, mean, (second / sum - mean * mean).max(0.0))
}
