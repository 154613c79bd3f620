//! Log-likelihood ratio of a receiver's fixes: carried by the target of a chain of tracklets, or by
//! somebody else.
//!
//! Carried: fix less position of the tracklet is white noise (receiver and detector) plus two
//! Gauss-Markov processes, the receiver's bias and the error of the map. Somebody else: the fixes follow a
//! target that starts anywhere in the scene and whose velocity is a Gauss-Markov process of one of three speeds, plus the
//! same receiver error. Both likelihoods are products of the innovations' densities of a Kalman filter, which
//! marginalises bias, map error and motion exactly. Axes are independent and alike, so both share one
//! covariance.
//!
//! No two receivers are equally good, and the error that a model states is that of those it was trained with. So the
//! covariances are known up to a factor with an inverse gamma prior of [`FREEDOM`] degrees of freedom. Without it n fixes
//! have the likelihood of a multivariate t distribution (O'Hagan and Forster 2004, 11.8).

use std::f64::consts::TAU;

use super::axis_filter::AxisFilter;
use super::tracklet::{Residual, SceneMotion, TimedFix};
use crate::domain::GaussMarkovNoise;

/// Correlation time of a target's velocity, s.
const VELOCITY_TIME_CONSTANT_S: f64 = 8.0;
/// A share of the fixes has gross errors; these are as likely under either hypothesis.
const OUTLIER_SHARE: f64 = 0.01;
/// Standard deviation of a gross error in that of the innovation.
const OUTLIER_SCALE: f64 = 10.0;
/// Degrees of freedom of the prior of a receiver's variance: its standard deviation is known within a third.
const FREEDOM: f64 = 4.0;
/// After so long a gap between fixes the motion of somebody else starts again, s.
const MAX_GAP_S: f64 = 60.0;

/// The assumptions of the likelihoods.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct EvidenceModel {
    /// Error of a receiver.
    pub(super) gnss: GaussMarkovNoise,
    /// Motion of somebody else.
    pub(super) motion: SceneMotion,
}

impl EvidenceModel {
    /// Variance of a receiver's bias per axis, m2: the larger of what the receiver states and what is assumed.
    pub(super) fn bias_m2(&self, fix: &TimedFix) -> f64 {
        self.gnss.coloured_variance_m2().max(fix.stated_variance_m2.unwrap_or(0.0))
    }
}

/// Sums over the innovations of fixes, each of two axes.
#[derive(Debug, Clone, Copy, Default)]
struct Innovations {
    fixes: f64,
    /// Sum of the logarithms of the variances of both axes.
    log_determinant: f64,
    /// Sum of the normalised squares, those of outliers bounded.
    squares: f64,
}

impl Innovations {
    fn add(&mut self, other: Self) {
        self.fixes += other.fixes;
        self.log_determinant += other.log_determinant;
        self.squares += other.squares;
    }

    /// Log density if the covariance is known.
    fn normal_log_density(&self) -> f64 {
        -0.5 * (self.log_determinant + self.squares) - self.fixes * TAU.ln()
    }

    /// Log density if it is known up to a factor, beside a term that is the same for all of as many fixes.
    fn log_density(&self) -> f64 {
        -0.5 * (self.log_determinant + (FREEDOM + 2.0 * self.fixes) * (self.squares / FREEDOM).ln_1p())
    }
}

/// Evidence of a measurement of the sum of the states that `observed` marks, in both axes; updates the states unless it is an
/// outlier.
fn innovations<const N: usize>(
    filter: &mut AxisFilter<N, 2>,
    measured: [f64; 2],
    observed: [bool; N],
    noise_m2: f64,
) -> Innovations {
    let own = filter.innovation(measured, observed, noise_m2);
    let squared = own.values.iter().map(|value| value * value).sum::<f64>() / own.variance;
    let nominal = (1.0 - OUTLIER_SHARE) * (-0.5 * squared).exp();
    let scale = OUTLIER_SCALE * OUTLIER_SCALE;
    let outlier = OUTLIER_SHARE / scale * (-0.5 * squared / scale).exp();
    if nominal > outlier {
        filter.correct(&own);
    }
    let squares = -2.0 * (nominal + outlier).max(1e-300).ln();
    Innovations { fixes: 1.0, log_determinant: 2.0 * own.variance.ln(), squares }
}

/// Somebody else's motion after the fixes so far: position, velocity, bias.
#[derive(Debug, Clone, Copy)]
struct FreeMotion {
    filter: AxisFilter<3, 2>,
    last_s: Option<f64>,
}

impl FreeMotion {
    const fn new() -> Self {
        Self { filter: AxisFilter::new(), last_s: None }
    }

    /// Evidence of a fix given those before.
    fn step(&mut self, fix: &TimedFix, speed_m_s: f64, model: &EvidenceModel) -> Innovations {
        let (bias_m2, white_m2) = (model.bias_m2(fix), model.gnss.white_variance_m2());
        let position = [fix.position.east_m, fix.position.north_m];
        let elapsed_s = self.last_s.map(|last_s| (fix.time_s - last_s).max(0.0));
        self.last_s = Some(fix.time_s);
        match elapsed_s.filter(|elapsed_s| *elapsed_s <= MAX_GAP_S) {
            None => self.start(position, bias_m2, white_m2, (speed_m_s, model.motion.spread_m)),
            Some(elapsed_s) => {
                self.predict(elapsed_s, bias_m2, speed_m_s, model);
                innovations(&mut self.filter, position, [true, false, true], white_m2)
            }
        }
    }

