//! Seeded simulations with bounds: consistency, growth of the error, gates, order of arrival.

use jiff::SignedDuration;
use proptest::prelude::*;

use super::*;
use crate::domain::{GaussMarkovNoise, GnssError, NoiseCorrelation, Recipe};
use crate::geo::{EastNorth, PlaneCovariance};
use crate::model::{FitOptions, TimedResidual, estimate_gnss_noise, fit};
use crate::simulation::{
    Options, SimulatedPositions, Walk, at_s, simulate as simulate_world, standard_normal, stream,
};

/// Both positions of an instant, with the covariances that the simulation has.
fn measurement(walk: &Walk, positions: &SimulatedPositions) -> Measurement {
    let measured =
        |position, noise: GaussMarkovNoise| MeasuredPosition::isotropic(position, noise.variance_m2);
    Measurement {
        time: positions.time,
        fix: Some(measured(positions.fix, walk.gnss)),
        regressed: Some(measured(positions.regressed, walk.regression)),
    }
}

/// True positions with their measurements.
fn simulate(walk: &Walk, seed: u64, seconds: u32) -> Vec<(EastNorth, Measurement)> {
    let positions = walk.simulate(seed, seconds);
    positions.iter().map(|it| (it.truth, measurement(walk, it))).collect()
}

/// Means over the steps of some runs; counts of rejections and steps.
#[derive(Default, Debug)]
struct RunSummary {
    error_m: f64,
    gnss_error_m: f64,
    two_step_error_m: f64,
    nees: f64,
    nis: [f64; 2],
    inside: f64,
    rejected: usize,
    steps: f64,
}

fn run(settings: TrackSettings, walk: &Walk, seeds: std::ops::Range<u64>, seconds: u32) -> RunSummary {
    let mut summary = RunSummary::default();
    for seed in seeds {
        let measurements = simulate(walk, seed, seconds);
        let mut track = Track::start(settings, &measurements[0].1).expect("has both");
        for (truth, measurement) in &measurements[1..] {
            let state = track.update(measurement);
            let fix = measurement.fix.expect("always there");
            let regressed = measurement.regressed.expect("always there");
            let weight = fix.covariance.east_m2 / (fix.covariance.east_m2 + regressed.covariance.east_m2);
            let two_step = EastNorth {
                east_m: weight * regressed.position.east_m + (1.0 - weight) * fix.position.east_m,
                north_m: weight * regressed.position.north_m + (1.0 - weight) * fix.position.north_m,
            };
            summary.steps += 1.0;
            summary.error_m += state.position.distance_m(*truth);
            summary.gnss_error_m += fix.position.distance_m(*truth);
            summary.two_step_error_m += two_step.distance_m(*truth);
            summary.nees += state.covariance.mahalanobis_squared(state.position.minus(*truth));
            summary.inside += f64::from(u8::from(state.position.distance_m(*truth) <= state.r95_m));
            summary.rejected += state.rejected.len();
            for innovation in &state.innovations {
                summary.nis[innovation.source as usize] += innovation.nis;
            }
        }
    }
    let steps = summary.steps;
    summary.error_m /= steps;
    summary.gnss_error_m /= steps;
    summary.two_step_error_m /= steps;
    summary.nees /= steps;
    summary.inside /= steps;
    summary.nis = summary.nis.map(|sum| sum / steps);
    summary
}

/// A fix alone, with the square of its sigma.
fn fix_at(seconds: f64, east_m: f64, variance_m2: f64) -> Measurement {
    let fix = MeasuredPosition::isotropic(EastNorth { east_m, north_m: 0.0 }, variance_m2);
    Measurement { time: at_s(seconds), fix: Some(fix), regressed: None }
}

fn moved(measured: Option<MeasuredPosition>, east_m: f64) -> Option<MeasuredPosition> {
    measured.map(|it| MeasuredPosition {
        position: EastNorth { east_m: it.position.east_m + east_m, ..it.position },
        ..it
    })
}

