//! The error of fixes in time: a Gauss-Markov part that stays for a while and a white part, and the
//! filter that turns residuals with such an error into independent ones.
//!
//! Neighbouring fixes err alike (METHOD 2.5), so a standing target's hundreds of rows say hardly
//! more than one. Least squares on whitened residuals counts them for what they are worth.
//! What never happens here: a look at boxes.

use super::rows::Row;

/// Time constants that are tried, s.
const TIME_CONSTANTS_S: [f64; 5] = [5.0, 15.0, 40.0, 100.0, 250.0];
/// White shares of the variance that are tried.
const WHITE_SHARES: [f64; 6] = [0.01, 0.03, 0.1, 0.25, 0.5, 0.75];
/// Squared whitened miss (both axes) from which a row counts less.
const CREDIBLE_NIS: f64 = 8.0;

/// The error of a fix about what the box says, per axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FixNoise {
    /// Variance of the whole, m2.
    pub(crate) variance_m2: f64,
    /// Share of it that is new with each fix.
    pub(crate) white_share: f64,
    /// Time in which the rest's correlation falls to 1/e, s.
    pub(crate) time_constant_s: f64,
}

impl FixNoise {
    pub(crate) const fn white(variance_m2: f64) -> Self {
        Self { variance_m2, white_share: 1.0, time_constant_s: 1.0 }
    }

    /// The same with at least that variance new with each fix, m2.
    pub(crate) fn with_white_m2(self, least_m2: f64) -> Self {
        let white_m2 = (self.variance_m2 * self.white_share).max(least_m2);
        let variance_m2 = self.variance_m2 * (1.0 - self.white_share) + white_m2;
        Self { variance_m2, white_share: white_m2 / variance_m2, ..self }
    }

    /// The likeliest one for residuals (m, rows by target and time); its variance is theirs.
    pub(crate) fn of_residuals(rows: &[Row], residuals: &[Vec<f64>; 2], doubts: &[f64]) -> Self {
        let mut best = (f64::INFINITY, Self::white(1.0));
        let coloured = TIME_CONSTANTS_S.iter().flat_map(|time_constant_s| {
            WHITE_SHARES.iter().map(|white_share| Self {
                variance_m2: 1.0,
                white_share: *white_share,
                time_constant_s: *time_constant_s,
            })
        });
        for candidate in std::iter::once(Self::white(1.0)).chain(coloured) {
            let whitener = Whitener::new(rows, &candidate, doubts);
            let sum: f64 = residuals
                .iter()
                .map(|axis| {
                    let mut axis = axis.clone();
                    whitener.apply(&mut axis);
                    axis.iter().map(|value| value * value).sum::<f64>()
                })
                .sum();
            let count = 2.0 * rows.len() as f64;
            let variance_m2 = (sum / count).max(1e-8);
            let score = count * variance_m2.ln() + 2.0 * whitener.log_spread;
            if score < best.0 {
                best = (score, Self { variance_m2, ..candidate });
            }
        }
        best.1
    }
}

/// The filter for rows in the order of target and time.
#[derive(Debug, Clone)]
pub(crate) struct Whitener {
    /// Per row: what is left of the state since the row before, the gain, and one over the
    /// standard deviation of the innovation.
    steps: Vec<[f64; 3]>,
    /// Sum of the logarithms of the innovations' variances.
    log_spread: f64,
}

impl Whitener {
    /// `doubts` are added to each row's white variance, as multiples of the whole variance.
    pub(crate) fn new(rows: &[Row], noise: &FixNoise, doubts: &[f64]) -> Self {
        let stays_m2 = noise.variance_m2 * (1.0 - noise.white_share);
        let white_m2 = noise.variance_m2 * noise.white_share;
        let mut steps = Vec::with_capacity(rows.len());
        let (mut variance_m2, mut log_spread) = (stays_m2, 0.0);
        for (at, row) in rows.iter().enumerate() {
            let same = at > 0 && rows[at - 1].target == row.target;
            let keep = match same {
                true => (-(row.time_s - rows[at - 1].time_s) / noise.time_constant_s).exp(),
                false => 0.0,
            };
            variance_m2 = keep * keep * variance_m2 + (1.0 - keep * keep) * stays_m2;
            let spread = variance_m2 + white_m2 + doubts[at] * noise.variance_m2;
            let gain = variance_m2 / spread;
            variance_m2 *= 1.0 - gain;
            log_spread += spread.ln();
            steps.push([keep, gain, 1.0 / spread.sqrt()]);
        }
        Self { steps, log_spread }
    }

