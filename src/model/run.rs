//! A fit under way: its observer, progress, and one training after another.
//!
//! What never happens here: a clock; the time that is left is for the caller to tell.

use std::ops::ControlFlow;
use std::sync::Arc;

use rand_chacha::ChaCha8Rng;

use super::fit::{FitError, FitEvent, Observer};
use super::net::NetShape;
use super::train::{LossSums, LossWeights, Schedule, TrainingSet, train};
use crate::domain::{EpochReport, RunProgress};

/// One fit with its observer and progress.
pub(super) struct Run<'a> {
    pub(super) observer: &'a mut Observer<'a>,
    pub(super) progress: RunProgress,
}

impl Run<'_> {
    pub(super) fn note(&mut self, line: &str) -> Result<(), FitError> {
        self.tell(|observer, _| observer(FitEvent::Note(line)))
    }

    pub(super) fn tell(
        &mut self,
        event: impl FnOnce(&mut Observer<'_>, &RunProgress) -> ControlFlow<()>,
    ) -> Result<(), FitError> {
        match event(self.observer, &self.progress) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(FitError::Cancelled),
        }
    }
}

/// One part of a run: a held-out block, or the final fit.
pub(super) struct Phase<'r, 'a> {
    pub(super) run: &'r mut Run<'a>,
    pub(super) name: String,
    pub(super) rng: ChaCha8Rng,
    /// Whether its epochs are those of the run's curve.
    pub(super) is_final: bool,
    /// Weights of the loss in place of the recipe's own.
    pub(super) balance: Option<LossWeights>,
}

impl Phase<'_, '_> {
    /// Trains a network from fresh parameters; `part` tells networks of one phase apart. Returns
    /// the parameters and the sums of the last epoch.
    pub(super) fn train(
        &mut self,
        part: &str,
        shape: &NetShape,
        set: Arc<TrainingSet>,
        weights: LossWeights,
        schedule: Schedule,
    ) -> Result<(Vec<f32>, LossSums), FitError> {
        let Self { run, name, rng, is_final, balance } = self;
        let weights = balance.unwrap_or(weights);
        run.progress.phase = format!("{name} {}", part.trim_end_matches('.')).trim().to_owned();
        // The curve shows the network that answers when there is a fix.
        let curve = *is_final && part != "denied.";
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
            if curve { (run.observer)(FitEvent::Epoch(&report)) } else { ControlFlow::Continue(()) }
        })?;
        Ok((parameters, last))
    }
}
