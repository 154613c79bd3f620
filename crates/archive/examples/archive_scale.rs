//! Fills an archive with positions of a site, then queries one hour and one place: `archive_scale FOLDER POSITIONS`.
//!
//! A folder that has files is queried as it is. docs/explanation/performance.md has the figures.

use std::ops::ControlFlow;
use std::time::Instant;

use jiff::{SignedDuration, Timestamp};
use sightfix_archive::{Archive, BoundingArea, Location, Selection};
use sightfix_domain::domain::{ArchivedPosition, Motion, Result, SiteId, TargetClass, TrackScope, Velocity};
use sightfix_domain::geo::{PlaneCovariance, Position};

/// Positions of an hour: 39 targets at once, one position a second.
const PER_HOUR: u64 = 140_400;
const TRACK_SECONDS: u64 = 60;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, positions] = arguments.as_slice() else {
        eprintln!("archive_scale FOLDER POSITIONS");
        std::process::exit(2);
    };
    let hours = positions.parse::<u64>().unwrap_or(1_000_000).div_ceil(PER_HOUR);
    let runtime = tokio::runtime::Builder::new_multi_thread().build().expect("a runtime");
    let mut names = 0_u64..;
    let names = std::sync::Mutex::new(move || names.next().unwrap_or_default());
    let new_name = move || (names.lock().expect("no panic"))().to_string();
    let archive = Archive::open(&Location::Folder(folder.into()), runtime.handle().clone(), new_name)?;
    let site = TrackScope::Site(SiteId::new("plaza")?);
    if archive.scopes()?.is_empty() {
        let begun = Instant::now();
        (0..hours).try_for_each(|hour| archive.write(&site, rows_of(hour)))?;
        let seconds = begun.elapsed().as_secs_f64();
        println!("{} positions written in {seconds:.0} s", hours * PER_HOUR);
    }
    println!("{:.0} MB", archive.bytes(&site)? as f64 / 1e6);
    let from = start() + SignedDuration::from_hours(i64::try_from(hours / 2).unwrap_or_default());
    let to = from + SignedDuration::from_hours(1);
    let area = BoundingArea::new([8.0, 47.0, 8.000_5, 47.000_5])?;
    let hour_and_place =
        Selection { from: Some(from), until: Some(to), area: Some(area), ..Selection::default() };
    let whole_hour = Selection { area: None, ..hour_and_place.clone() };
    for (name, selection) in [("one hour, one place", hour_and_place), ("one hour", whole_hour)] {
        let mut found = 0;
        let begun = Instant::now();
        archive.scan(&site, &selection, None, |_| {
            found += 1;
            ControlFlow::Continue(())
        })?;
        println!("{name}: {found} positions in {:.0} ms", begun.elapsed().as_secs_f64() * 1e3);
    }
    Ok(())
}

/// 2026-01-01T00:00:00Z.
fn start() -> Timestamp {
    Timestamp::UNIX_EPOCH + SignedDuration::from_secs(1_767_225_600)
}

/// Targets that cross a square of about 200 m, each from another place.
fn rows_of(hour: u64) -> Vec<ArchivedPosition> {
    let row = |number: u64| {
        let (second, lane) = (number / 39, number % 39);
        let track = (hour * 3_600 + second) / TRACK_SECONDS * 39 + lane;
        let on_track = (second % TRACK_SECONDS) as f64;
        // Multiplicative hashing spreads the digits of the low bits.
        let random =
            |salt: u64| ((track + salt).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as f64 / (1 << 24) as f64;
        let velocity = Velocity { east_m_s: 2.0 * random(1) - 1.0, north_m_s: 2.0 * random(2) - 1.0 };
        let noise = |salt: u64| {
            1e-6 * ((number + salt).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as f64 / (1 << 24) as f64
        };
        let east_deg = 2e-3 * random(3) + 1.3e-5 * velocity.east_m_s * on_track + noise(1);
        let north_deg = 2e-3 * random(4) + 9e-6 * velocity.north_m_s * on_track + noise(2);
        let covariance = PlaneCovariance::isotropic(0.04 + 0.1 * random(5) + noise(3));
        ArchivedPosition {
            time: start()
                + SignedDuration::from_secs(i64::try_from(hour * 3_600 + second).unwrap_or_default()),
            track: format!("3f9a02c1-{track}"),
            target: None,
            class: TargetClass::new(if lane < 30 { "person" } else { "car" }).ok(),
            position: Position::new(8.0 + east_deg, 47.0 + north_deg).expect("valid"),
            covariance_m2: covariance,
            motion: Motion::of(velocity, covariance, 0.01),
            acceleration: None,
        }
    };
    (0..PER_HOUR).map(row).collect()
}
