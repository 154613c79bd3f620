//! The estimated clocks of receivers against the true ones.

use serde::Serialize;

use crate::fusion::association::ReceiverClocks;
use crate::fusion::clock_estimate::ClockEstimate;

/// How far estimates of receivers' clocks are off, over some recordings.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ClockFigures {
    /// Of single receivers at the end of a recording.
    pub single: EstimateFigures,
    /// Of what most of them have in common.
    pub common: EstimateFigures,
}

/// The errors of some estimates.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct EstimateFigures {
    /// Number of estimates.
    pub count: usize,
    /// Those that are called wrong.
    pub called_wrong: usize,
    /// Sum of the squares of their errors, s2.
    pub squares_s2: f64,
    /// The same in standard deviations.
    pub squares: f64,
}

impl ClockFigures {
    /// Of receivers that are all late by so much, s.
    #[must_use]
    pub fn of(clocks: &ReceiverClocks, late_s: f64) -> Self {
        let figures = |estimates: &mut dyn Iterator<Item = &ClockEstimate>| {
            estimates.fold(EstimateFigures::default(), |sum, own| sum.plus(EstimateFigures::of(own, late_s)))
        };
        Self { single: figures(&mut clocks.by_receiver.values()), common: figures(&mut clocks.common.iter()) }
    }

    /// These and others together.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self { single: self.single.plus(other.single), common: self.common.plus(other.common) }
    }
}

impl EstimateFigures {
    fn of(estimate: &ClockEstimate, late_s: f64) -> Self {
        let error_s = estimate.offset_s - late_s;
        Self {
            count: 1,
            called_wrong: usize::from(estimate.is_wrong()),
            squares_s2: error_s.powi(2),
            squares: (error_s / estimate.sigma_s).powi(2),
        }
    }

    fn plus(self, other: Self) -> Self {
        Self {
            count: self.count + other.count,
            called_wrong: self.called_wrong + other.called_wrong,
            squares_s2: self.squares_s2 + other.squares_s2,
            squares: self.squares + other.squares,
        }
    }

    /// Root mean square error, s, and the same in standard deviations.
    #[must_use]
    pub fn root_mean_squares(&self) -> [f64; 2] {
        [self.squares_s2, self.squares].map(|sum| (sum / self.count.max(1) as f64).sqrt())
    }
}
