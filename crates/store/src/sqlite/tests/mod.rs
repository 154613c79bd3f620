//! Tests of the store of a folder alone: its file and its one writing connection.

mod file;
mod writer;

use std::sync::Arc;

use tempfile::TempDir;

use super::Store as FileStore;
use crate::Store;
use crate::database::Backend;
use crate::tests::{Fixture, Home};

/// A store in a folder, whatever the cases of both backends run on.
async fn in_folder() -> (Fixture, Arc<TempDir>) {
    let folder = Arc::new(TempDir::new().expect("a folder"));
    (Fixture::at(Home::Folder(Arc::clone(&folder))).await, folder)
}

fn file_store(store: &Store) -> &FileStore {
    match &store.0.backend {
        Backend::Sqlite(store) => store,
        Backend::Postgres(_) => panic!("a store in a folder"),
    }
}
