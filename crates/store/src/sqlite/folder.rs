//! The data folder: created if missing, private to its owner, its entries flushed to the disk.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

use crate::domain::{Error, Result};
use crate::folder_fault::{FolderFault, FolderFaultKind};

/// Name of the database in its folder.
pub(super) const DATABASE: &str = "sightfix.db";

/// Files that SQLite keeps beside the database, with the permissions of the database itself.
const COMPANIONS: [&str; 2] = ["sightfix.db-wal", "sightfix.db-shm"];

/// Creates the folder (mode 0700) and an empty database file (mode 0600) if they are missing, takes
/// the permissions of group and others from existing ones, and flushes the folder's entries.
/// Returns the path of the database.
///
/// # Errors
/// A fault that names the folder.
pub(super) async fn prepare(folder: &Path) -> Result<PathBuf> {
    let folder = folder.to_owned();
    tokio::task::spawn_blocking(move || prepare_blocking(&folder)).await.map_err(Error::fault)?
}

/// Creates the folder (mode 0700) if it is missing, and takes the permissions of group and others from an
/// existing one.
///
/// # Errors
/// A fault that names the folder.
pub(super) async fn prepare_folder(folder: &Path) -> Result<()> {
    let folder = folder.to_owned();
    tokio::task::spawn_blocking(move || prepare_folder_blocking(&folder)).await.map_err(Error::fault)?
}

fn prepare_folder_blocking(folder: &Path) -> Result<()> {
    let existed = folder.is_dir();
    create_folder(folder).map_err(|error| {
        let message = format!("cannot make the folder {}: {error}", folder.display());
        FolderFault::error(FolderFaultKind::NotWritable, message)
    })?;
    if existed {
        restrict_to_owner(folder);
    }
    Ok(())
}

fn prepare_blocking(folder: &Path) -> Result<PathBuf> {
    prepare_folder_blocking(folder)?;
    let database = folder.join(DATABASE);
    match create_file(&database) {
        Ok(_) => {
            // Without it a power cut may take the file away although its content was flushed.
            let flushed = flush_entries(folder).and_then(|()| flush_entries(parent_of(folder)));
            flushed.map_err(|error| {
                Error::fault(format!("cannot flush the folder {}: {error}", folder.display()))
            })?;
        }
        // Opening the file will show its other faults.
        Err(_) => {
            restrict_to_owner(&database);
            COMPANIONS.iter().for_each(|name| restrict_to_owner(&folder.join(name)));
        }
    }
    Ok(database)
}

/// The folder that contains a path.
pub(super) fn parent_of(folder: &Path) -> &Path {
    folder.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."))
}

fn create_folder(folder: &Path) -> io::Result<()> {
    let mut builder = DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(folder)
}

/// SQLite gives its companion files the permissions of this one.
fn create_file(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.open(path)
}

/// Flushes the entries of a folder, so that a file that was created or renamed survives a power cut.
#[cfg(unix)]
pub(super) fn flush_entries(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

#[cfg(not(unix))]
pub(super) fn flush_entries(_folder: &Path) -> io::Result<()> {
    Ok(())
}

/// Takes the permissions of group and others away, if the path is this user's own. A folder with the
/// sticky bit (such as /tmp) is shared on purpose and stays as it is.
#[cfg(unix)]
fn restrict_to_owner(path: &Path) {
    use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};

    const GROUP_AND_OTHERS: u32 = 0o077;
    const STICKY: u32 = 0o1000;
    let Ok(metadata) = fs::metadata(path) else { return };
    let mode = metadata.permissions().mode();
    if mode & GROUP_AND_OTHERS == 0 {
        return;
    }
    let path_shown = path.display();
    if metadata.uid() != rustix::process::geteuid().as_raw() || mode & STICKY != 0 {
        tracing::warn!(path = %path_shown, mode = %format!("{:04o}", mode & 0o7777), "other users may access it");
        return;
    }
    match fs::set_permissions(path, fs::Permissions::from_mode(mode & !GROUP_AND_OTHERS)) {
        Ok(()) => {
            tracing::info!(path = %path_shown, "other users could access it; it is now restricted to its owner");
        }
        Err(error) => tracing::warn!(path = %path_shown, %error, "other users may access it"),
    }
}

#[cfg(not(unix))]
fn restrict_to_owner(_path: &Path) {}
