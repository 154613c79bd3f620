//! The machine: its clock and its limits.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::{Check, in_units};
use crate::clock::Clock;
use crate::config::Config;
use crate::store::DatabaseReport;
use crate::telemetry::process;

/// Time over which the two clocks are compared.
const COMPARED_TIME: Duration = Duration::from_millis(250);
/// Difference between them that is no step: an adjustment by NTP is at most 0.05 %.
const LARGEST_DIFFERENCE: SignedDuration = SignedDuration::from_millis(20);
/// 2026-01-01, before the first release: a clock that shows less was never set.
const EARLIEST: Timestamp = Timestamp::constant(1_767_225_600, 0);
/// How far samples may be ahead of a clock that is right.
const LARGEST_LEAD: SignedDuration = SignedDuration::from_secs(60);
/// Files that a server needs besides its connections.
const OTHER_FILES: u64 = 256;
/// Memory of a server without requests.
const BASE_BYTES: u64 = 128 << 20;

pub(super) async fn clock(clock: &Clock, report: Option<&DatabaseReport>) -> Check {
    const NAME: &str = "clock";
    let (wall, monotonic) = (clock.now(), clock.monotonic());
    tokio::time::sleep(COMPARED_TIME).await;
    let now = clock.now();
    let elapsed = SignedDuration::try_from(clock.monotonic().saturating_sub(monotonic)).unwrap_or_default();
    let stepped_by = (now.duration_since(wall) - elapsed).abs();
    let synchronise = "synchronise the clock (timedatectl set-ntp true)";
    if now < EARLIEST {
        return Check::failed(NAME, format!("it shows {now:.0} and was never set"), synchronise);
    }
    if stepped_by > LARGEST_DIFFERENCE {
        let finding = format!("it was stepped by {} ms while it was watched", stepped_by.as_millis());
        return Check::warning(NAME, finding, "let the clock be slewed, not stepped");
    }
    match report.and_then(|report| report.latest_sample_at) {
        Some(latest) if latest.duration_since(now) > LARGEST_LEAD => Check::warning(
            NAME,
            format!("it shows {now:.0}, and the latest sample is of {latest:.0}"),
            format!("{synchronise}; delete samples of the future, or give the receiver's clock_offset_s"),
        ),
        _ => Check::ok(NAME, format!("it shows {now:.0}; no sample is of the future")),
    }
}

pub(super) fn open_files(config: &Config) -> Check {
    const NAME: &str = "open files";
    let needed = config.limits.connections as u64 + OTHER_FILES;
    match process::open_files_limit() {
        None => Check::ok(NAME, "not limited"),
        Some(limit) if limit >= needed => Check::ok(NAME, format!("up to {limit}")),
        Some(limit) => Check::warning(
            NAME,
            format!("up to {limit}; limits.connections needs {needed}"),
            "raise it (`ulimit -n`, LimitNOFILE= in the unit), or lower limits.connections",
        ),
    }
}

pub(super) fn memory(config: &Config) -> Check {
    const NAME: &str = "memory";
    let limits = &config.limits;
    let needed = BASE_BYTES + (limits.request_memory_bytes + limits.spool_memory_bytes) as u64;
    match process::available_memory_bytes() {
        None => Check::ok(NAME, "the system does not tell"),
        Some(bytes) if bytes >= needed => Check::ok(NAME, format!("{} available", in_units(bytes))),
        Some(bytes) => Check::warning(
            NAME,
            format!("{} available; the limits allow requests to need {}", in_units(bytes), in_units(needed)),
            "lower limits.request_memory_bytes and limits.spool_memory_bytes, or give the server more",
        ),
    }
}
