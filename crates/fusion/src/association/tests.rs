use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::assignment::posterior;
use super::cancellation::Cancellation;
use super::chains::{Chain, ChainSettings};
use super::cuts;
use super::evidence::{EvidenceModel, LikelihoodRatio};
use super::matching::{MatchSettings, clock_grid, piece_posterior};
use super::placement::{Density, GroundPrior, PlacementSearch};
use super::tracklet::{SceneMotion, TimedFix, TrackPoint, Tracklet};
use crate::domain::{GaussMarkovNoise, NoiseCorrelation};
use crate::geo::EastNorth;
use crate::simulation::{standard_normal, stream};

const MODEL: EvidenceModel = EvidenceModel {
    gnss: GaussMarkovNoise {
        variance_m2: 6.8,
        correlation: NoiseCorrelation { white_share: 0.083, time_constant_s: 30.0 },
    },
    motion: SceneMotion { spread_m: 6.0, speed_m_s: 0.8, speeds_m_s: [0.8; 3] },
};

const GROUND: GroundPrior = GroundPrior { map_sigma_m: 1.0, scale_sigma: 0.06, density: Density::Fixes };

/// A walk of a minute with a turn, from a point on, m.
fn walk(from_m: [f64; 2], turn: f64) -> Tracklet {
    let points = (0..120).map(|step| {
        let time_s = 0.5 * f64::from(step);
        let heading = turn * time_s / 60.0;
        let position = EastNorth {
            east_m: from_m[0] + 0.9 * time_s * heading.cos(),
            north_m: from_m[1] + 0.9 * time_s * heading.sin(),
        };
        TrackPoint { time_s, position, box_variance_m2: 0.04, map_variance_m2: 0.25 }
    });
    Tracklet { points: points.collect() }
}

/// Fixes of a receiver that is carried along a walk.
fn carried(track: &Tracklet, seed: u64) -> Vec<TimedFix> {
    let mut random = stream(seed, 0);
    let mut bias_m = [0, 1].map(|_| 2.5 * standard_normal(&mut random));
    let decay = (-1.0_f64 / 30.0).exp();
    track
        .points
        .iter()
        .step_by(2)
        .map(|point| {
            bias_m = bias_m
                .map(|own| decay * own + 2.5 * (1.0 - decay * decay).sqrt() * standard_normal(&mut random));
            let [east_m, north_m] = bias_m.map(|own| own + 0.75 * standard_normal(&mut random));
            let position = EastNorth {
                east_m: point.position.east_m + east_m,
                north_m: point.position.north_m + north_m,
            };
            TimedFix { time_s: point.time_s, position, stated_variance_m2: None }
        })
        .collect()
}

#[test]
fn the_recursive_ratio_is_that_of_the_dense_covariance() {
    let track = walk([1.0, 2.0], 1.5);
    for seed in 1..=3 {
        // The quadratic form takes at most 40 fixes without thinning.
        let fixes: Vec<TimedFix> = carried(&track, seed).into_iter().take(40).collect();
        let recursive = LikelihoodRatio::new().extended(&track.residuals(&fixes, 0.0, 2.5), &MODEL);
        let recursive = recursive.normal_log_ratio();
        let dense = PlacementSearch::new(
            std::slice::from_ref(&track),
            std::slice::from_ref(&fixes),
            &[(0.0, 0.0)],
            &MODEL,
            &GroundPrior { map_sigma_m: 0.5, ..GROUND },
            0.0,
        );
        let dense = dense.log_ratios_at_identity()[0];
        // The recursion allows for gross errors in 1 % of the fixes, under both hypotheses.
        assert!((recursive - dense).abs() < 0.5, "seed {seed}: {recursive} {dense}");
    }
}

#[test]
fn fixes_that_differ_more_than_the_model_says_are_still_of_the_carrier() {
    let track = walk([1.0, 2.0], 1.5);
    for seed in 1..=3 {
        // A receiver whose error is half as large again as the model was trained with.
        let mut fixes = carried(&track, seed);
        for (fix, point) in fixes.iter_mut().zip(track.points.iter().step_by(2)) {
            let EastNorth { east_m, north_m } = point.position;
            fix.position = EastNorth {
                east_m: 1.5 * fix.position.east_m - 0.5 * east_m,
                north_m: 1.5 * fix.position.north_m - 0.5 * north_m,
            };
        }
        let ratio = LikelihoodRatio::new().extended(&track.residuals(&fixes, 0.0, 2.5), &MODEL);
        assert!(ratio.log_ratio() > 5.0, "{seed}: {}, {}", ratio.log_ratio(), ratio.normal_log_ratio());
        assert!(ratio.log_ratio() > ratio.normal_log_ratio(), "{seed}: {}", ratio.normal_log_ratio());
    }
}

