//! What became of the items of a stream.

use crate::domain::{Detection, Sample};

/// What became of an item.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ItemOutcome {
    /// It is part of a sample.
    Paired,
    /// No partner came.
    Unpaired,
    /// It came after its instant had been decided.
    TooLate,
    /// An item of the same source, target and instant was there before.
    Duplicate,
}

/// An item that no later decision looks at, by the tag that it was pushed with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Released<T> {
    /// Which.
    pub tag: T,
    /// What became of it.
    pub outcome: ItemOutcome,
}

/// What one push has decided. A sample never comes after the release of its items.
#[derive(Debug, Clone, PartialEq)]
pub struct PairedItems<T> {
    /// New samples, per target in order of time.
    pub samples: Vec<Sample>,
    /// Boxes released without a partner, per target in order of time.
    pub unpaired_detections: Vec<Detection>,
    /// Items released.
    pub released: Vec<Released<T>>,
}

impl<T> Default for PairedItems<T> {
    fn default() -> Self {
        Self { samples: Vec::new(), unpaired_detections: Vec::new(), released: Vec::new() }
    }
}

impl<T> PairedItems<T> {
    /// Whether nothing was decided.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.samples.is_empty() && self.released.is_empty()
    }

    /// Adds what was decided after this.
    pub fn append(&mut self, later: Self) {
        self.samples.extend(later.samples);
        self.unpaired_detections.extend(later.unpaired_detections);
        self.released.extend(later.released);
    }
}
