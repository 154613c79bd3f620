//! Smoothed paths of finished tracks: a fixed-interval smoother (Rauch, Tung and Striebel 1965) over the moment-matched
//! states of an IMM filter.
//!
//! A filter's estimate uses what was measured before; the smoothed one uses the whole track. The state is position and
//! velocity; between two instants the velocity is driven by white acceleration noise of the density that the motion modes
//! have on average, each weighted by its probability at the later instant.
//!
//! What a filter states beyond that (biases of camera and receivers, errors of the map, sources that disagree) lasts along a
//! track. It does not average out, so it is added to the smoothed covariance as it was to the filtered one.

use jiff::{SignedDuration, Timestamp};
use nalgebra::{Matrix2, Matrix4, Vector4};

use crate::domain::{Acceleration, Motion, Velocity};
use crate::geo::{EastNorth, PlaneCovariance};

/// Least time between two states of a path: more often, they say the same.
const STEP: SignedDuration = SignedDuration::from_millis(200);

/// Least time over which an acceleration is stated: over a shorter one hardly more than its prior is known.
const SECOND: SignedDuration = SignedDuration::from_secs(1);

/// Largest change from a prediction to the filter's next estimate, in standard deviations: a larger one is of a target that
/// begins to move or stops, for which no mode has noise.
const LARGEST_CHANGE: f64 = 1.5;
/// Share of the square of a larger change that is added to the variance of the prediction.
const CHANGE_SHARE: f64 = 0.5;

/// Second moments of a filter's error.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FilterMoments {
    /// Covariance of position (east, north) and velocity (east, north), m and m/s, by what does not last along a track.
    pub covariance: Matrix4<f64>,
    /// Spectral density of the white acceleration noise, m2/s3: the mean of the motion modes.
    pub acceleration_m2_s3: f64,
}

/// The state of a target as a filter estimated it, in a plane that the whole path has in common.
#[derive(Debug, Clone, PartialEq)]
pub struct FilteredState {
    /// The instant of the estimate.
    pub time: Timestamp,
    /// Estimated position.
    pub position: EastNorth,
    /// Estimated velocity.
    pub velocity: Velocity,
    /// Stated covariance of the position's error, m2.
    pub covariance: PlaneCovariance,
    /// Stated covariance of the velocity's error, m2/s2.
    pub velocity_covariance: PlaneCovariance,
    /// Probability that the target is stationary, 0 to 1.
    pub stationary_probability: f64,
    /// The rest that the filter knows.
    pub moments: FilterMoments,
}

/// The state of a target as the whole track shows it, or as a filter estimated it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathState {
    /// The instant of the estimate.
    pub time: Timestamp,
    /// Estimated position.
    pub position: EastNorth,
    /// Estimated velocity.
    pub velocity: Velocity,
    /// Covariance of the position's error, m2.
    pub covariance: PlaneCovariance,
    /// Covariance of the velocity's error, m2/s2.
    pub velocity_covariance: PlaneCovariance,
    /// Probability that the target is stationary, 0 to 1.
    pub stationary_probability: f64,
    /// Mean acceleration over the second before, or over the step before where that is longer; `None` at the first.
    pub acceleration: Option<Acceleration>,
}

impl PathState {
    /// Speed and course with their intervals.
    #[must_use]
    pub fn motion(&self) -> Motion {
        Motion::of(self.velocity, self.velocity_covariance, self.stationary_probability)
    }
}

/// The states of one track in order of time, of bounded size: where it is full, every second one is left out.
#[derive(Debug, Clone)]
pub struct TrackPath {
    states: Vec<FilteredState>,
    step: SignedDuration,
    most: usize,
}

impl TrackPath {
    /// An empty path of at most `most_bytes`, and at least four states.
    #[must_use]
    pub fn new(most_bytes: usize) -> Self {
        let most = (most_bytes / size_of::<FilteredState>()).max(4);
        Self { states: Vec::new(), step: STEP, most }
    }

    /// The first state.
    #[must_use]
    pub fn first(&self) -> Option<&FilteredState> {
        self.states.first()
    }

    /// The latest state.
    #[must_use]
    pub fn latest(&self) -> Option<&FilteredState> {
        self.states.last()
    }

    /// Adds a state that is not older than the latest one, which it replaces if that is close to the one before.
    pub fn push(&mut self, state: FilteredState) {
        let is_repeated = self.latest().is_some_and(|latest| latest.time == state.time);
        let is_close = match self.states.as_slice() {
            [.., before, latest] => latest.time.duration_since(before.time) < self.step,
            _ => false,
        };
        if is_repeated || is_close {
            self.states.pop();
        }
        if self.states.len() >= self.most {
            let mut at = 0;
            self.states.retain(|_| {
                at += 1;
                at % 2 == 1
            });
            self.step *= 2;
        }
        self.states.push(state);
    }