#[test]
fn the_carrier_has_the_largest_ratio() {
    let tracks = [walk([0.0, 0.0], 1.5), walk([2.0, -3.0], -1.0), walk([-4.0, 6.0], 2.5)];
    for seed in 1..=5 {
        let fixes = carried(&tracks[0], seed);
        let ratios = tracks.each_ref().map(|track| {
            LikelihoodRatio::new().extended(&track.residuals(&fixes, 0.0, 2.5), &MODEL).log_ratio()
        });
        assert!(ratios[0] > 3.0 && ratios[0] > ratios[1] + 3.0 && ratios[0] > ratios[2] + 3.0, "{ratios:?}");
    }
}

#[test]
fn a_swap_in_the_middle_of_a_tracklet_is_cut() {
    let (own, other) = (walk([0.0, 0.0], 1.5), walk([2.0, -3.0], -1.0));
    let fixes = carried(&own, 7);
    let mut swapped = own.clone();
    swapped.points[60..].copy_from_slice(&other.points[60..]);
    let receivers = [(fixes.as_slice(), 0.0)];
    let settings = ChainSettings::default();
    let pieces = cuts::pieces(&[own, swapped], &receivers, &MODEL, &settings);
    let of = |tracklet| pieces.iter().filter(move |piece| piece.tracklet == tracklet);
    assert_eq!(of(0).count(), 1, "{pieces:?}");
    assert!(of(1).any(|piece| (52..=68).contains(&piece.end)), "{pieces:?}");
}

/// The most probable receiver of each tracklet with the probability of being its carrier's.
fn owners(tracklets: &[Tracklet], fixes: &[Vec<TimedFix>]) -> Vec<(usize, f64)> {
    let receivers: Vec<(&[TimedFix], f64)> = fixes.iter().map(|own| (own.as_slice(), 0.0)).collect();
    let settings = ChainSettings::default();
    let mut random = stream(1, 1);
    let posterior =
        piece_posterior(tracklets, &receivers, &MODEL, &settings, &mut random, Cancellation::NEVER);
    let owned = posterior.expect("not cancelled");
    owned.owned().map(|own| (own.receiver, own.probability)).collect()
}

/// Two tracklets 0.6 m apart, of which the second is seen for a share of the time.
fn in_company(share: f64) -> [Tracklet; 2] {
    let mut beside = walk([0.0, 0.6], 1.5);
    beside.points.truncate((share * beside.points.len() as f64) as usize);
    [walk([0.0, 0.0], 1.5), beside]
}

#[test]
fn companions_share_a_receiver() {
    for seed in 1..=5 {
        let [own, beside] = in_company(1.0);
        let fixes = vec![carried(&own, seed)];
        let found = owners(&[own, beside, walk([20.0, -9.0], -1.0)], &fixes);
        let [own, beside, far] = [0, 1, 2].map(|at| found[at].1);
        assert!(own < 0.9 && beside < 0.9 && own + beside > 0.9 && far < 0.05, "{seed}: {found:?}");
    }
}

#[test]
fn who_is_still_seen_when_the_companion_has_left_is_more_probable() {
    for seed in 1..=5 {
        let tracklets = in_company(0.7);
        let found = owners(&tracklets, &[carried(&tracklets[0], seed)]);
        assert!(found[0].1 > found[1].1 && found[1].1 > 0.0, "{seed}: {found:?}");
    }
}

#[test]
fn who_has_no_company_keeps_the_receiver() {
    let tracklets = [walk([0.0, 0.0], 1.5), walk([12.0, 0.6], 1.5)];
    for seed in 1..=3 {
        let found = owners(&tracklets, &[carried(&tracklets[0], seed)]);
        assert!(found[0].1 > 0.9, "{seed}: {found:?}");
    }
}

fn chain(pieces: &[usize], log_weight: f64) -> Chain {
    Chain { pieces: pieces.to_vec(), log_weight }
}

