use super::*;
use crate::domain::{Score, SigmaM, TargetClass};
use crate::store::{Inserted, SampleFilter, SampleKey};
use proptest::prelude::*;

#[tokio::test]
async fn samples_come_back_bit_for_bit_and_in_order() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let mut full = sample(3, "b");
    full.fix.sigma_m = Some(SigmaM::new(0.1 + 0.2).expect("a sigma"));
    full.class = Some(TargetClass::new("ö").expect("a class"));
    full.score = Some(Score::new(1.0 / 3.0).expect("a score"));
    full.truth = Some(Position::new(-179.999_999_9, -1e-300).expect("a place"));
    let ordered =
        vec![sample(-5, "z"), sample(1, "B"), sample(1, "a"), sample(1, "é"), full, sample(40, "a")];
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
    assert_eq!(first.expect("stored"), Inserted { accepted: 2, duplicate: 1 });
    let again = store.insert_samples(&camera, vec![twin.clone(), sample(2, "a")], Durability::Synced).await;
    assert_eq!(again.expect("stored"), Inserted { accepted: 1, duplicate: 1 });
    let elsewhere = store.insert_samples(&other, vec![twin], Durability::Synced).await;
    assert_eq!(elsewhere.expect("stored"), Inserted { accepted: 1, duplicate: 0 });
    assert_eq!(
        store.insert_samples(&camera, Vec::new(), Durability::Synced).await.expect("empty"),
        Inserted::default()
    );
    let kept = store.samples(&camera, &SampleFilter::default(), None, 9).await.expect("read");
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
        assert_eq!(inserted, Inserted { accepted: (count - stored) as u64, duplicate: stored as u64 });
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
    assert_eq!(page, [sample(3, "a"), sample(4, "a")]);
}

#[tokio::test]
async fn deleting_takes_what_the_filter_selects() {
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let all = (0..10).flat_map(|second| [sample(second, "a"), sample(second, "b")]).collect();
    store.insert_samples(&camera, all, Durability::Synced).await.expect("stored");
    let filter = SampleFilter { from: Some(at(3)), until: Some(at(5)), target_id: Some(target("b")) };
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

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Pages of any size show exactly what a filter over a plain sorted list selects.
    #[test]
    fn pages_agree_with_a_sorted_list(
        keys in prop::collection::btree_set((0_i64..12, "[a-c]"), 0..30),
        from in prop::option::of(0_i64..12),
        until in prop::option::of(0_i64..12),
        only in prop::option::of("[a-c]"),
        limit in 1_u32..7,
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            let Fixture { store, camera, folder: _folder } = Fixture::new().await;
            let all: Vec<Sample> = keys.iter().map(|(second, target)| sample(*second, target)).collect();
            store.insert_samples(&camera, all.clone(), Durability::Synced).await.expect("stored");
            let filter = SampleFilter { from: from.map(at), until: until.map(at), target_id: only.as_deref().map(target) };
            let expected: Vec<Sample> = all
                .into_iter()
                .filter(|it| from.is_none_or(|from| it.time >= at(from)))
                .filter(|it| until.is_none_or(|until| it.time < at(until)))
                .filter(|it| only.as_ref().is_none_or(|only| it.target_id.as_str() == only))
                .collect();
            let counted = store.count_samples(&camera, &filter).await.expect("counted");
            prop_assert_eq!(counted, expected.len() as u64);
            let mut seen: Vec<Sample> = Vec::new();
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