#[test]
fn a_pedestrian_is_tracked_consistently_and_better_than_by_two_step_fusion() {
    let summary = run(TrackSettings::default(), &Walk::pedestrian(), 0..20, 600);
    println!("{summary:?}");
    assert!(summary.error_m < 0.95 * summary.two_step_error_m, "{summary:?}");
    assert!(summary.error_m < 0.45 * summary.gnss_error_m, "{summary:?}");
    // Chi-square with 2 degrees of freedom has mean 2. The simulated heading changes abruptly where the
    // filter models accelerations, so the bounds are wider than sampling alone would require.
    assert!((1.5..2.5).contains(&summary.nees), "{summary:?}");
    assert!(summary.nis.iter().all(|nis| (1.4..2.5).contains(nis)), "{summary:?}");
    assert!((0.92..0.98).contains(&summary.inside), "{summary:?}");
    assert!((summary.rejected as f64) < 0.01 * summary.steps, "{summary:?}");
}

#[test]
fn the_positions_of_a_stationary_target_are_averaged() {
    let pedestrian = Walk::pedestrian();
    let regression = GaussMarkovNoise::new(1.5, pedestrian.regression.correlation);
    let standing = Walk { speed_m_s: 0.0, regression, ..pedestrian };
    let summary = run(TrackSettings::default(), &standing, 100..160, 450);
    println!("{summary:?}");
    assert!(summary.gnss_error_m > 2.5 && summary.gnss_error_m < 3.0, "{summary:?}");
    assert!(summary.error_m < 1.3, "{summary:?}");
    assert!(summary.error_m < 0.9 * summary.two_step_error_m, "{summary:?}");
    assert!((0.90..0.99).contains(&summary.inside), "{summary:?}");
}

/// A box alone, north of the track's origin by a constant error.
fn box_at(seconds: f64, east_m: f64, variance_m2: f64) -> Measurement {
    let position = EastNorth { east_m, north_m: 3.0 };
    let white = PlaneCovariance::isotropic(0.1 * variance_m2);
    let regressed =
        MeasuredPosition { white: Some(white), ..MeasuredPosition::isotropic(position, variance_m2) };
    Measurement { time: at_s(seconds), fix: None, regressed: Some(regressed) }
}

#[test]
fn boxes_of_another_error_say_nothing_of_the_error_in_between() {
    // At the image's border the stated error is five times that inside, and the error itself is the same.
    let variance_m2 = |second: u32| if second % 10 < 3 { 100.0 } else { 4.0 };
    let boxes = |second: u32| box_at(second.into(), 9.0 * f64::from(second), variance_m2(second));
    let mut track = Track::start(TrackSettings::default(), &boxes(0)).expect("a box");
    for second in 1..60 {
        let state = track.update(&boxes(second));
        assert!(state.r95_m > 4.0, "{second}: {state:?}");
    }
}

#[test]
fn boxes_that_state_small_errors_by_chance_do_not_lead_the_track() {
    // Every third box states a third of the variance that the others state, and is as far from the truth.
    let boxes = |second: u32| {
        let (is_sure, east_m) = (second.is_multiple_of(3), 1.4 * f64::from(second));
        let (north_m, variance_m2) = if is_sure { (3.0, 1.0) } else { (-3.0, 3.0) };
        let measured = MeasuredPosition {
            white: Some(PlaneCovariance::isotropic(0.1)),
            ..MeasuredPosition::isotropic(EastNorth { east_m, north_m }, variance_m2)
        };
        Measurement { time: at_s(second.into()), fix: None, regressed: Some(measured) }
    };
    let mut track = Track::start(TrackSettings::default(), &boxes(0)).expect("a box");
    let (mut north_m, mut least_r95_m) = (0.0, f64::INFINITY);
    for second in 1..=150 {
        let state = track.update(&boxes(second));
        if second > 60 {
            north_m += state.position.north_m / 90.0;
            least_r95_m = state.r95_m.min(least_r95_m);
        }
    }
    println!("{north_m} m, {least_r95_m} m");
    // The mean of the boxes' variances has a 95 % radius of 3.7 m, the variance of the surer ones one of 2.4 m.
    assert!(north_m < 1.5, "{north_m} m");
    assert!(least_r95_m > 3.3, "{least_r95_m} m");
}

