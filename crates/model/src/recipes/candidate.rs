//! The ways to fit a recipe, which are compared on held-out rows.

use std::fmt;

use super::{ErrorSource, FitContext, error_source};
use crate::encoder::FittedEncoder;
use crate::progress::{FitError, Phase};
use crate::samples::rows::TrainingRows;
use crate::uncertainty::coverage::Coverage;
use crate::uncertainty::error_model::set_uncalibrated;

/// One way to fit a model.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Candidate {
    /// Name in the model's report.
    pub(crate) name: &'static str,
    pub(crate) estimator: &'static dyn Estimator,
    /// True if the labels are smoothed by a kinematic smoother.
    pub(crate) is_smoothed: bool,
}

/// The fit of a recipe's encoder.
pub(crate) trait Estimator: fmt::Debug + Sync {
    /// Default number of epochs of the training of one network.
    fn epochs(&self) -> u32;

    /// Networks that one fit trains.
    fn networks(&self, is_final: bool) -> u32;

    /// Epochs of a network that take as long as the map of a fit, which has none, at some thousand rows: progress counts
    /// it as these.
    fn map_epochs(&self) -> u32 {
        0
    }

    /// Fits the encoder to rows; its error is not calibrated.
    ///
    /// # Errors
    /// [`FitError::Cancelled`], and [`FitError::Unusable`] where the rows determine no map.
    fn fit(
        &self,
        rows: &TrainingRows,
        context: &FitContext<'_>,
        epochs: u32,
        phase: &mut Phase<'_, '_>,
    ) -> Result<FittedEncoder, FitError>;
}

impl Candidate {
    /// Epochs of the training of one network.
    pub(crate) fn epochs(&self, context: &FitContext<'_>) -> u32 {
        context.epochs.unwrap_or_else(|| self.estimator.epochs()).max(1)
    }

    /// Epochs of one fit, over all of its networks, and what its map counts as.
    pub(crate) fn total_epochs(&self, context: &FitContext<'_>, is_final: bool) -> u32 {
        let epochs = self.estimator.networks(is_final).saturating_mul(self.epochs(context));
        epochs.saturating_add(self.estimator.map_epochs())
    }

    /// Fits the encoder to rows; its error is not calibrated.
    ///
    /// # Errors
    /// As [`Estimator::fit`].
    pub(crate) fn fit(
        &self,
        rows: &TrainingRows,
        context: &FitContext<'_>,
        phase: &mut Phase<'_, '_>,
    ) -> Result<FittedEncoder, FitError> {
        phase.advance(0)?;
        let smoothed = self.is_smoothed.then(|| rows.smoothed(&context.noise));
        let rows = smoothed.as_ref().unwrap_or(rows);
        let mut fitted = self.estimator.fit(rows, context, self.epochs(context), phase)?;
        phase.advance(self.estimator.map_epochs())?;
        let coverage = Coverage::new(rows.rows.iter().map(|row| row.bounding_box));
        match error_source(fitted.parts.recipe) {
            ErrorSource::Formula => coverage.put(&mut fitted.parts.tensors),
            _ => set_uncalibrated(&mut fitted.parts, &coverage),
        }
        Ok(fitted)
    }
}
