//! Candidates, their held-out misses, and the choice between them.
//!
//! Blocks of time are held out in turn; neighbouring rows err alike, so never random ones. A richer
//! candidate is kept only where it beats the simpler one beyond the scatter between passes.
//! What never happens here: a look at test rows or at a sample's truth.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::domain::Recipe;
use crate::model::artifact::Parts;
use crate::model::encoder::projective::Variant;
use crate::model::encoder::{hybrid, paper, projective};
use crate::model::network::training::LossWeights;
use crate::model::progress::FitError;
use crate::model::progress::{Phase, Run};
use crate::model::regressor::Regressor;
use crate::model::samples::rows::{Rows, median};
use crate::model::samples::whitening::FixNoise;
use crate::model::uncertainty::calibration as uncertainty;
use crate::model::uncertainty::coverage::Coverage;

/// Blocks of time that are held out in turn.
pub(crate) const BLOCKS: u32 = 4;

/// One way to fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Candidate {
    pub(crate) name: &'static str,
    pub(crate) way: Way,
    /// Whether a kinematic smoother prepares the labels.
    pub(crate) smoothed: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    Paper,
    Hybrid,
    Projective(Variant),
}

const HOMOGRAPHY: Candidate = candidate("projective/foot", Way::Projective(variant(false, false)), false);
const SIDES: Candidate = candidate("projective/sides", Way::Projective(variant(true, false)), false);
const RESIDUAL: Candidate = candidate("projective/residual", Way::Projective(variant(true, true)), false);
const SIDES_SMOOTHED: Candidate =
    candidate("projective/sides+smoothed", Way::Projective(variant(true, false)), true);
const HYBRID: Candidate = candidate("hybrid", Way::Hybrid, false);
const HYBRID_SMOOTHED: Candidate = candidate("hybrid+smoothed", Way::Hybrid, true);
const PAPER: Candidate = candidate("paper", Way::Paper, false);

const fn candidate(name: &'static str, way: Way, smoothed: bool) -> Candidate {
    Candidate { name, way, smoothed }
}

const fn variant(sides: bool, residual: bool) -> Variant {
    Variant { sides, residual }
}

/// What a recipe tries, simplest first.
pub(crate) const fn of_recipe(recipe: Recipe) -> &'static [Candidate] {
    match recipe {
        Recipe::Paper => &[PAPER],
        Recipe::Hybrid => &[HYBRID, HYBRID_SMOOTHED],
        Recipe::Projective => &[HOMOGRAPHY, SIDES, SIDES_SMOOTHED, RESIDUAL],
        Recipe::Auto => &[HOMOGRAPHY, SIDES, SIDES_SMOOTHED, RESIDUAL, HYBRID, HYBRID_SMOOTHED],
    }
}

/// What every fit of a run shares.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Common {
    pub(crate) e_gnss_m2: f64,
    pub(crate) noise: FixNoise,
    /// Passes over the samples, if the run says so.
    pub(crate) epochs: Option<u32>,
    pub(crate) seed: u64,
    /// Weights of the loss in place of the recipe's own.
    pub(crate) balance: Option<LossWeights>,
}

impl Candidate {
    /// Passes over the samples of one network.
    pub(crate) fn epochs(&self, common: &Common) -> u32 {
        let own = match self.way {
            Way::Paper => paper::EPOCHS,
            Way::Hybrid => hybrid::EPOCHS,
            Way::Projective(_) => projective::EPOCHS,
        };
        common.epochs.unwrap_or(own).max(1)
    }

    /// Passes over the samples of one fit.
    pub(crate) fn all_epochs(&self, common: &Common) -> u32 {
        let nets = match self.way {
            Way::Paper => 2,
            Way::Hybrid => 1,
            Way::Projective(variant) => u32::from(variant.residual),
        };
        nets.saturating_mul(self.epochs(common))
    }