    /// Forgets the states that nothing from an instant on depends on: those more than a second before, over which its
    /// acceleration is stated.
    pub fn forget_before(&mut self, time: Timestamp) {
        let is_a_second_before = |state: &FilteredState| time.duration_since(state.time) >= SECOND;
        let needed = self.states.iter().rposition(is_a_second_before).unwrap_or(0);
        self.states.drain(..needed);
        self.step = STEP;
    }

    /// The smoothed path.
    #[must_use]
    pub fn smoothed(&self) -> Vec<PathState> {
        let Some(last) = self.states.last() else { return Vec::new() };
        let mut estimates = vec![Estimate::of(last)];
        for pair in self.states.windows(2).rev() {
            let ([state, next], Some(later)) = (pair, estimates.last()) else { break };
            estimates.push(Estimate::of(state).given(later, state, next));
        }
        estimates.reverse();
        (0..estimates.len()).map(|at| self.stated(&estimates, at)).collect()
    }

    /// The smoothed state, with what the filter stated beyond its own covariance.
    fn stated(&self, estimates: &[Estimate], at: usize) -> PathState {
        let (state, estimate) = (&self.states[at], &estimates[at]);
        let next = self.states.get(at + 1).unwrap_or(state);
        let [east_m, north_m, east_m_s, north_m_s] = estimate.mean.into();
        let lasting = |stated: PlaneCovariance, first| stated.minus(block(&state.moments.covariance, first));
        PathState {
            time: state.time,
            position: EastNorth { east_m, north_m },
            velocity: Velocity { east_m_s, north_m_s },
            covariance: block(&estimate.covariance, 0).plus(lasting(state.covariance, 0)),
            velocity_covariance: block(&estimate.covariance, 2).plus(lasting(state.velocity_covariance, 2)),
            stationary_probability: state.stationary_probability.min(next.stationary_probability),
            acceleration: self.acceleration(estimates, at),
        }
    }

    /// The difference of two smoothed velocities over the time between them. The covariance of two smoothed states is the
    /// product of the gains between them and the covariance of the later one. What lasts along a track cancels out.
    fn acceleration(&self, estimates: &[Estimate], at: usize) -> Option<Acceleration> {
        let time = self.states[at].time;
        let is_a_second_before = |state: &FilteredState| time.duration_since(state.time) >= SECOND;
        let before = at.checked_sub(1)?;
        let from = self.states[..at].iter().rposition(is_a_second_before).unwrap_or(0).min(before);
        let seconds = time.duration_since(self.states[from].time).as_secs_f64();
        let (first, last) = (&estimates[from], &estimates[at]);
        let gains = estimates[from..at].iter().fold(Matrix4::<f64>::identity(), |gains, it| gains * it.gain);
        let shared = gains * last.covariance;
        let difference = last.covariance + first.covariance - shared - shared.transpose();
        let [_, _, east_m_s, north_m_s] = (last.mean - first.mean).into();
        Some(Acceleration {
            east_m_s2: east_m_s / seconds,
            north_m_s2: north_m_s / seconds,
            covariance: block(&difference, 2).scaled(seconds.powi(-2)),
        })
    }
}

/// Mean and covariance of position and velocity.
#[derive(Debug, Clone, Copy)]
struct Estimate {
    mean: Vector4<f64>,
    covariance: Matrix4<f64>,
    /// Of the smoother, towards the next instant; 0 at the last.
    gain: Matrix4<f64>,
}

impl Estimate {
    fn of(state: &FilteredState) -> Self {
        let FilteredState { position, velocity, moments, .. } = state;
        let mean = Vector4::new(position.east_m, position.north_m, velocity.east_m_s, velocity.north_m_s);
        Self { mean, covariance: moments.covariance, gain: Matrix4::zeros() }
    }

    /// The estimate given the smoothed one of the next instant; unchanged where nothing can be predicted.
    fn given(self, smoothed: &Self, state: &FilteredState, next: &FilteredState) -> Self {
        let seconds = next.time.duration_since(state.time).as_secs_f64();
        let transition = transition(seconds);
        let noise = process_noise(seconds, next.moments.acceleration_m2_s3);
        let predicted = transition * self.covariance * transition.transpose() + noise;
        let predicted = predicted + excess(&next.moments.covariance, &predicted);
        let predicted = predicted + jump(&(Self::of(next).mean - transition * self.mean), &predicted);
        let Some(inverse) = predicted.cholesky().map(|factor| factor.inverse()) else { return self };
        let gain = self.covariance * transition.transpose() * inverse;
        let covariance = self.covariance + gain * (smoothed.covariance - predicted) * gain.transpose();
        Self {
            mean: self.mean + gain * (smoothed.mean - transition * self.mean),
            covariance: 0.5 * (covariance + covariance.transpose()),
            gain,
        }
    }
}

