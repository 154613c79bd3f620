//! Tests through the public interface, on a folder.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU64, Ordering};

use jiff::Timestamp;
use tempfile::TempDir;
use tokio::runtime::Runtime;

use super::*;
use crate::domain::{
    Acceleration, ArchivedPosition, CameraId, HistoryKey, Motion, TargetClass, TargetId, TrackScope, Velocity,
};
use crate::geo::{PlaneCovariance, Position};

/// 2026-11-24T07:00:00Z.
const HOUR_S: i64 = 1_795_503_600;

struct Folder {
    archive: Archive,
    folder: TempDir,
    _runtime: Runtime,
}

impl Folder {
    fn new() -> Self {
        let folder = TempDir::new().expect("a folder");
        let runtime = Runtime::new().expect("a runtime");
        let location = Location::Folder(folder.path().into());
        let archive = open(&location, &runtime);
        Self { archive, folder, _runtime: runtime }
    }

    fn files(&self) -> Vec<std::path::PathBuf> {
        files_below(self.folder.path())
    }
}

fn open(location: &Location, runtime: &Runtime) -> Archive {
    let count = AtomicU64::new(0);
    let name = move || count.fetch_add(1, Ordering::Relaxed).to_string();
    Archive::open(location, runtime.handle().clone(), name).expect("an archive")
}

fn files_below(folder: &std::path::Path) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    entries.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}

fn gate() -> TrackScope {
    TrackScope::Camera(CameraId::new("gate").expect("a slug"))
}

fn time(second: i64) -> Timestamp {
    Timestamp::from_second(HOUR_S + second).expect("in range")
}

/// A row at a second; walkers go east, a metre a second.
fn row(target: &str, second: i64) -> ArchivedPosition {
    let velocity = Velocity { east_m_s: 1.25, north_m_s: 0.5 };
    ArchivedPosition {
        time: time(second),
        track: format!("{target}-1"),
        target: Some(TargetId::new(target).expect("a name")),
        class: Some(TargetClass::new(if target == "van" { "car" } else { "person" }).expect("a name")),
        position: Position::new(8.0 + 1e-5 * second as f64, 47.0).expect("valid"),
        covariance_m2: PlaneCovariance { east_m2: 0.25, north_m2: 0.125, east_north_m2: 0.0625 },
        motion: Motion::of(velocity, PlaneCovariance::isotropic(0.25), 0.01),
        acceleration: Some(Acceleration { east_m_s2: 0.5, ..Acceleration::default() }),
    }
}

fn rows(target: &str, seconds: std::ops::Range<i64>) -> Vec<ArchivedPosition> {
    seconds.map(|second| row(target, second)).collect()
}

fn found(archive: &Archive, selection: &Selection) -> Vec<(String, i64)> {
    let mut found = Vec::new();
    let each = |row: ArchivedPosition| {
        found.push((row.track, row.time.as_second() - HOUR_S));
        ControlFlow::Continue(())
    };
    archive.scan(&gate(), selection, None, each).expect("readable");
    found
}

#[test]
fn rows_are_read_as_they_were_written() {
    let Folder { archive, .. } = &Folder::new();
    let standing = Motion::of(Velocity::default(), PlaneCovariance::isotropic(1.0), 0.75);
    let unknown =
        ArchivedPosition { target: None, class: None, motion: standing, acceleration: None, ..row("x", 1) };
    let written = vec![row("ann", 0), unknown];
    archive.write(&gate(), written.clone()).expect("written");
    let mut read = Vec::new();
    let each = |row| {
        read.push(row);
        ControlFlow::Continue(())
    };
    archive.scan(&gate(), &Selection::default(), None, each).expect("readable");
    let close = |a: f64, b: f64| (a - b).abs() <= 1e-6 * b.abs();
    for (read, written) in read.iter().zip(&written) {
        let exact = |row: &ArchivedPosition| {
            (
                row.time,
                row.track.clone(),
                row.target.clone(),
                row.class.clone(),
                row.position,
                row.acceleration,
            )
        };
        assert_eq!(exact(read), exact(written));
        assert_eq!(read.covariance_m2, written.covariance_m2);
        assert!(close(read.motion.speed_mps, written.motion.speed_mps), "{read:?}");
        let courses = read.motion.course.zip(written.motion.course);
        assert!(courses.is_none_or(|(a, b)| close(a.interval_deg[1], b.interval_deg[1])), "{read:?}");
        assert_eq!(read.motion.course.is_some(), written.motion.course.is_some());
    }
    assert_eq!(read.len(), 2);
}

