//! Who owns what: posterior probabilities of joint assignments of chains to receivers.
//!
//! A joint assignment gives every receiver one of its chains, the empty one included, so that no piece has
//! two owners; its weight is the product of theirs. It starts from a maximum-weight matching of receivers
//! and pieces (Kuhn-Munkres). Blocked Gibbs sampling then draws one receiver, or two that compete,
//! given all others; probabilities are the mean of the conditional ones (Rao-Blackwell).

use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;
use rand::{Rng, RngExt};

use super::cancellation::Cancellation;
use super::chains::Chain;
use crate::domain::Result;

/// Sweeps over all receivers, and those before probabilities are counted.
const SWEEPS: usize = 300;
const BURN_IN: usize = 50;
/// Chains of each of two competing receivers that are drawn together.
const JOINT_CHAINS: usize = 24;
/// Units of a log weight in integer costs.
const UNITS: f64 = 1_000.0;

struct Sampler<'a> {
    chains: &'a [Vec<Chain>],
    /// Chosen chain by receiver.
    chosen: Vec<usize>,
    /// Owner by piece.
    owner: Vec<Option<usize>>,
}

/// Posterior probabilities by receiver, then piece, of receivers with these chains; the first chain is
/// empty.
///
/// # Errors
/// `Cancelled`.
pub(super) fn posterior(
    chains: &[Vec<Chain>],
    pieces: usize,
    random: &mut impl Rng,
    cancellation: Cancellation<'_>,
) -> Result<Vec<Vec<f64>>> {
    let mut sampler = Sampler { chains, chosen: vec![0; chains.len()], owner: vec![None; pieces] };
    sampler.start();
    let rivals = rivals(chains, pieces);
    let mut probability = vec![vec![0.0; pieces]; chains.len()];
    for sweep in 0..SWEEPS {
        cancellation.check()?;
        for (one, other) in &rivals {
            sampler.draw_two(*one, *other, random);
        }
        for receiver in 0..chains.len() {
            let weights = sampler.draw(receiver, random);
            if sweep >= BURN_IN {
                for (chain, weight) in chains[receiver].iter().zip(weights) {
                    for piece in &chain.pieces {
                        probability[receiver][*piece] += weight / (SWEEPS - BURN_IN) as f64;
                    }
                }
            }
        }
    }
    Ok(probability)
}

impl Sampler<'_> {
    /// The chains that Kuhn-Munkres matching of receivers with single pieces leads to. Each receiver has a
    /// column of its own for owning none.
    fn start(&mut self) {
        let (receivers, pieces) = (self.chains.len(), self.owner.len());
        if receivers == 0 || pieces == 0 {
            return;
        }
        let forbidden = -1_000_000_000_i64;
        let mut weights = Matrix::new(receivers, pieces + receivers, forbidden);
        for (receiver, chains) in self.chains.iter().enumerate() {
            let empty = chains[0].log_weight;
            weights[(receiver, pieces + receiver)] = 0;
            for chain in &chains[1..] {
                for piece in &chain.pieces {
                    let gain = ((chain.log_weight - empty) * UNITS).clamp(-1e8, 1e8) as i64;
                    let weight = &mut weights[(receiver, *piece)];
                    *weight = (*weight).max(gain);
                }
            }
        }
        let (_, columns) = kuhn_munkres(&weights);
        for (receiver, column) in columns.into_iter().enumerate() {
            let has = |chain: &Chain| chain.pieces.contains(&column);
            let best = (1..self.chains[receiver].len()).find(|at| {
                let chain = &self.chains[receiver][*at];
                has(chain) && chain.pieces.iter().all(|piece| self.owner[*piece].is_none())
            });
            self.set(receiver, best.unwrap_or(0));
        }
    }

    fn set(&mut self, receiver: usize, chain: usize) {
        for piece in &self.chains[receiver][self.chosen[receiver]].pieces {
            if self.owner[*piece] == Some(receiver) {
                self.owner[*piece] = None;
            }
        }
        for piece in &self.chains[receiver][chain].pieces {
            self.owner[*piece] = Some(receiver);
        }
        self.chosen[receiver] = chain;
    }

    /// True if no piece of a chain has another owner than those.
    fn is_free(&self, chain: &Chain, own: [usize; 2]) -> bool {
        chain.pieces.iter().all(|piece| self.owner[*piece].is_none_or(|owner| own.contains(&owner)))
    }

    /// Draws one receiver's chain given the others; returns the conditional probabilities of its chains.
    fn draw(&mut self, receiver: usize, random: &mut impl Rng) -> Vec<f64> {
        let chains = &self.chains[receiver];
        let mut weights: Vec<f64> = chains
            .iter()
            .map(
                |chain| if self.is_free(chain, [receiver; 2]) { chain.log_weight } else { f64::NEG_INFINITY },
            )
            .collect();
        normalise(&mut weights);
        let drawn = pick(&weights, random);
        self.set(receiver, drawn);
        weights
    }

    /// Draws the chains of two receivers together, so that they can exchange pieces.
    fn draw_two(&mut self, one: usize, other: usize, random: &mut impl Rng) {
        let free = |receiver: usize| -> Vec<usize> {
            let chains = &self.chains[receiver];
            (0..chains.len())
                .filter(|at| self.is_free(&chains[*at], [one, other]))
                .take(JOINT_CHAINS)
                .collect()
        };
        let (first, second) = (free(one), free(other));
        // The present pair must be among the choices.
        if !first.contains(&self.chosen[one]) || !second.contains(&self.chosen[other]) {
            return;
        }
        let mut pairs = Vec::with_capacity(first.len() * second.len());
        let mut weights = Vec::with_capacity(first.len() * second.len());
        for a in &first {
            for b in &second {
                let (mine, others) = (&self.chains[one][*a], &self.chains[other][*b]);
                if mine.pieces.iter().all(|piece| !others.pieces.contains(piece)) {
                    pairs.push((*a, *b));
                    weights.push(mine.log_weight + others.log_weight);
                }
            }
        }
        normalise(&mut weights);
        let (a, b) = pairs[pick(&weights, random)];
        self.set(one, 0);
        self.set(other, b);
        self.set(one, a);
    }
}

/// Pairs of receivers that have pieces in common.
fn rivals(chains: &[Vec<Chain>], pieces: usize) -> Vec<(usize, usize)> {
    let wants: Vec<Vec<bool>> = chains
        .iter()
        .map(|own| {
            let mut wants = vec![false; pieces];
            own.iter().flat_map(|chain| &chain.pieces).for_each(|piece| wants[*piece] = true);
            wants
        })
        .collect();
    let share = |one: usize, other: usize| wants[one].iter().zip(&wants[other]).any(|(a, b)| *a && *b);
    (0..chains.len())
        .flat_map(|one| (one + 1..chains.len()).map(move |other| (one, other)))
        .filter(|(one, other)| share(*one, *other))
        .collect()
}

/// Log weights to probabilities.
fn normalise(weights: &mut [f64]) {
    let most = weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut sum = 0.0;
    for weight in weights.iter_mut() {
        *weight = (*weight - most).exp();
        sum += *weight;
    }
    weights.iter_mut().for_each(|weight| *weight /= sum);
}

fn pick(probabilities: &[f64], random: &mut impl Rng) -> usize {
    let mut rest = random.random::<f64>();
    for (at, probability) in probabilities.iter().enumerate() {
        rest -= probability;
        if rest < 0.0 {
            return at;
        }
    }
    probabilities.len() - 1
}