#[test]
fn many_boxes_are_not_stated_to_be_better_than_one() {
    let settings = TrackSettings {
        regression: RegressionNoise { correlation_length_m: 1.0, ..RegressionNoise::default() },
        ..TrackSettings::default()
    };
    let mut track = Track::start(settings, &box_at(0.0, 0.0, 4.0)).expect("a box");
    for second in 1..120 {
        let state = track.update(&box_at(second.into(), 9.0 * f64::from(second), 4.0));
        assert!(state.r95_m > 4.5, "{second}: {state:?}");
    }
    // Fixes say more than boxes do, where they are better.
    for second in 120..240 {
        let fix =
            MeasuredPosition::isotropic(EastNorth { east_m: 9.0 * f64::from(second), north_m: 0.0 }, 0.04);
        let boxes = box_at(second.into(), 9.0 * f64::from(second), 4.0);
        track.update(&Measurement { fix: Some(fix), ..boxes });
    }
    assert!(track.state_at(track.measured_at()).r95_m < 2.0);
}

#[test]
fn the_estimated_noise_improves_tracks_of_white_and_of_correlated_receivers() {
    let pedestrian = Walk::pedestrian();
    let white = Walk {
        gnss: GaussMarkovNoise::new(29.5, NoiseCorrelation::WHITE),
        regression: GaussMarkovNoise::new(4.0, pedestrian.regression.correlation),
        speed_m_s: 8.0,
        ..pedestrian
    };
    for walk in [white, pedestrian] {
        let traverses: Vec<Vec<TimedResidual>> = (500..520)
            .map(|seed| simulate(&walk, seed, 300).iter().map(|(_, it)| residual(it)).collect())
            .collect();
        let e_regression_m2 = walk.regression.variance_m2;
        let estimate =
            estimate_gnss_noise(&traverses, e_regression_m2, &RegressionNoise::default().correlation)
                .expect("enough");
        println!("{estimate:?}");
        assert!(
            (estimate.correlation.white_share - walk.gnss.correlation.white_share).abs() < 0.1,
            "{estimate:?}"
        );
        assert!(((estimate.variance_m2 / walk.gnss.variance_m2).sqrt() - 1.0).abs() < 0.15, "{estimate:?}");
        let informed = TrackSettings { gnss: estimate.correlation, ..TrackSettings::default() };
        let wrong_share = 1.0 - walk.gnss.correlation.white_share;
        let misled = TrackSettings {
            gnss: NoiseCorrelation { white_share: wrong_share, time_constant_s: 40.0 },
            ..TrackSettings::default()
        };
        let (right, wrong) = (run(informed, &walk, 0..10, 400), run(misled, &walk, 0..10, 400));
        println!("{right:?}\n{wrong:?}");
        assert!(right.error_m < wrong.error_m, "{right:?} {wrong:?}");
        assert!((0.88..0.99).contains(&right.inside), "{right:?}");
    }
}

fn residual(measurement: &Measurement) -> TimedResidual {
    let (fix, regressed) = (measurement.fix.expect("there"), measurement.regressed.expect("there"));
    TimedResidual { time: measurement.time, difference: fix.position.minus(regressed.position) }
}

#[test]
fn too_few_residuals_give_no_estimate() {
    let walk = simulate(&Walk::pedestrian(), 1, 20);
    let traverse: Vec<TimedResidual> = walk.iter().map(|(_, it)| residual(it)).collect();
    assert!(estimate_gnss_noise(&[traverse], 0.5, &RegressionNoise::default().correlation).is_none());
    assert!(estimate_gnss_noise(&[], 0.5, &RegressionNoise::default().correlation).is_none());
}

#[test]
fn the_stated_error_grows_without_measurements_and_contains_the_truth() {
    let gaps = [2.0, 5.0, 10.0, 20.0, 40.0];
    let (mut inside, mut radii_m) = ([0; 5], [0.0; 5]);
    let runs = 60;
    for seed in 0..runs {
        let walk = simulate(&Walk { turn_interval_s: 40, ..Walk::pedestrian() }, 1_000 + seed, 200);
        let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
        for (_, measurement) in &walk[1..150] {
            track.update(measurement);
        }
        let mut previous_m = track.state_at(track.measured_at()).r95_m;
        for (index, gap_s) in gaps.into_iter().enumerate() {
            let state = track.state_at(at_s(149.0 + gap_s));
            assert!(state.r95_m > previous_m, "{gap_s}: {} after {previous_m}", state.r95_m);
            previous_m = state.r95_m;
            radii_m[index] = previous_m;
            let truth = walk[149 + gap_s as usize].0;
            inside[index] += u32::from(state.position.distance_m(truth) <= state.r95_m);
        }
    }
    println!("{inside:?} of {runs}, {radii_m:.1?}");
    assert!(inside.iter().all(|count| *count >= 51), "{inside:?} of {runs}");
}