    /// Whitens one column in place.
    pub(crate) fn apply(&self, column: &mut [f64]) {
        let mut state = 0.0;
        for (value, [keep, gain, factor]) in column.iter_mut().zip(&self.steps) {
            state *= keep;
            let innovation = *value - state;
            state += gain * innovation;
            *value = innovation * factor;
        }
    }

    /// What must be added to `doubts` so that rows that miss by far count less.
    pub(crate) fn doubt(&self, noise: &FixNoise, whitened: &[Vec<f64>; 2], doubts: &mut [f64]) {
        for (at, doubt) in doubts.iter_mut().enumerate() {
            let nis = whitened[0][at] * whitened[0][at] + whitened[1][at] * whitened[1][at];
            let spread = 1.0 / (self.steps[at][2] * self.steps[at][2]);
            let own = spread - *doubt * noise.variance_m2;
            let nis = nis * spread / own.max(1e-12);
            *doubt = own * (nis / CREDIBLE_NIS - 1.0).max(0.0) / noise.variance_m2;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::BoundingBox;
    use crate::geo::{EastNorth, Position};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Rows of targets that are seen for 2,000 s each.
    fn rows(count: usize) -> Vec<Row> {
        let row = |at: usize| Row {
            time_s: at as f64,
            target: (at / 2000) as u32,
            pass: (at / 2000) as u32,
            bounding_box: BoundingBox::new(0.0, 0.0, 1.0, 1.0).expect("a box"),
            position: Position::new(0.0, 0.0).expect("a place"),
            label: EastNorth::default(),
            own_variance_m2: None,
        };
        (0..count).map(row).collect()
    }

    fn normal(rng: &mut ChaCha8Rng) -> f64 {
        let sum: f64 = (0..12).map(|_| rng.random::<f64>()).sum();
        sum - 6.0
    }

    #[test]
    fn coloured_residuals_come_out_white_and_of_unit_variance() {
        let rows = rows(8000);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let truth = FixNoise { variance_m2: 4.0, white_share: 0.1, time_constant_s: 40.0 };
        let keep = (-1.0 / truth.time_constant_s).exp();
        let mut column = || {
            let mut state = 0.0;
            let mut values = Vec::new();
            for at in 0..rows.len() {
                let kept = if at % 2000 == 0 { 0.0 } else { keep };
                state = kept * state + (3.6 * (1.0 - kept * kept)).sqrt() * normal(&mut rng);
                values.push(state + 0.4f64.sqrt() * normal(&mut rng));
            }
            values
        };
        let residuals = [column(), column()];
        let doubts = vec![0.0; rows.len()];
        let found = FixNoise::of_residuals(&rows, &residuals, &doubts);
        assert!((15.0..=100.0).contains(&found.time_constant_s), "{found:?}");
        assert!((0.03..=0.25).contains(&found.white_share), "{found:?}");
        assert!((2.5..=6.0).contains(&found.variance_m2), "{found:?}");
        let mut whitened = residuals[0].clone();
        Whitener::new(&rows, &truth, &doubts).apply(&mut whitened);
        let count = whitened.len() as f64;
        let variance = whitened.iter().map(|value| value * value).sum::<f64>() / count;
        let product = whitened.windows(2).map(|pair| pair[0] * pair[1]).sum::<f64>() / count;
        // Five standard errors of 8,000 values.
        assert!((variance - 1.0).abs() < 0.08, "{variance}");
        assert!(product.abs() < 0.056, "{product}");
    }
}