    /// Returns the evidence of a fix anywhere in the scene: its square is the mean of such squares.
    fn start(
        &mut self,
        position: [f64; 2],
        bias_m2: f64,
        white_m2: f64,
        (speed_m_s, spread_m): (f64, f64),
    ) -> Innovations {
        self.filter = AxisFilter {
            means: position.map(|axis| [axis, 0.0, 0.0]),
            covariance: [
                [bias_m2 + white_m2, 0.0, -bias_m2],
                [0.0, speed_m_s * speed_m_s, 0.0],
                [-bias_m2, 0.0, bias_m2],
            ],
        };
        let variance_m2 = spread_m * spread_m + bias_m2 + white_m2;
        Innovations { fixes: 1.0, log_determinant: 2.0 * variance_m2.ln(), squares: 2.0 }
    }

    fn predict(&mut self, elapsed_s: f64, bias_m2: f64, speed_m_s: f64, model: &EvidenceModel) {
        let speed_m2_s2 = speed_m_s.powi(2);
        let tau_s = VELOCITY_TIME_CONSTANT_S;
        let velocity = (-elapsed_s / tau_s).exp();
        let lever_s = tau_s * (1.0 - velocity);
        for mean in &mut self.filter.means {
            mean[0] += lever_s * mean[1];
        }
        let covariance = &mut self.filter.covariance;
        let velocity_row = covariance[1];
        for (own, other) in covariance[0].iter_mut().zip(velocity_row) {
            *own += lever_s * other;
        }
        for row in covariance.iter_mut() {
            row[0] += lever_s * row[1];
        }
        let bias = model.gnss.correlation.decay(elapsed_s);
        let added = [0.0, speed_m2_s2 * (1.0 - velocity * velocity), bias_m2 * (1.0 - bias * bias)];
        self.filter.decay([1.0, velocity, bias], added);
        // Integrated Ornstein-Uhlenbeck process (Gillespie 1996).
        let position_m2 = speed_m2_s2 * (2.0 * tau_s * (elapsed_s - lever_s) - lever_s * lever_s).max(0.0);
        let mixed = speed_m2_s2 * lever_s * (1.0 - velocity);
        let covariance = &mut self.filter.covariance;
        covariance[0][0] += position_m2;
        covariance[0][1] += mixed;
        covariance[1][0] += mixed;
    }
}

/// Somebody else, who is slow, usual or fast with equal probabilities: fixes that stand are no evidence for who is near.
#[derive(Debug, Clone, Copy)]
struct SomebodyElse([(FreeMotion, Innovations); 3]);

impl SomebodyElse {
    const fn new() -> Self {
        let none = Innovations { fixes: 0.0, log_determinant: 0.0, squares: 0.0 };
        Self([(FreeMotion::new(), none); 3])
    }

    fn step(&mut self, fix: &TimedFix, model: &EvidenceModel) {
        for ((motion, sum), speed_m_s) in self.0.iter_mut().zip(model.motion.speeds_m_s) {
            sum.add(motion.step(fix, speed_m_s, model));
        }
    }

    /// Logarithm of the mean of the densities of the three speeds.
    fn log_density(&self, of: impl Fn(&Innovations) -> f64) -> f64 {
        let each = self.0.map(|(_, sum)| of(&sum));
        let most = each.into_iter().fold(f64::NEG_INFINITY, f64::max);
        most + (each.iter().map(|own| (own - most).exp()).sum::<f64>() / each.len() as f64).ln()
    }
}

/// Log-likelihood of fixes (in order of time) of somebody who is not seen, at the speed of the scene.
pub(super) fn free_log_likelihood(fixes: &[TimedFix], model: &EvidenceModel) -> f64 {
    let (mut motion, mut sum) = (FreeMotion::new(), Innovations::default());
    fixes.iter().for_each(|fix| sum.add(motion.step(fix, model.motion.speed_m_s, model)));
    sum.normal_log_density()
}

/// Both hypotheses after the residuals so far.
#[derive(Debug, Clone, Copy)]
pub(super) struct LikelihoodRatio {
    /// Bias and map error.
    carried: AxisFilter<2, 2>,
    carried_sum: Innovations,
    other: SomebodyElse,
    last_s: Option<f64>,
}

impl LikelihoodRatio {
    pub(super) const fn new() -> Self {
        Self {
            carried: AxisFilter::new(),
            carried_sum: Innovations { fixes: 0.0, log_determinant: 0.0, squares: 0.0 },
            other: SomebodyElse::new(),
            last_s: None,
        }
    }

    /// Logarithm of the ratio.
    pub(super) fn log_ratio(&self) -> f64 {
        self.carried_sum.log_density() - self.other.log_density(Innovations::log_density)
    }

    /// The same if the covariances are known.
    #[cfg(test)]
    pub(super) fn normal_log_ratio(&self) -> f64 {
        self.carried_sum.normal_log_density() - self.other.log_density(Innovations::normal_log_density)
    }

    /// The ratio after more residuals, in order of time.
    pub(super) fn extended(mut self, residuals: &[Residual], model: &EvidenceModel) -> Self {
        for residual in residuals {
            self.step(residual, model);
        }
        self
    }

    pub(super) fn step(&mut self, residual: &Residual, model: &EvidenceModel) {
        let (fix, map_m2) = (&residual.fix, residual.map_variance_m2);
        let bias_m2 = model.bias_m2(fix);
        let elapsed_s = self.last_s.replace(fix.time_s).map(|last_s| fix.time_s - last_s);
        self.carried.advance(elapsed_s, [bias_m2, map_m2], model.gnss.correlation);
        let noise_m2 = model.gnss.white_variance_m2() + residual.box_variance_m2;
        self.carried_sum.add(innovations(&mut self.carried, residual.difference_m, [true; 2], noise_m2));
        self.other.step(fix, model);
    }
}