#[test]
fn each_source_alone_sustains_the_track() {
    let walk = simulate(&Walk::pedestrian(), 7, 400);
    for lost in [MeasurementSource::Fix, MeasurementSource::Regressed] {
        let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
        let mut radius_with_both_m = 0.0;
        for (index, (truth, measurement)) in walk.iter().enumerate().skip(1) {
            let mut measurement = *measurement;
            if index >= 200 {
                match lost {
                    MeasurementSource::Fix => measurement.fix = None,
                    MeasurementSource::Regressed => measurement.regressed = None,
                }
            }
            let state = track.update(&measurement);
            if index == 199 {
                radius_with_both_m = state.r95_m;
            }
            if index >= 260 {
                assert!(state.r95_m > radius_with_both_m, "{lost:?} at {index}");
                assert!(state.position.distance_m(*truth) < 2.5 * state.r95_m, "{lost:?} at {index}");
            }
        }
    }
}

#[test]
fn outliers_are_rejected_with_a_reason_and_do_not_change_the_state() {
    let walk = simulate(&Walk::pedestrian(), 11, 300);
    let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
    let mut untouched = track.clone();
    for (index, (_, measurement)) in walk.iter().enumerate().skip(1) {
        if index % 37 == 0 {
            let outlier = Measurement { fix: moved(measurement.fix, 60.0), ..*measurement };
            let state = track.update(&outlier);
            let rejection = state.rejected.first().expect("60 m are beyond the gate");
            assert_eq!(
                (rejection.source, rejection.reason),
                (MeasurementSource::Fix, RejectionReason::OutsideGate)
            );
            assert!(rejection.nis.is_some_and(|nis| nis > track.settings().gate));
            untouched.update(&Measurement { fix: None, ..*measurement });
        } else {
            track.update(measurement);
            untouched.update(measurement);
        }
        let (now, then) = (track.state_at(measurement.time), untouched.state_at(measurement.time));
        assert!(now.position.distance_m(then.position) < 1e-9);
    }
}

#[test]
fn a_source_whose_bias_jumped_is_reacquired_without_a_jump_of_the_position() {
    for (lost, seed) in [(MeasurementSource::Fix, 21), (MeasurementSource::Regressed, 22)] {
        let shift_m = if lost == MeasurementSource::Fix { 12.0 } else { 5.0 };
        let walk = simulate(&Walk::pedestrian(), seed, 260);
        let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
        let mut rejected_late = 0;
        for (index, (truth, measurement)) in walk.iter().enumerate().skip(1) {
            let mut measurement = *measurement;
            if index >= 200 {
                match lost {
                    MeasurementSource::Fix => measurement.fix = moved(measurement.fix, shift_m),
                    MeasurementSource::Regressed => {
                        measurement.regressed = moved(measurement.regressed, shift_m)
                    }
                }
            }
            let state = track.update(&measurement);
            assert!(!state.restarted);
            if index >= 212 {
                rejected_late += state.rejected.len();
            }
            if lost == MeasurementSource::Fix && index >= 200 {
                assert!(state.position.distance_m(*truth) < 4.0, "{index}: {state:?}");
            }
        }
        assert!(rejected_late <= 2, "{lost:?}: {rejected_late}");
    }
}

#[test]
fn the_first_steps_of_a_stationary_target_are_accepted() {
    let regressed_at = |second: u32, east_m: f64| Measurement {
        time: at_s(f64::from(second)),
        fix: None,
        regressed: Some(MeasuredPosition::isotropic(EastNorth { east_m, north_m: 0.0 }, 0.1)),
    };
    let default = RegressionNoise::default();
    let correlation = NoiseCorrelation { white_share: 0.1, ..default.correlation };
    let regression = RegressionNoise { correlation, ..default };
    let settings = TrackSettings { regression, ..TrackSettings::default() };
    let mut track = Track::start(settings, &regressed_at(0, 0.0)).expect("a position");
    for second in 1..40 {
        track.update(&regressed_at(second, 0.0));
    }
    for second in 40..60 {
        let east_m = 1.25 * f64::from(second - 39);
        let state = track.update(&regressed_at(second, east_m));
        assert!(state.rejected.is_empty(), "{state:?}");
        assert!((state.position.east_m - east_m).abs() < 1.0, "{state:?}");
    }
}

