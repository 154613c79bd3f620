//! Two things measured in turn, round by round.

use crate::tables;

/// Rounds of each side; the median of their ratios counts.
const ROUNDS: usize = 7;

/// The outcome of a comparison.
pub(crate) struct Ratio {
    /// Median measure of ours and of the peer.
    pub(crate) ours: f64,
    pub(crate) peer: f64,
    /// Median, smallest and largest of ours / peer, round by round.
    pub(crate) median: f64,
    pub(crate) min_ratio: f64,
    pub(crate) max_ratio: f64,
}

/// Measures ours and the peer in turn, after one round of each that does not count.
pub(crate) fn in_turn(mut ours: impl FnMut() -> f64, mut peer: impl FnMut() -> f64) -> Ratio {
    ours();
    peer();
    let (mut of_ours, mut of_peer, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let (a, b) = (ours(), peer());
        of_ours.push(a);
        of_peer.push(b);
        ratios.push(a / b);
    }
    ratios.sort_by(f64::total_cmp);
    Ratio {
        ours: median(&mut of_ours),
        peer: median(&mut of_peer),
        median: ratios[ROUNDS / 2],
        min_ratio: ratios[0],
        max_ratio: ratios[ROUNDS - 1],
    }
}

/// The middle one.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Head of a table of ratios.
pub(crate) fn head(title: &str, unit: &str) {
    let (ours, peer) = (format!("ours ({unit})"), format!("peer ({unit})"));
    tables::head(title, &["case", &ours, &peer, "ratio", "min", "max"]);
}

/// A row of it.
pub(crate) fn row(case: &str, ratio: &Ratio) {
    let Ratio { ours, peer, median, min_ratio, max_ratio } = ratio;
    tables::row(case, &[(*ours, 4), (*peer, 4), (*median, 2), (*min_ratio, 2), (*max_ratio, 2)]);
}
