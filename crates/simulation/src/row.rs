//! One row of a simulated world.

use jiff::Timestamp;

use crate::domain::{BoundingBox, Fix, Observation, TargetClass, TargetId};
use crate::geo::Position;

/// The measurements of one target by camera and receiver at one second, with the truth.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedRow {
    /// The instant.
    pub time: Timestamp,
    /// The target, from 0, whatever its id.
    pub target: usize,
    /// The target's id, or that which the tracker gave it.
    pub target_id: TargetId,
    /// The target's class.
    pub class: TargetClass,
    /// The detection; `None` while the target is occluded.
    pub bounding_box: Option<BoundingBox>,
    /// The fix; `None` in a gap.
    pub fix: Option<Fix>,
    /// True position of the antenna.
    pub truth: Position,
}

impl SimulatedRow {
    /// The observation by camera and receiver; `None` if neither gives anything.
    #[must_use]
    pub fn observation(&self) -> Option<Observation> {
        Observation::new(self.time, Some(self.target_id.clone()), self.bounding_box, self.fix).ok()
    }
}
