//! Tests of what runs at the same time, under many orders of its steps, drawn from a seed; for the tests of other crates.
//!
//! `shuttle` runs the tasks of a scenario on one thread and decides at each `await` which of them goes on; its random
//! numbers decide about faults. The code under test is that of the product: the locks and queues of `tokio::sync` work on
//! any executor. A schedule that fails is printed, and `shuttle::replay` repeats it. A scenario is also run with an error
//! put back on purpose, which must be found, for otherwise it shows nothing.
//!
//! `SCHEDULES` is the number per scenario, `SCHEDULE_SEED` the seed.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::str::FromStr;

use shuttle::rand::Rng as _;
use shuttle::scheduler::RandomScheduler;
use shuttle::{Config, FailurePersistence, Runner};

pub use shuttle::future::{block_on, spawn, yield_now};

/// Schedules of a scenario.
const SCHEDULES: usize = 1_000;
/// Stack of a task, bytes: an unoptimised statement of SQL takes more than the default of 32 kB.
const STACK: usize = 1 << 20;

/// Runs a scenario under many schedules.
///
/// # Panics
/// The scenario panics under one of them.
pub fn explore(scenario: impl Fn() + Send + Sync + 'static) {
    let mut config = Config::new();
    config.stack_size = STACK;
    config.failure_persistence = FailurePersistence::Print;
    let scheduler =
        RandomScheduler::new_from_seed(setting("SCHEDULE_SEED", 1), setting("SCHEDULES", SCHEDULES));
    Runner::new(scheduler, config).run(scenario);
}

/// Runs a scenario with an error put back on purpose.
///
/// # Panics
/// No schedule finds the error by an assertion that says `check`.
pub fn explore_planted(check: &str, scenario: impl Fn() + Send + Sync + 'static) {
    let Err(failure) = catch_unwind(AssertUnwindSafe(|| explore(scenario))) else {
        panic!("no schedule finds the error that was put back");
    };
    let text = failure.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| failure.downcast_ref::<&str>().copied()).unwrap_or_default();
    assert!(text.contains(check), "found by another check: {text}");
}

fn setting<T: FromStr>(name: &str, default: T) -> T {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

/// A random number below another one.
#[must_use]
pub fn below(limit: usize) -> usize {
    shuttle::rand::thread_rng().gen_range(0..limit)
}

/// Lets others go on a few times.
pub async fn pause() {
    for _ in 0..below(4) {
        yield_now().await;
    }
}
