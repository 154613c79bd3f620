//! The data folder: its permissions, its disk, its lock.

use std::path::Path;

use super::{Check, in_units};
use crate::config::Config;
use crate::store;

/// Space that a server needs for a day of ordinary work.
const AMPLE_BYTES: u64 = 1 << 30;
/// Below it, imports are refused soon.
const SCARCE_BYTES: u64 = 64 << 20;

pub(super) fn writable(config: &Config) -> Check {
    const NAME: &str = "folder";
    let folder = config.data.display();
    if !config.data.exists() {
        return Check::warning(
            NAME,
            format!("there is no {folder}"),
            "`sightfix serve` makes it; check --data",
        );
    }
    match tempfile::tempfile_in(&config.data) {
        Ok(_) => Check::ok(NAME, format!("{folder} can be written")),
        Err(error) => Check::failed(
            NAME,
            format!("{folder} cannot be written: {error}"),
            "give the folder to the user of the server (chown), or mount its disk for writing",
        ),
    }
}

pub(super) fn space(config: &Config) -> Check {
    const NAME: &str = "space";
    let remedy = "free space on the disk, or delete samples (docs/howto/storage.md, Full disk)";
    // Where the folder will be made.
    let folder = if config.data.exists() { config.data.as_path() } else { Path::new(".") };
    match store::disk_available_bytes(folder) {
        Err(error) => Check::warning(NAME, format!("the disk does not tell its free space: {error}"), remedy),
        Ok(None) => Check::ok(NAME, "the system does not tell its free space"),
        Ok(Some(bytes)) => {
            let finding = format!("{} free", in_units(bytes));
            match bytes {
                bytes if bytes < SCARCE_BYTES => Check::failed(NAME, finding, remedy),
                bytes if bytes < AMPLE_BYTES.max(config.limits.reserve_bytes) => {
                    Check::warning(NAME, finding, remedy)
                }
                _ => Check::ok(NAME, finding),
            }
        }
    }
}

pub(super) fn lock(config: &Config) -> Check {
    const NAME: &str = "lock";
    match store::server_of(&config.data) {
        Ok(None) => Check::ok(NAME, "no server uses the folder"),
        Ok(Some(holder)) => Check::ok(NAME, format!("in use by {holder}")),
        Err(error) => Check::warning(
            NAME,
            format!("the lock cannot be read: {error}"),
            "use a file system with locks, so that two servers cannot use one folder",
        ),
    }
}