#[test]
fn an_id_that_names_another_target_takes_the_track_there_at_once() {
    let walk = simulate(&Walk::pedestrian(), 23, 120);
    let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
    for (index, (truth, measurement)) in walk.iter().enumerate().skip(1) {
        let apart_m = if index >= 60 { 40.0 } else { 0.0 };
        let state = track.update(&Measurement {
            fix: moved(measurement.fix, apart_m),
            regressed: moved(measurement.regressed, apart_m),
            ..*measurement
        });
        assert_eq!(state.restarted, index == 60, "{index}");
        let truth = EastNorth { east_m: truth.east_m + apart_m, ..*truth };
        assert!(state.position.distance_m(truth) < 6.0, "{index}: {state:?}");
    }
}

#[test]
fn boxes_that_the_fixes_confirm_are_followed_and_others_are_not() {
    // A fix of 30 m does not contradict a track that is 40 m off, nor the boxes there; one of 2 m contradicts the boxes.
    for (fix_sigma_m, is_followed) in [(30.0, true), (2.0, false)] {
        let at = |second: f64, box_east_m: f64| Measurement {
            fix: fix_at(second, 0.0, fix_sigma_m * fix_sigma_m).fix,
            ..box_at(second, box_east_m, 2.25)
        };
        let mut track = Track::start(TrackSettings::default(), &at(0.0, 0.0)).expect("has both");
        for second in 1..60 {
            track.update(&at(f64::from(second), 0.0));
        }
        let states: Vec<_> = (60..66).map(|second| track.update(&at(f64::from(second), 40.0))).collect();
        let restarted: Vec<bool> = states.iter().map(|state| state.restarted).collect();
        assert_eq!(restarted, [false, false, is_followed, false, false, false], "{fix_sigma_m} m");
        let east_m = states[5].position.east_m;
        assert!(if is_followed { (east_m - 40.0).abs() < 3.0 } else { east_m.abs() < 3.0 }, "{east_m}");
    }
}

#[test]
fn false_boxes_leave_a_radius_that_holds() {
    // A detector of anything: a tenth of its boxes looks like a target, at a place that has nothing to do with that of the
    // target, the origin. The others say that they know no more than the scene.
    let mut random = stream(31, 0);
    let mut next = |second: u32| {
        let [east_m, north_m] = [0, 1].map(|_| 20.0 * standard_normal(&mut random));
        let sure = MeasuredPosition::isotropic(EastNorth { east_m, north_m }, 1.0);
        let covariance = PlaneCovariance::isotropic(400.0);
        let vague = MeasuredPosition { is_vague: true, is_doubtful: true, covariance, ..sure };
        let regressed = Some(if second.is_multiple_of(10) { sure } else { vague });
        Measurement { time: at_s(f64::from(second)), fix: None, regressed }
    };
    let mut track = Track::start(TrackSettings::default(), &next(0)).expect("a box");
    let states: Vec<_> = (1..400).map(|second| track.update(&next(second))).collect();
    let settled = &states[20..];
    let inside = settled.iter().filter(|it| it.position.distance_m(EastNorth::default()) <= it.r95_m);
    let share = inside.count() as f64 / settled.len() as f64;
    assert!(share >= 0.88, "{share}");
}

#[test]
fn a_single_source_that_contradicts_the_track_restarts_it() {
    let mut track = Track::start(TrackSettings::default(), &fix_at(0.0, 0.0, 4.0)).expect("a fix");
    for second in 1..30 {
        track.update(&fix_at(f64::from(second), 0.0, 4.0));
    }
    let states: Vec<TrackState> =
        (30..45).map(|second| track.update(&fix_at(f64::from(second), 500.0, 4.0))).collect();
    assert_eq!(states[0].rejected.len(), 1);
    assert_eq!(states.iter().filter(|state| state.restarted).count(), 1);
    let last = states.last().expect("not empty");
    assert!((last.position.east_m - 500.0).abs() < 1.0 && last.rejected.is_empty(), "{last:?}");
}

