//! Seeded simulations with bounds: consistency, growth, gates, order.

use jiff::SignedDuration;
use proptest::prelude::*;

use super::simulated::{Normal, World, at_s};
use super::*;

/// What a run over a simulated walk came to.
#[derive(Default, Debug)]
struct Tally {
    error_m: f64,
    gnss_error_m: f64,
    two_step_error_m: f64,
    nees: f64,
    nis: [f64; 2],
    inside: f64,
    rejected: usize,
    steps: f64,
}

fn run(settings: TrackSettings, world: &World, seeds: std::ops::Range<u64>, seconds: u32) -> Tally {
    let mut tally = Tally::default();
    for seed in seeds {
        let walk = world.walk(seed, seconds);
        let mut track = Track::start(settings, &walk[0].1).expect("has both");
        for (truth, measurement) in &walk[1..] {
            let state = track.update(measurement);
            let fix = measurement.fix.expect("always there");
            let regressed = measurement.regressed.expect("always there");
            let weight = fix.covariance.east_m2 / (fix.covariance.east_m2 + regressed.covariance.east_m2);
            let two_step = EastNorth {
                east_m: weight * regressed.position.east_m + (1.0 - weight) * fix.position.east_m,
                north_m: weight * regressed.position.north_m + (1.0 - weight) * fix.position.north_m,
            };
            tally.steps += 1.0;
            tally.error_m += state.position.distance_m(*truth);
            tally.gnss_error_m += fix.position.distance_m(*truth);
            tally.two_step_error_m += two_step.distance_m(*truth);
            tally.nees += state.covariance.squared_length(minus(state.position, *truth));
            tally.inside += f64::from(u8::from(state.position.distance_m(*truth) <= state.r95_m));
            tally.rejected += state.rejected.len();
            for innovation in &state.innovations {
                tally.nis[innovation.source as usize] += innovation.nis;
            }
        }
    }
    let steps = tally.steps;
    tally.error_m /= steps;
    tally.gnss_error_m /= steps;
    tally.two_step_error_m /= steps;
    tally.nees /= steps;
    tally.inside /= steps;
    tally.nis = tally.nis.map(|sum| sum / steps);
    tally
}

fn minus(a: EastNorth, b: EastNorth) -> EastNorth {
    EastNorth { east_m: a.east_m - b.east_m, north_m: a.north_m - b.north_m }
}

/// A fix alone, with the square of its sigma.
fn fix_at(seconds: f64, east_m: f64, variance_m2: f64) -> Measurement {
    let fix = Measured::isotropic(EastNorth { east_m, north_m: 0.0 }, variance_m2);
    Measurement { time: at_s(seconds), fix: Some(fix), regressed: None }
}

fn moved(measured: Option<Measured>, east_m: f64) -> Option<Measured> {
    measured.map(|it| Measured {
        position: EastNorth { east_m: it.position.east_m + east_m, ..it.position },
        ..it
    })
}

#[test]
fn a_walker_is_followed_consistently_and_better_than_by_two_steps() {
    let tally = run(TrackSettings::default(), &World::phone(), 0..20, 600);
    println!("{tally:?}");
    assert!(tally.error_m < 0.95 * tally.two_step_error_m, "{tally:?}");
    assert!(tally.error_m < 0.45 * tally.gnss_error_m, "{tally:?}");
    // Chi-square of 2 degrees has mean 2. The walker turns on the spot where the filter expects
    // accelerations, so the bounds are wider than sampling alone would ask for.
    assert!((1.5..2.5).contains(&tally.nees), "{tally:?}");
    assert!(tally.nis.iter().all(|nis| (1.4..2.5).contains(nis)), "{tally:?}");
    assert!((0.92..0.98).contains(&tally.inside), "{tally:?}");
    assert!((tally.rejected as f64) < 0.01 * tally.steps, "{tally:?}");
}

