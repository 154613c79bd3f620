//! The options and the progress of an evaluation.

use crate::domain::{GnssBiasSigma, ImageSize, Method, Observation, Recipe, SigmaM};
use crate::geo::Position;

/// One row of the test file, for which every method predicts a position.
#[derive(Debug, Clone, PartialEq)]
pub struct TestRow {
    /// Box, fix, or both.
    pub observation: Observation,
    /// The target's true position, if the row states it.
    pub truth: Option<Position>,
}

/// The methods to compare and the settings that they share.
#[derive(Clone)]
pub struct EvaluateOptions {
    /// Methods, in the order of the report's table.
    pub methods: Vec<Method>,
    /// The recipe whose model the track methods use.
    pub default_recipe: Recipe,
    /// Number of seeds: every seed from 1 to this one is evaluated.
    pub seeds: u64,
    /// Training epochs of every fit; `None` for the recipe's own number.
    pub epochs: Option<u32>,
    /// Size of the camera's image, if known.
    pub image_size: Option<ImageSize>,
    /// Standard deviation per axis of the receiver, if known.
    pub gnss_sigma: Option<SigmaM>,
    /// The bias that all fixes have in common, if known.
    pub gnss_bias_sigma: Option<GnssBiasSigma>,
    /// The test boxes' left and top edges are moved outwards by this many px, as in the paper's test
    /// of inaccurate boxes.
    pub box_shift_px: f64,
    /// CPU seconds that the calling thread has used so far.
    pub cpu_s: fn() -> f64,
}

/// How far an evaluation has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress<'a> {
    /// The current step and, while a model is fitted, the phase of the fit.
    pub phase: &'a str,
    /// Steps completed. A step is a recipe's fit, or one method over all test rows, with one seed.
    pub done: u32,
    /// Steps in total.
    pub planned: u32,
}
