//! The stated error of the camera's model at the place of a track's target.

use super::measurement::MeasuredPosition;
use super::settings::TrackSettings;
use crate::geo::PlaneCovariance;

/// Distance travelled after which the covariance is that of the latest box to 1 - 1/e, m. Chosen from 2 to 1,000 m on the
/// simulated worlds from seed 901 on (docs/explanation/method.md, "Tracking").
const PLACE_LENGTH_M: f64 = 50.0;
/// A covariance whose trace differs by more than this factor is another error than before: a box that is cut by the
/// border, or unlike those of training. Chosen from 1.5 to 20 on the same worlds.
const LARGEST_RATIO: f64 = 4.0;

/// The covariance of the model's bias about a place: the mean over the boxes of the latest metres.
///
/// The covariance of each answer depends on its box, so it varies with the detector's noise as the position does. Were
/// the bias `L c` taken with the L of every box, a stationary target's positions z and their L would be correlated, and
/// the filter would take that for knowledge of c, as large as `dz / dL`. A moving target would follow the boxes that
/// state the smallest errors by chance, and its stated error would be theirs.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraError {
    /// Covariance of the bias, m2; `None` before the first box.
    bias: Option<PlaneCovariance>,
    /// The stated scale of the latest box ([`MeasuredPosition::stated_scale`]).
    pub(super) stated_scale: f64,
    /// Distance travelled since that box, m.
    travelled_m: f64,
}

impl CameraError {
    /// After an accepted box, or before the first.
    pub(super) fn new(settings: &TrackSettings, accepted: Option<&MeasuredPosition>) -> Self {
        Self {
            bias: accepted.map(|it| it.covariance.minus(white(settings, it))),
            stated_scale: accepted.map_or(1.0, |it| it.stated_scale),
            travelled_m: 0.0,
        }
    }

    /// Adds to the distance travelled since the latest box.
    pub(super) fn travel(&mut self, distance_m: f64) {
        self.travelled_m += distance_m;
    }

    /// The regressed position with the covariance of its bias at the target's place, and the white part of its own box.
    pub(super) fn at_place(&self, settings: &TrackSettings, measured: MeasuredPosition) -> MeasuredPosition {
        let white = white(settings, &measured);
        let own = measured.covariance.minus(white);
        let bias = match self.bias {
            Some(known) if is_similar(known, own) => {
                let share = 1.0 - (-self.travelled_m / PLACE_LENGTH_M).exp();
                known.plus(own.minus(known).scaled(share))
            }
            _ => own,
        };
        MeasuredPosition { covariance: bias.plus(white), white: Some(white), ..measured }
    }

    /// Correlation of the bias, in standard deviations, of the latest box with that of a box at the target's place: the smaller of
    /// the two errors is part of the larger one, and the rest of that is another error.
    pub(super) fn correlation(&self, settings: &TrackSettings, at_place: &MeasuredPosition) -> f64 {
        let trace_m2 = |it: PlaneCovariance| it.east_m2 + it.north_m2;
        let Some(known_m2) = self.bias.map(trace_m2) else { return 1.0 };
        let bias_m2 = trace_m2(at_place.covariance.minus(white(settings, at_place)));
        let (smaller_m2, larger_m2) = (known_m2.min(bias_m2), known_m2.max(bias_m2));
        if smaller_m2 > 0.0 { (smaller_m2 / larger_m2).sqrt() } else { 0.0 }
    }
}

fn white(settings: &TrackSettings, measured: &MeasuredPosition) -> PlaneCovariance {
    let share = settings.regression.correlation.white_share;
    measured.white.unwrap_or_else(|| measured.covariance.scaled(share))
}

fn is_similar(one: PlaneCovariance, other: PlaneCovariance) -> bool {
    let [one_m2, other_m2] = [one, other].map(|it| it.east_m2 + it.north_m2);
    one_m2 <= LARGEST_RATIO * other_m2 && other_m2 <= LARGEST_RATIO * one_m2
}