#[test]
fn a_standing_target_is_averaged() {
    let world = World { speed_m_s: 0.0, camera_sigma_m: 1.5, ..World::phone() };
    let tally = run(TrackSettings::default(), &world, 100..160, 450);
    println!("{tally:?}");
    assert!(tally.gnss_error_m > 2.5 && tally.gnss_error_m < 3.0, "{tally:?}");
    assert!(tally.error_m < 1.3, "{tally:?}");
    assert!(tally.error_m < 0.9 * tally.two_step_error_m, "{tally:?}");
    assert!((0.90..0.99).contains(&tally.inside), "{tally:?}");
}

#[test]
fn white_and_coloured_receivers_both_pay_with_the_estimated_split() {
    let white = World {
        gnss_sigma_m: 29.5,
        gnss: GnssNoise { white_share: 1.0, time_constant_s: 40.0 },
        camera_sigma_m: 4.0,
        speed_m_s: 8.0,
        ..World::phone()
    };
    for world in [white, World::phone()] {
        let passes: Vec<Vec<ResidualAt>> = (500..520)
            .map(|seed| {
                let walk = world.walk(seed, 300);
                walk.iter().map(|(_, it)| residual(it)).collect()
            })
            .collect();
        let e_regression_m2 = world.camera_sigma_m.powi(2);
        let estimate = estimate_gnss_noise(&passes, e_regression_m2, &world.regression).expect("enough");
        println!("{estimate:?}");
        assert!((estimate.noise.white_share - world.gnss.white_share).abs() < 0.1, "{estimate:?}");
        assert!((estimate.variance_m2.sqrt() / world.gnss_sigma_m - 1.0).abs() < 0.15, "{estimate:?}");
        let informed = TrackSettings { gnss: estimate.noise, ..TrackSettings::default() };
        let wrong_share = 1.0 - world.gnss.white_share;
        let misled = TrackSettings {
            gnss: GnssNoise { white_share: wrong_share, time_constant_s: 40.0 },
            ..TrackSettings::default()
        };
        let (right, wrong) = (run(informed, &world, 0..10, 400), run(misled, &world, 0..10, 400));
        println!("{right:?}\n{wrong:?}");
        assert!(right.error_m < wrong.error_m, "{right:?} {wrong:?}");
        assert!((0.88..0.99).contains(&right.inside), "{right:?}");
    }
}

fn residual(measurement: &Measurement) -> ResidualAt {
    let (fix, regressed) = (measurement.fix.expect("there"), measurement.regressed.expect("there"));
    ResidualAt { time: measurement.time, difference: minus(fix.position, regressed.position) }
}

#[test]
fn too_few_residuals_tell_nothing() {
    let walk = World::phone().walk(1, 20);
    let pass: Vec<ResidualAt> = walk.iter().map(|(_, it)| residual(it)).collect();
    assert!(estimate_gnss_noise(&[pass], 0.5, &RegressionNoise::default()).is_none());
    assert!(estimate_gnss_noise(&[], 0.5, &RegressionNoise::default()).is_none());
}

#[test]
fn the_stated_error_grows_while_nothing_is_measured_and_holds_the_truth() {
    let gaps = [2.0, 5.0, 10.0, 20.0, 40.0];
    let (mut inside, mut radii_m) = ([0; 5], [0.0; 5]);
    let runs = 60;
    for seed in 0..runs {
        let walk = World { turn_s: 40, ..World::phone() }.walk(1_000 + seed, 200);
        let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
        for (_, measurement) in &walk[1..150] {
            track.update(measurement);
        }
        let mut last_m = track.state_at(track.measured_at()).r95_m;
        for (index, gap_s) in gaps.into_iter().enumerate() {
            let state = track.state_at(at_s(149.0 + gap_s));
            assert!(state.r95_m > last_m, "{gap_s}: {} after {last_m}", state.r95_m);
            last_m = state.r95_m;
            radii_m[index] = last_m;
            let truth = walk[149 + gap_s as usize].0;
            inside[index] += u32::from(state.position.distance_m(truth) <= state.r95_m);
        }
    }
    println!("{inside:?} of {runs}, {radii_m:.1?}");
    assert!(inside.iter().all(|count| *count >= 51), "{inside:?} of {runs}");
}