/// The covariance of position (`first` 0) or velocity (2).
fn block(covariance: &Matrix4<f64>, first: usize) -> PlaneCovariance {
    let second = first + 1;
    PlaneCovariance {
        east_m2: covariance[(first, first)],
        north_m2: covariance[(second, second)],
        east_north_m2: covariance[(first, second)],
    }
}

/// Variance of the later filter that the prediction lacks: a target that begins to move is less certain than the motion
/// modes of before allow. The smoothed covariance of an instant is then never above the filter's.
fn excess(filtered: &Matrix4<f64>, predicted: &Matrix4<f64>) -> Matrix4<f64> {
    let decomposed = (filtered - predicted).symmetric_eigen();
    let axes = decomposed.eigenvectors;
    axes * Matrix4::from_diagonal(&decomposed.eigenvalues.map(|variance| variance.max(0.0)))
        * axes.transpose()
}

/// Variance that a prediction lacks where the filter's next estimate is farther from it than its own covariance allows.
fn jump(change: &Vector4<f64>, predicted: &Matrix4<f64>) -> Matrix4<f64> {
    let Some(factor) = predicted.cholesky() else { return Matrix4::zeros() };
    let is_large = change.dot(&factor.solve(change)) > LARGEST_CHANGE.powi(2);
    if is_large { CHANGE_SHARE * change * change.transpose() } else { Matrix4::zeros() }
}

fn transition(seconds: f64) -> Matrix4<f64> {
    let mut transition = Matrix4::identity();
    transition[(0, 2)] = seconds;
    transition[(1, 3)] = seconds;
    transition
}

