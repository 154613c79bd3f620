//! What the store promises to callers that run at the same time, under thousands of orders of their steps.

mod group_commit;
mod leases;
mod outbox;

use std::sync::Arc;

use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};

use super::{Fixture, Home};

/// Where the database library runs. A call of the store is one step of a schedule, as its transaction is.
fn runtime() -> Runtime {
    Builder::new_multi_thread().worker_threads(1).enable_all().build().expect("a runtime")
}

/// A store in a data folder, whatever the others are tried on: its clock is handed in.
fn fixture(runtime: &Runtime) -> Fixture {
    let folder = Home::Folder(Arc::new(TempDir::new().expect("a folder")));
    runtime.block_on(Fixture::at(folder))
}
