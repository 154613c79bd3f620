//! The cases: what is compared on which rows.

use super::splits::Split;
use crate::domain::SigmaM;
use crate::{Method, Truth};

/// The methods of the main table, and three more of the long tables.
pub(super) const METHODS: &str = "gnss,imm_ukf,homography.denied,dnn.denied,paper.two_step,auto.one_step,\
                                  auto.two_step,track,paper.one_step,auto.denied,track.denied";

/// Keys of the cases that marks or pictures name.
pub(super) mod key {
    pub(in crate::paper_experiments) const LARGE: &str = "large";
    pub(in crate::paper_experiments) const LARGE_30_PX: &str = "large+30";
    pub(in crate::paper_experiments) const LARGE_NEW_LINE: &str = "large-new-line";
    pub(in crate::paper_experiments) const MANY_RECEIVERS: &str = "many-receivers";
    /// A case and the same with gross errors.
    pub(in crate::paper_experiments) const GROSS: [[&str; 2]; 2] =
        [["airport-undisturbed", "airport-gross"], ["square", "square-gross"]];
    pub(in crate::paper_experiments) const REAL: &str = "real-";
    pub(in crate::paper_experiments) const PLAZA: &str = "plaza-";
}

/// One row of the main table.
pub(super) struct Case {
    pub(super) key: String,
    pub(super) title: String,
    pub(super) description: String,
    /// Commands that reproduce it, where `simulate` and `evaluate` can.
    pub(super) command: Option<String>,
}

/// A training set per world and the cases that its models are judged on.
pub(super) struct Experiment {
    pub(super) group: &'static str,
    /// A test set of the split per case.
    pub(super) cases: Vec<Case>,
    /// One per world, made when it is needed.
    pub(super) splits: Vec<Box<dyn Fn() -> anyhow::Result<Split>>>,
    /// Number of training seeds on every world.
    pub(super) seeds: u64,
    pub(super) truth: Truth,
    pub(super) gnss_sigma: SigmaM,
    pub(super) methods: Vec<Method>,
    pub(super) show_curves: bool,
    /// True if its cases are rows of the main table.
    pub(super) in_main_table: bool,
}