/// Of white acceleration noise over some time (Bar-Shalom, Li and Kirubarajan 2001, 6.2.2).
fn process_noise(seconds: f64, density_m2_s3: f64) -> Matrix4<f64> {
    let by_axis = Matrix2::new(seconds.powi(3) / 3.0, seconds.powi(2) / 2.0, seconds.powi(2) / 2.0, seconds);
    by_axis.kronecker(&Matrix2::identity()) * density_m2_s3
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::statistics::CHI_SQUARE_95;

    fn state(ms: i64) -> FilteredState {
        FilteredState {
            time: Timestamp::from_millisecond(ms).expect("in range"),
            position: EastNorth { east_m: 1e-3 * ms as f64, north_m: 0.0 },
            velocity: Velocity { east_m_s: 1.0, north_m_s: 0.0 },
            covariance: PlaneCovariance::isotropic(2.0),
            velocity_covariance: PlaneCovariance::isotropic(0.5),
            stationary_probability: 0.1,
            moments: FilterMoments {
                covariance: Matrix4::from_diagonal(&Vector4::new(1.0, 1.0, 0.25, 0.25)),
                acceleration_m2_s3: 0.05,
            },
        }
    }

    #[test]
    fn a_path_is_bounded_and_reaches_from_first_to_last() {
        let most = 100;
        let mut path = TrackPath::new(most * size_of::<FilteredState>());
        for second in 0..10_000 {
            path.push(state(1_000 * second));
            assert!(path.states.len() <= most);
        }
        let smoothed = path.smoothed();
        assert!(smoothed.len() >= most / 2, "{}", smoothed.len());
        let seconds = |at: usize| smoothed[at].time.as_second();
        assert_eq!((seconds(0), seconds(smoothed.len() - 1)), (0, 9_999));
    }

    #[test]
    fn states_that_come_often_are_thinned() {
        let mut path = TrackPath::new(1 << 20);
        (0..1_000).for_each(|frame| path.push(state(10 * frame)));
        assert!((50..=53).contains(&path.states.len()), "{}", path.states.len());
    }

    /// The truth and a Kalman filter's path of a target whose velocity is driven by white noise, measured once a second.
    fn simulated(seed: u64) -> (Vec<Vector4<f64>>, TrackPath) {
        const VARIANCE_M2: f64 = 4.0;
        const DENSITY_M2_S3: f64 = 0.5;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let noise = process_noise(1.0, DENSITY_M2_S3);
        let driven = noise.cholesky().expect("positive").l();
        let mut drawn = |sigma: f64| sigma * random.sample::<f64, _>(StandardNormal);
        let mut truth = Vector4::new(0.0, 0.0, drawn(3.0), drawn(3.0));
        let (mut mean, mut covariance) = (Vector4::zeros(), Matrix4::from_diagonal(&Vector4::repeat(9.0)));
        let (mut truths, mut path) = (Vec::new(), TrackPath::new(1 << 20));
        for second in 0..60 {
            if second > 0 {
                truth = transition(1.0) * truth + driven * Vector4::from_fn(|_, _| drawn(1.0));
                mean = transition(1.0) * mean;
                covariance = transition(1.0) * covariance * transition(1.0).transpose() + noise;
            }
            let measured =
                Vector2::new(truth[0] + drawn(VARIANCE_M2.sqrt()), truth[1] + drawn(VARIANCE_M2.sqrt()));
            let seen = covariance.fixed_view::<2, 2>(0, 0) + Matrix2::identity() * VARIANCE_M2;
            let gain = covariance.fixed_columns::<2>(0) * seen.try_inverse().expect("positive");
            mean += gain * (measured - mean.fixed_rows::<2>(0));
            covariance -= gain * covariance.fixed_rows::<2>(0).into_owned();
            truths.push(truth);
            path.push(FilteredState {
                position: EastNorth { east_m: mean[0], north_m: mean[1] },
                velocity: Velocity { east_m_s: mean[2], north_m_s: mean[3] },
                covariance: block(&covariance, 0),
                velocity_covariance: block(&covariance, 2),
                moments: FilterMoments { covariance, acceleration_m2_s3: DENSITY_M2_S3 },
                ..state(1_000 * second)
            });
        }
        (truths, path)
    }

    #[test]
    fn smoothed_states_are_nearer_to_the_truth_and_state_their_errors() {
        let mut squared = [[0.0; 2]; 2];
        let (mut inside, mut count) = ([0_usize; 3], 0_usize);
        for seed in 0..40 {
            let (truths, path) = simulated(seed);
            let smoothed = path.smoothed();
            for at in 5..55 {
                let (truth, before, estimate) = (truths[at], truths[at - 1], smoothed[at]);
                let filtered = &path.states[at];
                let off = |position: EastNorth| [position.east_m - truth[0], position.north_m - truth[1]];
                let off_m_s = |it: Velocity| [it.east_m_s - truth[2], it.north_m_s - truth[3]];
                let acceleration = estimate.acceleration.expect("not the first");
                let true_m_s2 = truth - before;
                let errors = [
                    (off(estimate.position), estimate.covariance),
                    (off_m_s(estimate.velocity), estimate.velocity_covariance),
                    (
                        [acceleration.east_m_s2 - true_m_s2[2], acceleration.north_m_s2 - true_m_s2[3]],
                        acceleration.covariance,
                    ),
                ];
                for (inside, ([east_m, north_m], covariance)) in inside.iter_mut().zip(errors) {
                    let distance = covariance.mahalanobis_squared(EastNorth { east_m, north_m });
                    *inside += usize::from(distance <= CHI_SQUARE_95);
                }
                let pairs = [
                    [off(filtered.position), off(estimate.position)],
                    [off_m_s(filtered.velocity), off_m_s(estimate.velocity)],
                ];
                for (sums, pair) in squared.iter_mut().zip(pairs) {
                    sums.iter_mut()
                        .zip(pair)
                        .for_each(|(sum, [east, north])| *sum += east.powi(2) + north.powi(2));
                }
                count += 1;
            }
        }
        for inside in inside {
            let share = inside as f64 / count as f64;
            assert!((0.91..0.97).contains(&share), "{share} inside the ellipse of 95 %");
        }
        for [filtered, smoothed] in squared {
            assert!(smoothed < 0.6 * filtered, "{smoothed} beside {filtered}");
        }
    }

    #[test]
    fn the_rest_of_a_path_is_smoothed_as_the_whole_is() {
        let (_, path) = simulated(1);
        let whole = path.smoothed();
        let mut rest = path.clone();
        rest.forget_before(whole[30].time);
        assert_eq!(rest.states.len(), 31, "one of a second before is kept");
        assert_eq!(rest.smoothed()[1..], whole[30..]);
    }

    #[test]
    fn errors_that_last_along_a_track_are_not_smoothed_away() {
        let (_, mut path) = simulated(1);
        path.states
            .iter_mut()
            .for_each(|state| state.covariance = state.covariance.plus(PlaneCovariance::isotropic(9.0)));
        assert!(path.smoothed().iter().all(|state| state.covariance.east_m2 >= 9.0));
    }
}
