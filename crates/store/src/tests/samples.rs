use super::*;
use crate::domain::{Detection, SampleCount, Score, SigmaM, StoredSample, TargetClass};
use crate::{Inserted, SampleFilter, SampleKey};
use proptest::prelude::*;

#[tokio::test]
async fn samples_come_back_bit_for_bit_and_in_order() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let mut full = sample(3, "b");
    full.fix.sigma_m = Some(SigmaM::new(0.1 + 0.2).expect("a sigma"));
    full.class = Some(TargetClass::new("ö").expect("a class"));
    full.score = Some(Score::new(1.0 / 3.0).expect("a score"));
    full.truth = Some(Position::new(-179.999_999_9, -1e-300).expect("a place"));
    let without_fix = StoredSample { fix: None, ..full.clone().into() };
    let ordered: Vec<StoredSample> = vec![
        sample(-5, "z").into(),
        sample(1, "B").into(),
        StoredSample { target_id: target("a"), time: at(1), ..without_fix.clone() },
        sample(1, "é").into(),
        StoredSample { target_id: target("a"), ..without_fix },
        full.into(),
        sample(40, "a").into(),
    ];
    let mut shuffled = ordered.clone();
    shuffled.reverse();
    shuffled.swap(1, 4);
    store.insert_samples(&camera, shuffled, Durability::Synced).await.expect("stored");
    let read = store.samples(&camera, &SampleFilter::default(), None, 100).await.expect("read");
    assert_eq!(read, ordered);
}

#[tokio::test]
async fn a_key_is_stored_once_and_the_first_stays() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let other = id("other");
    store.insert_camera(&NewCamera::named(other.clone()), at(0)).await.expect("new");
    let mut twin = sample(1, "a");
    twin.score = Some(Score::new(0.5).expect("a score"));
    let first = store
        .insert_samples(&camera, vec![sample(1, "a"), twin.clone(), sample(1, "b")], Durability::Synced)
        .await;
    assert_eq!(first.expect("stored"), Inserted { accepted: 2, duplicate: 1, without_fix: 0, replaced: 0 });
    let again = store.insert_samples(&camera, vec![twin.clone(), sample(2, "a")], Durability::Synced).await;
    assert_eq!(again.expect("stored"), Inserted { accepted: 1, duplicate: 1, without_fix: 0, replaced: 0 });
    let elsewhere = store.insert_samples(&other, vec![twin], Durability::Synced).await;
    assert_eq!(
        elsewhere.expect("stored"),
        Inserted { accepted: 1, duplicate: 0, without_fix: 0, replaced: 0 }
    );
    assert_eq!(
        store.insert_samples(&camera, Vec::<Sample>::new(), Durability::Synced).await.expect("empty"),
        Inserted::default()
    );
    let kept = with_fix(&store, &camera).await;
    assert_eq!(kept, [sample(1, "a"), sample(1, "b"), sample(2, "a")]);
}

#[tokio::test]
async fn many_rows_of_any_number_are_counted_right() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let rows = |range: std::ops::Range<i64>| range.map(|second| sample(second, "a")).collect::<Vec<_>>();
    let mut stored = 0;
    for count in [1, 3, 5, 17, 1023, 1025, 4097, 10_000] {
        let inserted =
            store.insert_samples(&camera, rows(0..count), Durability::Synced).await.expect("stored");
        let (accepted, duplicate) = ((count - stored) as u64, stored as u64);
        assert_eq!(inserted, Inserted { accepted, duplicate, without_fix: 0, replaced: 0 });
        stored = count;
    }
    assert_eq!(store.count_samples(&camera, &SampleFilter::default()).await.expect("counted"), 10_000);
}

#[tokio::test]
async fn a_cursor_from_before_the_filter_does_not_widen_it() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    store
        .insert_samples(&camera, (0..6).map(|second| sample(second, "a")).collect(), Durability::Synced)
        .await
        .expect("stored");
    let filter = SampleFilter { from: Some(at(3)), ..SampleFilter::default() };
    let page =
        store.samples(&camera, &filter, Some(SampleKey::of(&sample(1, "a"))), 2).await.expect("a page");
    assert_eq!(page, [sample(3, "a"), sample(4, "a")].map(StoredSample::from));
}