#[test]
fn late_duplicate_and_unusable_measurements_are_rejected_with_a_reason() {
    let mut track = Track::start(TrackSettings::default(), &fix_at(0.0, 0.0, 4.0)).expect("a fix");
    for second in 1..40 {
        track.update(&fix_at(f64::from(second), 0.0, 4.0));
    }
    let before = track.state_at(at_s(39.0));
    for (measurement, reason) in [
        (fix_at(20.0, 0.0, 4.0), RejectionReason::TooLate),
        (fix_at(38.0, 0.0, 4.0), RejectionReason::Duplicate),
        (fix_at(39.0, 0.0, 4.0), RejectionReason::Duplicate),
        (fix_at(40.0, 0.0, 0.0), RejectionReason::UnusableVariance),
        (fix_at(40.0, 0.0, f64::NAN), RejectionReason::UnusableVariance),
    ] {
        let state = track.update(&measurement);
        assert_eq!(state.rejected.iter().map(|it| it.reason).collect::<Vec<_>>(), [reason]);
        assert_eq!(state.position, before.position);
    }
    assert!(!track.is_expired(at_s(60.0)) && track.is_expired(at_s(140.0)));
    assert!(Track::start(TrackSettings::default(), &fix_at(0.0, 0.0, 0.0)).is_none());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn the_order_of_arrival_does_not_change_the_state(seed in 0..1_000u64, rate_hz in 1..26u32) {
        // Boxes and fixes separately, each delayed by up to 1.4 s; the window is 3 s.
        let mut random = stream(seed, 0);
        let period_s = 1.0 / f64::from(rate_hz);
        let mut items = Vec::new();
        for (index, (_, measurement)) in simulate(&Walk::pedestrian(), seed, 150).into_iter().enumerate().skip(1) {
            let time = at_s(1.0 + index as f64 * period_s);
            items.push(Measurement { time, fix: None, ..measurement });
            if (index as u32).is_multiple_of(rate_hz) {
                items.push(Measurement { time, regressed: None, ..measurement });
            }
        }
        let first = fix_at(0.0, 0.0, 4.0);
        let mut in_order = Track::start(TrackSettings::default(), &first).expect("a fix");
        for item in &items {
            in_order.update(item);
        }
        let mut arrivals: Vec<(Timestamp, Measurement)> = items
            .iter()
            .map(|item| (item.time + SignedDuration::from_secs_f64(0.7 * (1.0 + standard_normal(&mut random).sin())), *item))
            .collect();
        arrivals.sort_by_key(|(arrival, _)| *arrival);
        let mut shuffled = Track::start(TrackSettings::default(), &first).expect("a fix");
        for (_, item) in &arrivals {
            let state = shuffled.update(item);
            let late = state.rejected.iter().any(|it| it.reason != RejectionReason::OutsideGate);
            prop_assert!(!late, "{:?}", state.rejected);
        }
        let end = at_s(200.0);
        prop_assert_eq!(in_order.state_at(end), shuffled.state_at(end));
    }
}

#[test]
fn past_states_within_the_window_are_reproduced() {
    let walk = simulate(&Walk::pedestrian(), 5, 60);
    let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
    let mut states = Vec::new();
    for (_, measurement) in &walk[1..] {
        states.push(track.update(measurement));
    }
    for state in &states[states.len() - 3..] {
        let again = track.state_at(state.time);
        assert_eq!(again.position, state.position);
        assert_eq!(again.covariance, state.covariance);
    }
}

#[test]
fn settings_are_those_of_the_model_and_the_defaults_for_an_earlier_format() {
    let train = simulate_world(&Options { samples: 400, ..Options::demo() }).training_samples();
    let options = FitOptions {
        recipe: Recipe::Hybrid,
        seed: 1,
        epochs: Some(5),
        image_size: None,
        gnss_error: GnssError::Unknown,
        gnss_bias_sigma_m: None,
    };
    let mut artifact =
        fit(&train, &options, &mut |_| std::ops::ControlFlow::Continue(())).expect("usable samples");
    let model = artifact.load().expect("a model");
    let fitted = TrackSettings::from_model(&model);
    assert_ne!(fitted, TrackSettings::default());
    let length_m = fitted.regression.correlation_length_m;
    assert!(length_m > 2.0 * model.scene_radius_m(), "{length_m} m");
    artifact.metadata.parameters.retain(|name, _| !name.starts_with("track_"));
    let earlier = TrackSettings::from_model(&artifact.load().expect("a model"));
    assert_eq!(earlier, TrackSettings::default());
}
