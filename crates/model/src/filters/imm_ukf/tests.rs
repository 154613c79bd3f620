//! Agreement with a reference implementation, behaviour without fixes, and consistency.

use proptest::prelude::*;

use super::*;
use crate::simulation::{Options, Scene, World, simulate};

/// (fix, posterior mean, diagonal of the posterior covariance, probability of the turn) of one step.
type ReferenceStep = ([f64; 2], [f64; STATES], [f64; STATES], f64);

/// Computed with filterpy 2.0.0 (PyPI; numpy 2.4.6, scipy 1.17.1): `IMMEstimator` over two
/// `UnscentedKalmanFilter`s with `MerweScaledSigmaPoints(5, alpha=1, beta=0, kappa=1)`, constant
/// velocity and coordinated turn, steps of 1 s; transition matrix [[0.95, 0.05], [0.1, 0.9]]; first
/// probabilities 0.6 and 0.4; first mean (0, 0, 5, 0, 0) and variances (4, 4, 9, 9, 0.01);
/// acceleration densities 0.01 and 0.25, turn-rate density 1e-4; fix variance 4.
const FILTERPY: [ReferenceStep; 12] = [
    (
        [6.2, -0.7],
        [5.917462512, -0.535855658, 5.629726078, -0.373385366, -0.000394447],
        [3.060726949, 3.062032772, 4.294222716, 4.344122732, 0.010086228],
        0.388388472,
    ),
    (
        [9.6, 2.1],
        [10.095784746, 1.338348765, 4.806768658, 0.899460421, 0.004510208],
        [2.976974002, 2.988193637, 1.720862935, 1.858397612, 0.010109775],
        0.377320961,
    ),
    (
        [12.7, 0.3],
        [13.428005804, 0.92848798, 4.158895368, 0.319598615, -0.00131672],
        [2.671330621, 2.706498963, 0.850990581, 1.034182303, 0.009954737],
        0.360965927,
    ),
    (
        [20.8, -1.5],
        [19.490453006, -0.433030382, 4.806712583, -0.338865266, -0.012705502],
        [2.369878704, 2.450574394, 0.520277253, 0.74553713, 0.009883088],
        0.341846990,
    ),
    (
        [26.677, 2.078],
        [25.552891071, 0.828798978, 5.166376186, 0.204747262, 0.001721986],
        [2.12454809, 2.233627185, 0.367311815, 0.575616516, 0.009537837],
        0.292731858,
    ),
    (
        [28.703, 3.401],
        [29.73400102, 2.26967625, 4.876707154, 0.625670052, 0.013093256],
        [1.942820432, 2.121358321, 0.308579981, 0.569377506, 0.009365935],
        0.288584406,
    ),
    (
        [30.911, 9.617],
        [32.756811322, 6.792230549, 4.166280611, 2.337719871, 0.074717852],
        [1.957740479, 2.731770591, 0.515638582, 1.429376716, 0.008570998],
        0.658976908,
    ),
    (
        [34.323, 13.078],
        [35.375379877, 11.899115633, 3.16969574, 3.847287753, 0.126390877],
        [2.021978487, 2.673479054, 0.728064531, 1.195538412, 0.005828142],
        0.873378240,
    ),
    (
        [36.577, 16.065],
        [37.380853688, 16.121116571, 2.305641069, 4.222440237, 0.1351843],
        [2.100839107, 2.457238712, 0.885972232, 0.854757419, 0.004588935],
        0.844797734,
    ),
    (
        [32.441, 22.834],
        [35.419142459, 22.220204409, -0.143341688, 5.01395179, 0.188813167],
        [2.21873321, 2.2697795, 1.047496, 0.684979037, 0.003585472],
        0.922753716,
    ),
    (
        [30.817, 28.35],
        [32.454539981, 27.973504353, -2.136513162, 4.967980532, 0.219066227],
        [2.316589218, 2.117915031, 1.11053491, 0.591389514, 0.003026964],
        0.905955746,
    ),
    (
        [25.13, 29.928],
        [27.082741242, 31.343152926, -4.142356515, 3.591800851, 0.246155282],
        [2.360847004, 2.022468879, 1.021327479, 0.707054583, 0.002632123],
        0.921809448,
    ),
];