#[tokio::test]
async fn deleting_takes_what_the_filter_selects() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let all = (0..10).flat_map(|second| [sample(second, "a"), sample(second, "b")]).collect();
    store.insert_samples(&camera, all, Durability::Synced).await.expect("stored");
    let filter =
        SampleFilter { from: Some(at(3)), until: Some(at(5)), target_id: Some(target("b")), has_fix: None };
    assert_eq!(store.delete_samples(&camera, &filter, at(9)).await.expect("deleted"), 2);
    let filter = SampleFilter { from: Some(at(8)), ..SampleFilter::default() };
    assert_eq!(store.delete_samples(&camera, &filter, at(9)).await.expect("deleted"), 4);
    assert_eq!(store.count_samples(&camera, &SampleFilter::default()).await.expect("counted"), 14);
    assert_eq!(kind(store.delete_samples(&id("none"), &filter, at(9)).await), ErrorKind::CameraNotFound);
    assert_eq!(kind(store.count_samples(&id("none"), &filter).await), ErrorKind::CameraNotFound);
    assert_eq!(kind(store.samples(&id("none"), &filter, None, 1).await), ErrorKind::CameraNotFound);
}

#[tokio::test]
async fn a_corrupt_sample_names_its_row() {
    let fixture = Fixture::new().await;
    fixture
        .store
        .insert_samples(&fixture.camera, vec![sample(1, "a")], Durability::Synced)
        .await
        .expect("stored");
    fixture.tamper("UPDATE samples SET latitude_deg = 91").await;
    let error =
        fixture.store.samples(&fixture.camera, &SampleFilter::default(), None, 9).await.expect_err("corrupt");
    assert_eq!(error.kind(), ErrorKind::Internal);
    let text = error.to_string();
    for part in ["samples", "latitude_deg", "target_id=a", "time_us=1607900001000000"] {
        assert!(text.contains(part), "{part} is missing in: {text}");
    }
}

/// All samples of a camera that have a fix.
async fn with_fix(store: &Store, camera: &CameraId) -> Vec<Sample> {
    let filter = SampleFilter { has_fix: Some(true), ..SampleFilter::default() };
    let samples = store.samples(camera, &filter, None, 1_000).await.expect("read");
    samples.into_iter().filter_map(StoredSample::with_fix).collect()
}

fn without_fix(second: i64, target_id: &str) -> StoredSample {
    StoredSample { fix: None, ..sample(second, target_id).into() }
}

#[tokio::test]
async fn a_sample_with_a_fix_takes_the_place_of_one_without_and_never_the_reverse() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let boxes = || (0..10).map(|second| without_fix(second, "a")).collect::<Vec<_>>();
    let inserted = store.insert_samples(&camera, boxes(), Durability::Synced).await.expect("stored");
    assert_eq!(inserted, Inserted { accepted: 10, duplicate: 0, without_fix: 10, replaced: 0 });
    let again = store.insert_samples(&camera, boxes(), Durability::Synced).await.expect("stored");
    assert_eq!(again, Inserted { accepted: 0, duplicate: 10, without_fix: 0, replaced: 0 });
    let count = async || store.camera(&camera).await.expect("known").samples;
    assert_eq!(count().await, SampleCount { all: 10, without_fix: 10 });

    // In one batch, whatever the order of its rows.
    let mixed =
        vec![without_fix(20, "a"), sample(20, "a").into(), sample(3, "a").into(), sample(4, "b").into()];
    let inserted = store.insert_samples(&camera, mixed, Durability::Synced).await.expect("stored");
    assert_eq!(inserted, Inserted { accepted: 3, duplicate: 1, without_fix: 0, replaced: 0 });
    assert_eq!(count().await, SampleCount { all: 12, without_fix: 9 });
    assert_eq!(with_fix(&store, &camera).await, [sample(3, "a"), sample(4, "b"), sample(20, "a")]);
    let late = store.insert_samples(&camera, vec![without_fix(3, "a")], Durability::Synced).await;
    assert_eq!(late.expect("stored"), Inserted { accepted: 0, duplicate: 1, without_fix: 0, replaced: 0 });

    let all = store.samples(&camera, &SampleFilter::default(), None, 100).await.expect("read");
    let fixes: Vec<bool> = all.iter().take(6).map(|sample| sample.fix.is_some()).collect();
    assert_eq!((all.len(), fixes), (12, vec![false, false, false, true, false, true]));
    let filter = SampleFilter { has_fix: Some(false), until: Some(at(5)), ..SampleFilter::default() };
    assert_eq!(store.delete_samples(&camera, &filter, at(9)).await.expect("deleted"), 4);
    assert_eq!(count().await, SampleCount { all: 8, without_fix: 5 });
    let rest = SampleFilter { until: Some(at(100)), ..SampleFilter::default() };
    assert_eq!(store.delete_samples(&camera, &rest, at(9)).await.expect("deleted"), 8);
    assert_eq!(count().await, SampleCount::default());
    assert_eq!(store.maintain().await.expect("works").samples, 0);
}

