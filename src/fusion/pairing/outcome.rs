//! What became of the items of a stream.

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