#[test]
fn every_step_agrees_with_filterpy() {
    // The chain whose transition matrix over one second is the one above.
    let total = -(0.85f64.ln());
    let options = ImmUkfOptions {
        cruise_m2_s3: 0.01,
        turn_m2_s3: 0.25,
        turn_rate_rad2_s3: 1e-4,
        initial_speed_sigma_m_s: 3.0,
        initial_turn_rate_sigma_rad_s: 0.1,
        sojourn_s: [3.0 / total, 1.5 / total],
        max_gap_s: 10.0,
    };
    let mode = Mode {
        mean: State::new(0.0, 0.0, 5.0, 0.0, 0.0),
        covariance: Covariance::from_diagonal(&State::new(4.0, 4.0, 9.0, 9.0, 0.01)),
    };
    let mut filter = ImmUkf::new(options);
    filter.modes = Some([mode; 2]);
    filter.log_probabilities = [0.6f64.ln(), 0.4f64.ln()];
    for (number, (fix, mean, variances, turn)) in FILTERPY.into_iter().enumerate() {
        let position = EastNorth { east_m: fix[0], north_m: fix[1] };
        let estimate = filter.step(1.0, Some((position, 4.0))).expect("initialised");
        let mixed = moment_match(&filter.modes.expect("initialised"), estimate.mode_probabilities);
        for state in 0..STATES {
            assert!((mixed.mean[state] - mean[state]).abs() < 1e-7, "step {number} {mixed:?}");
            let variance = mixed.covariance[(state, state)];
            assert!((variance - variances[state]).abs() < 1e-7, "step {number} {mixed:?}");
        }
        assert!((estimate.mode_probabilities[1] - turn).abs() < 1e-7, "step {number} {estimate:?}");
    }
}

fn fix_at(east_m: f64, north_m: f64) -> Option<(EastNorth, f64)> {
    Some((EastNorth { east_m, north_m }, 4.0))
}

#[test]
fn without_fixes_the_modes_return_to_their_chain_and_a_long_gap_restarts() {
    let options = ImmUkfOptions { max_gap_s: 60.0, ..ImmUkfOptions::from_acceleration(0.5) };
    let mut filter = ImmUkf::new(options);
    assert_eq!(filter.step(1.0, None), None);
    let turn = |filter: &mut ImmUkf, fix| filter.step(1.0, fix).expect("initialised").mode_probabilities[1];
    for second in 0..60 {
        // A clear turn: a circle of 20 m at 8 m/s.
        let angle = 0.4 * f64::from(second);
        turn(&mut filter, fix_at(20.0 * angle.cos(), 20.0 * angle.sin()));
    }
    let in_turn = turn(&mut filter, None);
    let mut before = in_turn;
    let mut variance_m2 = 0.0;
    for _ in 0..40 {
        let estimate = filter.step(1.0, None).expect("within the gap");
        assert!(estimate.variance_m2 > variance_m2, "{estimate:?}");
        assert_eq!(estimate.log_likelihood, 0.0);
        variance_m2 = estimate.variance_m2;
        // The probability falls towards its stationary value, a third, from above.
        assert!(estimate.mode_probabilities[1] <= before, "{estimate:?}");
        before = estimate.mode_probabilities[1];
    }
    assert!(in_turn > 0.8 && (before - 1.0 / 3.0).abs() < 0.01, "{in_turn} {before}");
    assert_eq!(filter.step(30.0, None), None);
    let restarted = filter.step(1.0, fix_at(500.0, 0.0)).expect("starts");
    assert!((restarted.position.east_m - 500.0).abs() < 1e-9);
}