    /// Fits on rows; the error is not calibrated yet.
    pub(crate) fn fit(
        &self,
        rows: &Rows,
        common: &Common,
        phase: &mut Phase<'_, '_>,
    ) -> Result<Parts, FitError> {
        let smoothed;
        let rows = if self.smoothed {
            smoothed = rows.smoothed(&common.noise);
            &smoothed
        } else {
            rows
        };
        let epochs = self.epochs(common);
        let mut parts = match self.way {
            Way::Paper => paper::fit(rows, common.e_gnss_m2, epochs, phase),
            Way::Hybrid => hybrid::fit(rows, common.e_gnss_m2, epochs, phase),
            Way::Projective(variant) => projective::fit(rows, variant, common.e_gnss_m2, epochs, phase),
        }?;
        let coverage = Coverage::new(rows.rows.iter().map(|row| row.bounding_box));
        if self.way == Way::Paper {
            parts.put_coverage(&coverage);
        } else {
            uncertainty::set_plain(&mut parts, &coverage);
        }
        Ok(parts)
    }

    /// Regressed position less fix (m) of every row, by fits that had not seen its block of time,
    /// and the error variance that they claimed, m2.
    pub(crate) fn held_out(
        &self,
        rows: &Rows,
        blocks: &[u32],
        common: &Common,
        run: &mut Run<'_>,
    ) -> Result<(Vec<[f64; 2]>, Vec<f64>), FitError> {
        let mut residuals = vec![[0.0; 2]; rows.rows.len()];
        let mut claims = vec![0.0; rows.rows.len()];
        for block in 0..BLOCKS {
            let train = rows.filtered(|at| blocks[at] != block);
            let mut rng = ChaCha8Rng::seed_from_u64(common.seed);
            rng.set_stream(u64::from(block) + 1);
            let name = format!("{}: held-out block {} of {BLOCKS}", self.name, block + 1);
            let parts = self.fit(
                &train,
                common,
                &mut Phase { run, name, rng, is_final: false, balance: common.balance },
            )?;
            let regressor = Regressor::build(parts).map_err(|error| FitError::Fault(error.into()))?;
            for (at, row) in rows.rows.iter().enumerate().filter(|(at, _)| blocks[*at] == block) {
                let fix = regressor.plane().to_plane(row.position);
                // From the box alone: a network that sees the fix would be praised for repeating it.
                let answer = regressor.regress(&row.bounding_box, None);
                let point = answer.regressed;
                residuals[at] = [point.east_m - fix.east_m, point.north_m - fix.north_m];
                claims[at] = answer.e_regression_m2;
            }
        }
        Ok((residuals, claims))
    }
}

/// The candidate to keep and the score of each, in m2: its mean squared miss per axis, where wild
/// misses count no more than a bound. That is the simplest one, unless a richer
/// one's misses are smaller by more than the standard error of that difference.
pub(crate) fn choose(rows: &Rows, residuals: &[Vec<[f64; 2]>]) -> (usize, Vec<f64>) {
    let Some(first) = residuals.first() else { return (0, Vec::new()) };
    let square = |[east, north]: &[f64; 2]| 0.5 * (east * east + north * north);
    // A fix that is far off says nothing of the candidates.
    let bound_m2 = 10.0 * median(first.iter().map(square).collect());
    let mut kept = 0;
    for at in 1..residuals.len() {
        let gains: Vec<f64> = residuals[kept]
            .iter()
            .zip(&residuals[at])
            .map(|(one, other)| square(one).min(bound_m2) - square(other).min(bound_m2))
            .collect();
        let count = gains.len() as f64;
        let gain = gains.iter().sum::<f64>() / count;
        let mut variance = 0.0;
        let mut from = 0;
        for pass in rows.rows.chunk_by(|one, other| one.pass == other.pass) {
            let sum: f64 = gains[from..from + pass.len()].iter().map(|own| own - gain).sum();
            variance += (sum / count).powi(2);
            from += pass.len();
        }
        if gain > variance.sqrt() {
            kept = at;
        }
    }
    let scores = residuals
        .iter()
        .map(|misses| misses.iter().map(|miss| square(miss).min(bound_m2)).sum::<f64>() / misses.len() as f64)
        .collect();
    (kept, scores)
}
