//! Matching of boxes with receivers over many draws, as tables and as JSON.

use std::fmt::Write as _;

use serde::Serialize;

use super::pair_figures::PairFigures;
use super::recording::SiteRecording;
use crate::domain::Recipe;
use crate::model::FitError;

/// The model that is known in a draw is trained on the carriers, fixes and boxes of the draw of this larger seed.
pub const KNOWN_MODEL_SEEDS: u64 = 1_000_000;
/// Shift of the fixes, as a share of the recording, that leaves no identity true.
const SHIFT: f64 = 0.4;

/// The findings of matching without a model in some draws.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct JointFigures {
    /// Recordings of one camera.
    pub cases: usize,
    /// Those that were accepted.
    pub accepted: usize,
    /// Accepted ones with at most 1.2 times the mean error of a model that is trained with the identities.
    pub within_1_2: usize,
    /// Accepted ones with more than twice that.
    pub beyond_twice: usize,
    /// Recordings that were accepted with the fixes shifted in time, so that no identity is true.
    pub shifted_accepted: usize,
    /// Sum of the mean errors of the models that are trained on the samples of the accepted matches, m.
    pub error_sum_m: f64,
    /// The same of the models with identities in these cases, m.
    pub known_error_sum_m: f64,
    /// Pairs of the accepted ones.
    pub pairs: PairFigures,
}

/// The figures of one camera, or of all.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct MatchingCase {
    /// The camera's id, or `all`.
    pub name: String,
    /// With a model that was trained with the identities of another draw.
    pub known: PairFigures,
    /// With nothing known; all zero if that was not asked for.
    pub unknown: JointFigures,
}

/// The figures of all cameras.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct MatchingReport {
    /// Seeds of the draws.
    pub seeds: Vec<u64>,
    /// Each camera, then all.
    pub cases: Vec<MatchingCase>,
}

impl MatchingReport {
    /// An empty report of a recording's cameras.
    #[must_use]
    pub fn new(recording: &SiteRecording) -> Self {
        let named = |name: String| MatchingCase { name, ..MatchingCase::default() };
        let cameras = recording.cameras.iter().map(|camera| named(camera.id.to_string()));
        Self { seeds: Vec::new(), cases: cameras.chain([named("all".to_owned())]).collect() }
    }

    /// Adds one draw; the search without a model only if it is wanted, for it takes a hundred times as long.
    ///
    /// # Errors
    /// A camera's carriers cannot train its model.
    pub fn add_draw(
        &mut self,
        recording: &SiteRecording,
        seed: u64,
        with_search: bool,
    ) -> Result<(), FitError> {
        let (drawn, other) = (recording.redrawn(seed), recording.redrawn(seed + KNOWN_MODEL_SEEDS));
        self.seeds.push(seed);
        for camera in 0..recording.cameras.len() {
            let model = other.known_model(camera, Recipe::GaussianProcess)?;
            let known = drawn.matched_by(camera, &model, seed).map_err(FitError::Unusable)?;
            let unknown = if with_search { searched(&drawn, camera, seed)? } else { JointFigures::default() };
            for at in [camera, recording.cameras.len()] {
                let own = &mut self.cases[at];
                own.known = own.known.plus(&known);
                own.unknown = own.unknown.plus(&unknown);
            }
        }
        Ok(())
    }

    /// As Markdown tables.
    #[must_use]
    pub fn table(&self) -> String {
        let mut table = String::from(
            "| model known | pairs from 0.9 on: right | wrong ones: companions | stated | share of all pairs found | share of their boxes | groups that have the carrier | stated: right (pairs) |\n\
             |---|---|---|---|---|---|---|---|\n",
        );
        for case in &self.cases {
            let MatchingCase { name, known, .. } = case;
            let sure = known.sure();
            let bins: Vec<String> = known.bins[2..]
                .iter()
                .map(|bin| {
                    let (stated, right) = (bin.stated / bin.pairs.max(1) as f64, share(bin.right, bin.pairs));
                    format!("{stated:.2}: {right:.2} ({})", bin.pairs)
                })
                .collect();
            // Writing to a string cannot fail.
            let _ = writeln!(
                table,
                "| {name} | {:.3} of {} | {} of {} | {:.3} | {:.3} | {:.3} | {:.3} of {} | {} |",
                share(sure.right, sure.pairs),
                sure.pairs,
                known.companions,
                sure.pairs - sure.right,
                sure.stated / sure.pairs.max(1) as f64,
                share(known.found, known.true_pairs),
                share(known.found_boxes, known.true_boxes),
                share(known.groups.right, known.groups.pairs),
                known.groups.pairs,
                bins.join(", "),
            );
        }
        if self.cases.iter().any(|case| case.unknown.cases > 0) {
            self.write_search(&mut table);
        }
        table
    }

    fn write_search(&self, table: &mut String) {
        table.push_str(
            "\n| nothing known | accepted | within 1.2 times | beyond twice | error m | with identities m | sure pairs right | wrong ones: companions | shifted, accepted |\n\
             |---|---|---|---|---|---|---|---|---|\n",
        );
        for MatchingCase { name, unknown, .. } in &self.cases {
            let sure = unknown.pairs.sure();
            let mean = |sum: f64| sum / unknown.accepted.max(1) as f64;
            let _ = writeln!(
                table,
                "| {name} | {} of {} | {} | {} | {:.2} | {:.2} | {} of {} | {} of {} | {} |",
                unknown.accepted,
                unknown.cases,
                unknown.within_1_2,
                unknown.beyond_twice,
                mean(unknown.error_sum_m),
                mean(unknown.known_error_sum_m),
                sure.right,
                sure.pairs,
                unknown.pairs.companions,
                sure.pairs - sure.right,
                unknown.shifted_accepted,
            );
        }
    }

    /// As JSON.
    ///
    /// # Errors
    /// That of the serializer.
    pub fn to_json(&self) -> serde_json::Result<String> {
        serde_json::to_string_pretty(self)
    }
}

impl JointFigures {
    fn plus(&self, other: &Self) -> Self {
        Self {
            cases: self.cases + other.cases,
            accepted: self.accepted + other.accepted,
            within_1_2: self.within_1_2 + other.within_1_2,
            beyond_twice: self.beyond_twice + other.beyond_twice,
            shifted_accepted: self.shifted_accepted + other.shifted_accepted,
            error_sum_m: self.error_sum_m + other.error_sum_m,
            known_error_sum_m: self.known_error_sum_m + other.known_error_sum_m,
            pairs: self.pairs.plus(&other.pairs),
        }
    }
}

/// The search in one camera of one draw, with the fixes as they are and with shifted ones.
fn searched(drawn: &SiteRecording, camera: usize, seed: u64) -> Result<JointFigures, FitError> {
    let shifted = drawn.with_shifted_fixes(SHIFT).matched_jointly(camera, seed);
    let refused =
        JointFigures { cases: 1, shifted_accepted: usize::from(shifted.is_ok()), ..JointFigures::default() };
    let Ok(found) = drawn.matched_jointly(camera, seed) else { return Ok(refused) };
    let known_m = drawn.mean_error_m(camera, &drawn.known_model(camera, Recipe::GaussianProcess)?);
    Ok(JointFigures {
        accepted: 1,
        within_1_2: usize::from(found.mean_error_m <= 1.2 * known_m),
        beyond_twice: usize::from(found.mean_error_m > 2.0 * known_m),
        error_sum_m: found.mean_error_m,
        known_error_sum_m: known_m,
        pairs: found.figures,
        ..refused
    })
}

fn share(part: usize, all: usize) -> f64 {
    part as f64 / all.max(1) as f64
}
