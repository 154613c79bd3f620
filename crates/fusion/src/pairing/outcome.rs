//! The outcomes of the items of a stream.

use crate::domain::{Detection, Sample};

/// The outcome of an item.
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
    /// The tag that the item was pushed with.
    pub tag: T,
    /// The item's outcome.
    pub outcome: ItemOutcome,
}

/// The decisions of one push. A sample never comes after the release of its items.
#[derive(Debug, Clone, PartialEq)]
pub struct PairedItems<T> {
    /// New samples, per target in order of time.
    pub samples: Vec<Sample>,
    /// Boxes released without a partner, per target in order of time.
    pub unpaired_detections: Vec<Detection>,
    /// The items that were released.
    pub released: Vec<Released<T>>,
}

impl<T> Default for PairedItems<T> {
    fn default() -> Self {
        Self { samples: Vec::new(), unpaired_detections: Vec::new(), released: Vec::new() }
    }
}

impl<T> PairedItems<T> {
    /// True if nothing was decided.
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