#[test]
fn each_source_alone_carries_the_track() {
    let walk = World::phone().walk(7, 400);
    for lost in [Source::Fix, Source::Regressed] {
        let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
        let mut radius_with_both_m = 0.0;
        for (index, (truth, measurement)) in walk.iter().enumerate().skip(1) {
            let mut measurement = *measurement;
            if index >= 200 {
                match lost {
                    Source::Fix => measurement.fix = None,
                    Source::Regressed => measurement.regressed = None,
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
fn outliers_are_rejected_by_name_and_leave_the_track_alone() {
    let walk = World::phone().walk(11, 300);
    let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
    let mut untouched = track.clone();
    for (index, (_, measurement)) in walk.iter().enumerate().skip(1) {
        if index % 37 == 0 {
            let outlier = Measurement { fix: moved(measurement.fix, 60.0), ..*measurement };
            let state = track.update(&outlier);
            let rejection = state.rejected.first().expect("60 m are no phone's error");
            assert_eq!((rejection.source, rejection.reason), (Source::Fix, RejectionReason::OutsideGate));
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
fn a_bias_that_jumped_is_believed_again_without_a_jump_of_the_position() {
    for (lost, seed) in [(Source::Fix, 21), (Source::Regressed, 22)] {
        let shift_m = if lost == Source::Fix { 12.0 } else { 5.0 };
        let walk = World::phone().walk(seed, 260);
        let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
        let mut rejected_late = 0;
        for (index, (truth, measurement)) in walk.iter().enumerate().skip(1) {
            let mut measurement = *measurement;
            if index >= 200 {
                match lost {
                    Source::Fix => measurement.fix = moved(measurement.fix, shift_m),
                    Source::Regressed => measurement.regressed = moved(measurement.regressed, shift_m),
                }
            }
            let state = track.update(&measurement);
            assert!(!state.restarted);
            if index >= 212 {
                rejected_late += state.rejected.len();
            }
            if lost == Source::Fix && index >= 200 {
                assert!(state.position.distance_m(*truth) < 4.0, "{index}: {state:?}");
            }
        }
        assert!(rejected_late <= 2, "{lost:?}: {rejected_late}");
    }
}

#[test]
fn whoever_stood_and_sets_out_is_believed_at_once() {
    let regressed_at = |second: u32, east_m: f64| Measurement {
        time: at_s(f64::from(second)),
        fix: None,
        regressed: Some(Measured::isotropic(EastNorth { east_m, north_m: 0.0 }, 0.1)),
    };
    let regression = RegressionNoise { white_share: 0.1, ..RegressionNoise::default() };
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
fn a_lone_source_that_contradicts_the_track_restarts_it() {
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
fn what_the_window_refuses_is_named() {
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
    assert!(!track.is_gone(at_s(60.0)) && track.is_gone(at_s(140.0)));
    assert!(Track::start(TrackSettings::default(), &fix_at(0.0, 0.0, 0.0)).is_none());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn order_of_arrival_leaves_no_trace(seed in 0..1_000u64, rate_hz in 1..26u32) {
        // Halves apart, each delayed by up to 1.4 s of the window of 3 s.
        let mut random = Normal::seeded(seed);
        let period_s = 1.0 / f64::from(rate_hz);
        let mut items = Vec::new();
        for (index, (_, measurement)) in World::phone().walk(seed, 150).into_iter().enumerate().skip(1) {
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
            .map(|item| (item.time + SignedDuration::from_secs_f64(0.7 * (1.0 + random.draw().sin())), *item))
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
fn the_past_within_the_window_is_told_as_it_was() {
    let walk = World::phone().walk(5, 60);
    let mut track = Track::start(TrackSettings::default(), &walk[0].1).expect("has both");
    let mut told = Vec::new();
    for (_, measurement) in &walk[1..] {
        told.push(track.update(measurement));
    }
    for state in &told[told.len() - 3..] {
        let again = track.state_at(state.time);
        assert_eq!(again.position, state.position);
        assert_eq!(again.covariance, state.covariance);
    }
}