#[tokio::test]
async fn samples_of_before_an_instant_are_deleted_and_counted_no_more() {
    const DAY: i64 = 86_400;
    let timed = |second| Sample { time: at(second), ..sample(0, "a") };
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    // A Thursday of 2093 begins a week; the first samples are older than any partition.
    let week = 6_420 * 7 * DAY - at(0).as_second();
    assert_eq!(store.retain_samples(None, at(week)).await.expect("works"), 0);
    store.insert_camera(&NewCamera::named(id("other")), at(0)).await.expect("new");
    let late = [week - 1, week, week + 3 * DAY, week + 7 * DAY, week + 8 * DAY, week + 60 * DAY];
    for camera in [&camera, &id("other")] {
        let rows = (0..12_000).chain(late).map(|second| timed(second).into());
        let boxes = [1, week + 1, week + 7 * DAY + 1];
        let boxes = boxes.map(|second| StoredSample { time: at(second), ..without_fix(0, "b") });
        let inserted = store.insert_samples(camera, rows.chain(boxes).collect(), Durability::Synced).await;
        assert_eq!(inserted.expect("stored").accepted, 12_009);
    }
    let stored = async || {
        let samples = store.samples(&camera, &SampleFilter::default(), None, 100).await.expect("read");
        let times: Vec<_> =
            samples.iter().map(|sample| sample.time.as_second() - at(week).as_second()).collect();
        (
            times,
            store.camera(&camera).await.expect("known").samples,
            store.maintain().await.expect("works").samples,
        )
    };
    let deleted = store.retain_samples(Some(at(week)), at(week + 9 * DAY)).await.expect("works");
    assert_eq!(deleted, 2 * 12_002);
    let kept = vec![0, 1, 3 * DAY, 7 * DAY, 7 * DAY + 1, 8 * DAY, 60 * DAY];
    assert_eq!(stored().await, (kept, SampleCount { all: 7, without_fix: 2 }, 14));
    let deleted = store.retain_samples(Some(at(week + 7 * DAY)), at(week + 9 * DAY)).await.expect("works");
    assert_eq!(deleted, 2 * 3);
    let kept = vec![7 * DAY, 7 * DAY + 1, 8 * DAY, 60 * DAY];
    assert_eq!(stored().await, (kept, SampleCount { all: 4, without_fix: 1 }, 8));
    assert_eq!(store.retain_samples(Some(at(week + 7 * DAY)), at(week + 9 * DAY)).await.expect("works"), 0);
    // Late samples go with the next call.
    let late = store.insert_samples(&camera, vec![timed(week + 2)], Durability::Synced).await;
    assert_eq!(late.expect("stored").accepted, 1);
    assert_eq!(store.retain_samples(Some(at(week + 7 * DAY)), at(week + 9 * DAY)).await.expect("works"), 1);
    assert_eq!(stored().await.2, 8);
    // So do samples that were stored weeks before they were expected.
    let deleted = store.retain_samples(Some(at(week + 14 * DAY)), at(week + 45 * DAY)).await.expect("works");
    assert_eq!((deleted, stored().await.0), (2 * 3, vec![60 * DAY]));
    let deleted = store.retain_samples(Some(at(week + 63 * DAY)), at(week + 65 * DAY)).await.expect("works");
    assert_eq!((deleted, stored().await.2), (2, 0));
}

