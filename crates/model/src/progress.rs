//! The progress of a fit: what its observer receives, why it may end, and the training of its networks.
//!
//! The remaining time is left to the observer, which has a clock.

use std::ops::ControlFlow;
use std::sync::Arc;

use rand_chacha::ChaCha8Rng;

use crate::domain::{EpochReport, Error, HeldOutSampleError, RunProgress};
use crate::network::{LossSums, LossWeights, NetShape, Schedule, TrainError, TrainingSet, train};

/// An event that the observer of a fit receives.
#[derive(Debug)]
pub enum FitEvent<'a> {
    /// The progress of the run; `remaining_s` is left to the observer, which has a clock.
    Progress(&'a RunProgress),
    /// One epoch of the final fit.
    Epoch(&'a EpochReport),
    /// Distance of each sample that the fit uses from its held-out prediction by the chosen candidate.
    HeldOut(&'a [HeldOutSampleError]),
    /// A line for the run's log.
    Note(&'a str),
}

/// Why a fit gave no model.
#[derive(Debug, thiserror::Error)]
pub enum FitError {
    /// The observer requested it.
    #[error("cancelled")]
    Cancelled,
    /// The samples cannot support a fit; a refusal that names `samples` and the remedy.
    #[error("{0}")]
    Unusable(Error),
    /// A fault of this program.
    #[error("the fit failed: {0}")]
    Fault(Box<dyn std::error::Error + Send + Sync>),
}

impl FitError {
    /// A fault, from its cause.
    pub(crate) fn fault(cause: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self::Fault(cause.into())
    }
}

impl From<TrainError> for FitError {
    fn from(error: TrainError) -> Self {
        match error {
            TrainError::Cancelled => Self::Cancelled,
            TrainError::Candle(cause) => Self::fault(cause),
        }
    }
}

/// The observer of a fit; returning `Break` ends it.
pub(crate) type Observer<'a> = dyn FnMut(FitEvent<'_>) -> ControlFlow<()> + 'a;

/// A fit under way: its observer and its progress over all phases.
pub(crate) struct FitRun<'a> {
    pub(crate) observer: &'a mut Observer<'a>,
    pub(crate) progress: RunProgress,
}

impl FitRun<'_> {
    /// Sends a line for the log.
    ///
    /// # Errors
    /// [`FitError::Cancelled`] if the observer breaks.
    pub(crate) fn note(&mut self, line: &str) -> Result<(), FitError> {
        self.notify(FitEvent::Note(line))
    }

    /// Sends an event to the observer.
    ///
    /// # Errors
    /// [`FitError::Cancelled`] if the observer breaks.
    pub(crate) fn notify(&mut self, event: FitEvent<'_>) -> Result<(), FitError> {
        match (self.observer)(event) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(FitError::Cancelled),
        }
    }
}

/// One phase of a run: a held-out block, or the final fit.
pub(crate) struct Phase<'r, 'a> {
    pub(crate) run: &'r mut FitRun<'a>,
    pub(crate) name: String,
    pub(crate) rng: ChaCha8Rng,
    /// True if the epochs of this phase are those of the run's curve.
    pub(crate) is_final: bool,
    /// Loss weights that replace the recipe's own.
    pub(crate) loss_weights: Option<LossWeights>,
}

impl Phase<'_, '_> {
    /// Reports work of the phase that took as long as some epochs; none at its beginning.
    pub(crate) fn advance(&mut self, epochs: u32) -> Result<(), FitError> {
        let Self { run, name, .. } = self;
        run.progress.phase.clone_from(name);
        run.progress.epoch += epochs;
        match (run.observer)(FitEvent::Progress(&run.progress)) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(FitError::Cancelled),
        }
    }

    /// Trains a network from initial parameters; `part` names the network if the phase has several.
    /// Returns the parameters and the sums of the last epoch.
    pub(crate) fn train(
        &mut self,
        part: &str,
        shape: &NetShape,
        set: Arc<TrainingSet>,
        weights: LossWeights,
        schedule: Schedule,
    ) -> Result<(Vec<f32>, LossSums), FitError> {
        let Self { run, name, rng, is_final, loss_weights } = self;
        let weights = loss_weights.unwrap_or(weights);
        run.progress.phase = format!("{name} {}", part.trim_end_matches('.')).trim().to_owned();
        // The curve is that of the network that is used when there is a fix.
        let in_curve = *is_final && part != "denied.";
        let mut last = LossSums::default();
        let parameters = shape.initial_parameters(rng);
        let parameters = train(shape, parameters, set, weights, schedule, rng, &mut |epoch, sums| {
            last = *sums;
            let report = EpochReport {
                epoch,
                loss: sums.loss / sums.samples,
                reconstruction_error: sums.reconstruction / sums.samples,
                regression_error: sums.regression / sums.samples,
                error_scale: sums.ratio / sums.samples,
            };
            run.progress.epoch += 1;
            run.progress.reconstruction_error = report.reconstruction_error;
            run.progress.regression_error = report.regression_error;
            run.progress.error_scale = report.error_scale;
            (run.observer)(FitEvent::Progress(&run.progress))?;
            if in_curve { (run.observer)(FitEvent::Epoch(&report)) } else { ControlFlow::Continue(()) }
        })?;
        Ok((parameters, last))
    }
}