#[test]
fn sampled_probabilities_are_those_of_the_enumeration() {
    // Two receivers want piece 0; the second one may have piece 1, or both.
    let chains = vec![
        vec![chain(&[], 0.0), chain(&[0], 1.5), chain(&[1], 0.2)],
        vec![chain(&[], 0.0), chain(&[0], 1.0), chain(&[1], 0.8), chain(&[0, 1], 2.0)],
    ];
    let mut expected = vec![vec![0.0; 2]; 2];
    let mut total = 0.0;
    for one in &chains[0] {
        for other in &chains[1] {
            if one.pieces.iter().all(|piece| !other.pieces.contains(piece)) {
                let weight = (one.log_weight + other.log_weight).exp();
                total += weight;
                one.pieces.iter().for_each(|piece| expected[0][*piece] += weight);
                other.pieces.iter().for_each(|piece| expected[1][*piece] += weight);
            }
        }
    }
    let sampled = posterior(&chains, 2, &mut ChaCha8Rng::seed_from_u64(3), Cancellation::NEVER)
        .expect("never cancelled");
    for (own, wanted) in sampled.iter().flatten().zip(expected.iter().flatten()) {
        assert!((own - wanted / total).abs() < 0.06, "{sampled:?} {expected:?} {total}");
    }
}

/// Largest error, m, of the middle of four walks in the best placement of a ground that is turned by 70 degrees, 100 m
/// away, and so much smaller; three of the walkers carry receivers, and there are some others at anchor.
fn largest_error_m(prior: &GroundPrior, scale: f64, anchored: u8) -> f64 {
    error_with_clocks_m(prior, scale, anchored, 0.0, 0.0)
}

/// The same with receivers' clocks that are late, and a window in which their offsets are searched, s.
fn error_with_clocks_m(
    prior: &GroundPrior,
    scale: f64,
    anchored: u8,
    late_s: f64,
    clock_window_s: f64,
) -> f64 {
    let tracks =
        [walk([0.0, 0.0], 1.5), walk([8.0, -3.0], -1.0), walk([-4.0, 9.0], 2.5), walk([3.0, 5.0], 4.0)];
    let (sin, cos) = 70.0_f64.to_radians().sin_cos();
    let seen = |track: &Tracklet| {
        let turned = track.points.iter().map(|point| {
            let (east, north) = (scale * (point.position.east_m - 100.0), scale * point.position.north_m);
            let position = EastNorth { east_m: cos * east - sin * north, north_m: sin * east + cos * north };
            TrackPoint { position, ..*point }
        });
        Tracklet { points: turned.collect() }
    };
    let at_anchor = |number: u8| {
        let position = EastNorth { east_m: 40.0 * f64::from(number), north_m: -30.0 };
        let points = tracks[0].points.iter().map(|point| TrackPoint { position, ..*point });
        carried(&Tracklet { points: points.collect() }, 40 + u64::from(number))
    };
    let ground: Vec<Tracklet> = tracks.iter().map(seen).collect();
    let mut receivers: Vec<Vec<TimedFix>> = (0..3).map(|at| carried(&tracks[at], 20 + at as u64)).collect();
    receivers.extend((0..anchored).map(at_anchor));
    receivers.iter_mut().flatten().for_each(|fix| fix.time_s += late_s);
    let settings = MatchSettings { clock_window_s, ..MatchSettings::default() };
    let search = PlacementSearch::new(&ground, &receivers, &clock_grid(&settings), &MODEL, prior, 0.0);
    let best = search.search(1, 50.0, Cancellation::NEVER)[0];
    let error_m = |(track, ground): (&Tracklet, &Tracklet)| {
        let (truth, point) = (track.points[60].position, ground.points[60].position);
        let [east_m, north_m] = best.apply(point.east_m, point.north_m);
        (east_m - truth.east_m).hypot(north_m - truth.north_m)
    };
    tracks.iter().zip(&ground).map(error_m).fold(0.0, f64::max)
}

#[test]
fn place_and_direction_are_found_by_fixes_of_unknown_carriers() {
    let error_m = largest_error_m(&GROUND, 1.0, 0);
    assert!(error_m < 5.0, "{error_m}");
}

#[test]
fn a_clock_window_allows_for_late_clocks() {
    let [without_m, with_m] = [0.0, 10.0].map(|window_s| error_with_clocks_m(&GROUND, 1.0, 0, 8.0, window_s));
    assert!(with_m < 5.0 && without_m > with_m + 1.0, "{without_m} {with_m}");
}

#[test]
fn an_unknown_scale_is_found_beside_receivers_at_anchor() {
    let unknown = GroundPrior { scale_sigma: 1.5, density: Density::GroundPoints, ..GROUND };
    let error_m = largest_error_m(&unknown, 0.1, 4);
    assert!(error_m < 8.0, "{error_m}");
}