#[tokio::test]
async fn boxes_without_a_fix_are_thinned_evenly_and_alike_each_time() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let targets = ["a", "b", "c", "d", "e"];
    let boxes: Vec<StoredSample> =
        (0..400).flat_map(|second| targets.map(|target| without_fix(second, target))).collect();
    store.insert_samples(&camera, boxes.clone(), Durability::Synced).await.expect("stored");
    store.insert_samples(&camera, vec![sample(500, "a")], Durability::Synced).await.expect("stored");
    let thinned = async |most| {
        let filter = SampleFilter { until: Some(at(400)), ..SampleFilter::default() };
        store.thinned_detections(&camera, &filter, most).await.expect("read")
    };
    let expected: Vec<Detection> = boxes.into_iter().map(Detection::from).collect();
    assert_eq!(thinned(2_000).await, expected, "not more than asked for: all of them");
    let few = thinned(200).await;
    assert_eq!((few.len(), &few), (200, &thinned(200).await));
    for target_id in targets {
        let own: Vec<i64> = few
            .iter()
            .filter(|detection| detection.target_id.as_str() == target_id)
            .map(|detection| detection.time.as_second() - at(0).as_second())
            .collect();
        // One of every ten rows, whose places do not repeat with the five targets.
        assert!((25..=55).contains(&own.len()), "{target_id} {own:?}");
        assert!(own.windows(2).all(|pair| pair[1] - pair[0] < 100), "{target_id} {own:?}");
    }
    assert!(few.windows(10).all(|ten| (ten[9].time.duration_since(ten[0].time).as_secs() - 18).abs() <= 4));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Pages of any size show exactly what a filter over a plain sorted list selects.
    #[test]
    fn pages_agree_with_a_sorted_list(
        keys in prop::collection::btree_map((0_i64..12, "[a-c]"), any::<bool>(), 0..30),
        from in prop::option::of(0_i64..12),
        until in prop::option::of(0_i64..12),
        only in prop::option::of("[a-c]"),
        has_fix in prop::option::of(any::<bool>()),
        limit in 1_u32..7,
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            let Fixture { store, camera, folder: _folder } = Fixture::new().await;
            let all: Vec<StoredSample> = keys
                .iter()
                .map(|((second, target), has_fix)| {
                    let sample = sample(*second, target);
                    StoredSample { fix: has_fix.then_some(sample.fix), ..sample.into() }
                })
                .collect();
            store.insert_samples(&camera, all.clone(), Durability::Synced).await.expect("stored");
            let filter = SampleFilter { from: from.map(at), until: until.map(at), target_id: only.as_deref().map(target), has_fix };
            let expected: Vec<StoredSample> = all
                .into_iter()
                .filter(|it| has_fix.is_none_or(|has_fix| it.fix.is_some() == has_fix))
                .filter(|it| from.is_none_or(|from| it.time >= at(from)))
                .filter(|it| until.is_none_or(|until| it.time < at(until)))
                .filter(|it| only.as_ref().is_none_or(|only| it.target_id.as_str() == only))
                .collect();
            let counted = store.count_samples(&camera, &filter).await.expect("counted");
            prop_assert_eq!(counted, expected.len() as u64);
            let mut seen: Vec<StoredSample> = Vec::new();
            loop {
                let after = seen.last().map(SampleKey::of);
                let page = store.samples(&camera, &filter, after, limit).await.expect("a page");
                if page.is_empty() {
                    break;
                }
                prop_assert!(page.len() <= limit as usize);
                seen.extend(page);
            }
            prop_assert_eq!(seen, expected);
            Ok(())
        })?;
    }
}