#[test]
fn a_distant_fix_leaves_probabilities_normalised() {
    let mut filter = ImmUkf::new(ImmUkfOptions::from_acceleration(0.1));
    filter.step(1.0, fix_at(0.0, 0.0));
    filter.step(1.0, fix_at(0.0, 0.0));
    let estimate = filter.step(1.0, fix_at(1e6, -1e6)).expect("initialised");
    let sum: f64 = estimate.mode_probabilities.iter().sum();
    assert!((sum - 1.0).abs() < 1e-9 && estimate.log_likelihood.is_finite(), "{estimate:?}");
}

#[test]
fn the_mode_probabilities_of_a_fix_twenty_kilometres_away_sum_to_one() {
    let mut filter = ImmUkf::new(ImmUkfOptions::from_acceleration(1.0));
    filter.step(0.01, fix_at(9_914.1, -682.0)).expect("initialised");
    let estimate = filter.step(0.015_213_4, fix_at(-8_824.7, -7_078.8)).expect("initialised");
    let sum: f64 = estimate.mode_probabilities.iter().sum();
    assert!((sum - 1.0).abs() < 1e-9, "{estimate:?}");
}

proptest! {
    #[test]
    fn the_filter_stays_finite_on_any_input(
        steps in proptest::collection::vec((0.01..20.0f64, -1e4..1e4f64, -1e4..1e4f64, any::<bool>()), 1..60),
    ) {
        let mut filter = ImmUkf::new(ImmUkfOptions::from_acceleration(1.0));
        for (seconds, east_m, north_m, missed) in steps {
            let fix = if missed { None } else { fix_at(east_m, north_m) };
            if let Some(estimate) = filter.step(seconds, fix) {
                let sum: f64 = estimate.mode_probabilities.iter().sum();
                prop_assert!((sum - 1.0).abs() < 1e-9);
                prop_assert!(estimate.position.east_m.is_finite() && estimate.variance_m2 > 0.0);
            }
        }
    }
}

/// Mean square error per axis of fixes and of estimates later than 10 s into each traverse, m2, and the
/// mean ratio of squared error to stated variance.
fn errors_and_ratio(world: &World) -> (f64, f64, f64) {
    let plane = crate::geo::LocalPlane::new(world.rows[0].truth);
    let mut filter = ImmUkf::new(ImmUkfOptions::from_acceleration(0.3));
    let variance_m2 = world.gnss_sigma_m.powi(2);
    let (mut raw, mut filtered, mut ratio, mut count) = (0.0, 0.0, 0.0, 0.0);
    let (mut last, mut settled_s) = (world.rows[0].time, 0.0);
    for row in &world.rows {
        let seconds = row.time.duration_since(last).as_secs_f64();
        last = row.time;
        settled_s = if seconds > 5.0 { 0.0 } else { settled_s + seconds };
        let fix = plane.to_plane(row.fix.expect("no gaps").position);
        let truth = plane.to_plane(row.truth);
        let estimate = filter.step(seconds, Some((fix, variance_m2))).expect("initialised");
        if settled_s > 10.0 {
            raw += fix.error_per_axis_m2(truth);
            filtered += estimate.position.error_per_axis_m2(truth);
            ratio += estimate.position.error_per_axis_m2(truth) / estimate.variance_m2;
            count += 1.0;
        }
    }
    (raw / count, filtered / count, ratio / count)
}

#[test]
fn white_noise_is_filtered_and_the_variance_is_consistent() {
    let world = simulate(&Options { samples: 3_000, seed: 8, ..Options::new(Scene::Airport) });
    let (raw_m2, filtered_m2, ratio) = errors_and_ratio(&world);
    assert!(filtered_m2 < 0.4 * raw_m2, "{filtered_m2} of {raw_m2}");
    assert!((0.6..1.5).contains(&ratio), "{ratio}");
}