#[test]
fn a_scan_is_in_order_over_files_and_hours_and_continues_after_a_key() {
    let Folder { archive, .. } = &Folder::new();
    archive.write(&gate(), rows("bob", 3_000..4_000)).expect("written");
    archive.write(&gate(), rows("ann", 3_000..4_000)).expect("written");
    let all = found(archive, &Selection::default());
    let expected: Vec<_> =
        (3_000..4_000).flat_map(|at| [("ann-1".to_owned(), at), ("bob-1".to_owned(), at)]).collect();
    assert_eq!(all, expected);
    let mut pages = Vec::new();
    let mut after = None;
    loop {
        let (before, from) = (pages.len(), after.clone());
        let each = |row: ArchivedPosition| {
            after = Some(HistoryKey { time: row.time, track: row.track.clone() });
            pages.push((row.track, row.time.as_second() - HOUR_S));
            if pages.len() == before + 7 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        archive.scan(&gate(), &Selection::default(), from, each).expect("readable");
        if pages.len() == before {
            break;
        }
    }
    assert_eq!(pages, expected);
}

#[test]
fn conditions_select_rows() {
    let Folder { archive, .. } = &Folder::new();
    for target in ["ann", "bob", "van"] {
        archive.write(&gate(), rows(target, 0..100)).expect("written");
    }
    let count = |selection: Selection| found(archive, &selection).len();
    let target = |name| TargetId::new(name).expect("a name");
    assert_eq!(count(Selection { from: Some(time(10)), until: Some(time(20)), ..Selection::default() }), 30);
    assert_eq!(count(Selection { class: TargetClass::new("car").ok(), ..Selection::default() }), 100);
    assert_eq!(count(Selection { targets: vec![target("ann"), target("bob")], ..Selection::default() }), 200);
    assert_eq!(count(Selection { track: Some("bob-1".to_owned()), ..Selection::default() }), 100);
    let area = BoundingArea::new([8.000_095, 46.9, 8.000_205, 47.1]).expect("an area");
    assert_eq!(count(Selection { area: Some(area), ..Selection::default() }), 33);
    let elsewhere = BoundingArea::new([179.0, 46.9, -179.0, 47.1]).expect("across the antimeridian");
    assert_eq!(count(Selection { area: Some(elsewhere), ..Selection::default() }), 0);
    let around = BoundingArea::new([7.0, 46.9, -179.0, 47.1]).expect("an area");
    assert_eq!(count(Selection { area: Some(around), ..Selection::default() }), 300);
}

#[test]
fn a_target_is_found_in_the_rows_of_its_track_from_before_it_was_known() {
    let Folder { archive, .. } = &Folder::new();
    let unknown =
        |target| rows(target, 0..50).into_iter().map(|row| ArchivedPosition { target: None, ..row });
    archive.write(&gate(), unknown("ann").chain(unknown("van")).collect()).expect("written");
    archive.write(&gate(), [rows("ann", 50..60), rows("bob", 0..60)].concat()).expect("written");
    let of_target =
        Selection { targets: vec![TargetId::new("ann").expect("a name")], ..Selection::default() };
    assert_eq!(found(archive, &of_target).len(), 10);
    let tracks_of_targets = archive.tracks(&gate(), &of_target).expect("readable");
    let of_tracks = Selection { tracks_of_targets, ..of_target };
    let before = Selection { until: Some(time(50)), ..of_tracks.clone() };
    let expected: Vec<_> = (0..50).map(|second| ("ann-1".to_owned(), second)).collect();
    assert_eq!(found(archive, &before), expected);
    assert_eq!(archive.delete(&gate(), &of_tracks).expect("deleted"), 60);
    assert_eq!(found(archive, &Selection::default()).len(), 50 + 60);
}

#[test]
fn a_deletion_leaves_no_row_in_any_file() {
    let it = Folder::new();
    let archive = &it.archive;
    for target in ["ann", "bob", "van"] {
        archive.write(&gate(), rows(target, 3_500..3_700)).expect("written");
    }
    let selection =
        Selection { targets: vec![TargetId::new("bob").expect("a name")], ..Selection::default() };
    assert_eq!(archive.delete(&gate(), &selection).expect("deleted"), 200);
    assert_eq!(archive.delete(&gate(), &selection).expect("nothing left"), 0);
    assert_eq!(found(archive, &Selection::default()).len(), 400);
    for file in it.files() {
        let content = std::fs::read(file).expect("readable");
        assert!(!content.windows(3).any(|bytes| bytes == b"bob"), "the dictionary would have the name");
    }
    assert_eq!(archive.delete(&gate(), &Selection::default()).expect("all"), 400);
    assert!(it.files().is_empty() && archive.scopes().expect("readable").is_empty());
}

#[test]
fn the_same_row_in_two_files_counts_once() {
    let Folder { archive, .. } = &Folder::new();
    for _ in 0..2 {
        archive.write(&gate(), rows("ann", 0..50)).expect("written");
    }
    assert_eq!(found(archive, &Selection::default()).len(), 50);
    archive.compact(&gate(), time(3_600)).expect("merged");
    assert_eq!(found(archive, &Selection::default()).len(), 50);
}

#[test]
fn small_files_are_merged() {
    let it = Folder::new();
    for second in 0..100 {
        it.archive.write(&gate(), rows("ann", second..second + 1)).expect("written");
    }
    assert!(it.files().len() < 16, "{} files", it.files().len());
    it.archive.compact(&gate(), time(3_599)).expect("the hour has not ended");
    assert!(it.files().len() > 1);
    it.archive.compact(&gate(), time(3_600)).expect("merged");
    assert_eq!(it.files().len(), 1);
    assert_eq!(found(&it.archive, &Selection::default()).len(), 100);
}

#[test]
fn retention_is_by_age_and_by_bytes() {
    let it = Folder::new();
    for hour in 0..5 {
        it.archive.write(&gate(), rows("ann", 3_600 * hour..3_600 * hour + 50)).expect("written");
    }
    it.archive.retain(&gate(), Some(time(2 * 3_600 + 10)), u64::MAX).expect("retained");
    let hours = || found(&it.archive, &Selection::default()).iter().map(|(_, at)| at / 3_600).min();
    assert_eq!(hours(), Some(2), "the hour of the instant is kept whole");
    let bytes = it.archive.bytes(&gate()).expect("readable");
    it.archive.retain(&gate(), None, bytes - 1).expect("retained");
    assert_eq!(hours(), Some(3), "the oldest hour goes first");
    it.archive.retain(&gate(), None, 0).expect("retained");
    assert_eq!(hours(), None);
}

#[test]
fn what_was_not_finished_is_removed_when_the_archive_is_opened() {
    let it = Folder::new();
    it.archive.write(&gate(), rows("ann", 0..10)).expect("written");
    let unfinished = it.files()[0].with_file_name("9.parquet#1");
    std::fs::write(&unfinished, b"PAR1 and no more").expect("written");
    assert_eq!(found(&it.archive, &Selection::default()).len(), 10);
    let runtime = Runtime::new().expect("a runtime");
    let archive = open(&Location::Folder(it.folder.path().into()), &runtime);
    assert!(!unfinished.exists());
    assert_eq!(found(&archive, &Selection::default()).len(), 10);
}

#[test]
fn a_damaged_file_is_a_fault() {
    let it = Folder::new();
    it.archive.write(&gate(), rows("ann", 0..10)).expect("written");
    let file = it.files()[0].clone();
    let whole = std::fs::read(&file).expect("readable");
    for length in [0, 7, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&file, &whole[..length]).expect("written");
        let read = it.archive.scan(&gate(), &Selection::default(), None, |_| ControlFlow::Continue(()));
        assert!(read.is_err(), "{length} of {} bytes", whole.len());
    }
}

#[test]
fn a_place_that_this_program_cannot_use_is_refused() {
    let runtime = Runtime::new().expect("a runtime");
    let refused = Archive::open(&Location::new("azure://x/y"), runtime.handle().clone(), String::new);
    let message = refused.err().expect("refused").to_string();
    assert!(message.contains("archive"), "{message}");
}
