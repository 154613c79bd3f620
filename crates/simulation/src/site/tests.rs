//! Tests of the contents of a simulated site.

use std::collections::{BTreeMap, BTreeSet};

use super::*;

fn targets_of(camera: &SimulatedCamera) -> BTreeSet<&TargetId> {
    camera.detections.iter().filter_map(|it| it.target.as_ref()).collect()
}

#[test]
fn the_same_options_give_the_same_site() {
    let options = SiteOptions { duration_s: 20.0, ..SiteOptions::default() };
    assert_eq!(simulate_site(&options), simulate_site(&options));
    let other = SiteOptions { receiver_seed: 2, ..options.clone() };
    let (one, other) = (simulate_site(&options), simulate_site(&other));
    assert_eq!(one.cameras, other.cameras);
    assert_ne!(one.fixes, other.fixes);
}

#[test]
fn views_overlap_in_pairs_with_gaps_between() {
    let site = simulate_site(&SiteOptions { cameras: 4, ..SiteOptions::default() });
    let at_once = |one: usize, other: usize| {
        let seen = |camera: usize| -> BTreeSet<(Timestamp, TargetId)> {
            let labelled = site.cameras[camera].detections.iter();
            labelled.filter_map(|it| Some((it.detection.time, it.target.clone()?))).collect()
        };
        seen(one).intersection(&seen(other)).count()
    };
    assert!(at_once(0, 1) > 500 && at_once(2, 3) > 500, "{} {}", at_once(0, 1), at_once(2, 3));
    assert_eq!(at_once(1, 2), 0);
    for camera in &site.cameras {
        let kinds: BTreeSet<&str> =
            targets_of(camera).iter().filter_map(|it| it.as_str().split('-').next()).collect();
        assert_eq!(kinds, BTreeSet::from(["person", "vehicle"]));
    }
    assert_eq!(site.carriers.len(), 10);
}

#[test]
fn ids_break_and_swap_and_detections_are_missed_and_false() {
    let clean = SiteOptions { duration_s: 120.0, ..SiteOptions::default() };
    let rough = SiteOptions {
        missed_share: 0.1,
        false_per_frame: 0.5,
        tracker_id_lifetime_s: Some(20.0),
        tracker_id_swap_s: Some(10.0),
        ..clean.clone()
    };
    let targets_per_id = |site: &SimulatedSite| {
        let mut by_id: BTreeMap<TargetId, BTreeSet<TargetId>> = BTreeMap::new();
        for it in &site.cameras[0].detections {
            by_id.entry(it.detection.target_id.clone()).or_default().extend(it.target.clone());
        }
        by_id
    };
    let (clean, rough) = (simulate_site(&clean), simulate_site(&rough));
    assert!(targets_per_id(&clean).values().all(|targets| targets.len() == 1));
    assert!(targets_per_id(&rough).values().any(|targets| targets.len() > 1));
    assert!(targets_per_id(&rough).len() > 2 * targets_per_id(&clean).len());
    let count = |site: &SimulatedSite, real: bool| {
        site.cameras[0].detections.iter().filter(|it| it.target.is_some() == real).count() as f64
    };
    let kept = count(&rough, true) / count(&clean, true);
    assert!((0.87..0.93).contains(&kept), "{kept}");
    let false_per_frame = count(&rough, false) / 241.0;
    assert!((0.4..0.6).contains(&false_per_frame), "{false_per_frame}");
}

#[test]
fn companions_stay_beside_whom_they_walk_with() {
    let alone = SiteOptions { walkers: 12, vehicles: 2, duration_s: 20.0, ..SiteOptions::default() };
    let site = simulate_site(&SiteOptions { group_share: 0.5, ..alone.clone() });
    let plane = LocalPlane::new(site.origin);
    let mut paths: BTreeMap<&TargetId, Vec<EastNorth>> = BTreeMap::new();
    for (_, target, position) in &site.truth {
        paths.entry(target).or_default().push(plane.to_plane(*position));
    }
    let is_beside = |one: &[EastNorth], other: &[EastNorth]| {
        one.iter().zip(other).all(|(one, other)| one.distance_m(*other) < 2.7)
    };
    let has_company = |target: &TargetId| {
        paths.iter().any(|(other, path)| *other != target && is_beside(path, &paths[target]))
    };
    assert_eq!(paths.keys().filter(|target| has_company(target)).count(), 6);
    // Those who walk alone go where they went.
    let leader_and_last = |site: &SimulatedSite| -> Vec<Position> {
        let kept =
            site.truth.iter().filter(|(_, target, _)| ["person-0", "person-11"].contains(&target.as_str()));
        kept.map(|(_, _, position)| *position).collect()
    };
    assert_eq!(leader_and_last(&site), leader_and_last(&simulate_site(&alone)));
}
