//! The archive as a whole: files of positions under the folders of scope, day and hour.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind as IoErrorKind;
use std::ops::{ControlFlow, Range};
use std::path::{Path as FilePath, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures_util::TryStreamExt as _;
use jiff::Timestamp;
use object_store::aws::AmazonS3Builder;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::prefix::PrefixStore;
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt as _, RetryConfig};
use tokio::runtime::Handle;

use crate::domain::{ArchivedPosition, CameraId, Error, HistoryKey, Result, SiteId, TrackScope};
use crate::file::{FileWriter, Footer};
use crate::hour::Hour;
use crate::scan::{Fetch, FileRows, Merged};
use crate::selection::Selection;

/// Rows of the largest file.
const FILE_ROWS: u64 = 1 << 20;
/// A file below this size is merged with others of its hour, bytes.
const SMALL_BYTES: u64 = 16 << 20;
/// Small files of one hour that are merged while more may come.
const SMALL_FILES: usize = 16;
/// How often an hour is read again whose files were replaced meanwhile.
const ATTEMPTS: u32 = 8;
/// Time in which a request to a bucket is repeated. Finished tracks wait for the next attempt to write them.
const RETRY_TIME: Duration = Duration::from_secs(5);

/// Where an archive is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Location {
    /// In a folder of this machine.
    Folder(PathBuf),
    /// In a store that speaks the protocol of S3: a bucket and a prefix in it, as `s3://bucket/prefix`. Its address and keys
    /// are those of the variables `AWS_*` of the environment.
    Bucket(String),
}

impl Location {
    /// A folder, or a URL.
    #[must_use]
    pub fn new(text: &str) -> Self {
        if text.contains("://") { Self::Bucket(text.to_owned()) } else { Self::Folder(text.into()) }
    }
}

/// Archived positions. Cheap to clone.
#[derive(Clone)]
pub struct Archive(Arc<Parts>);

struct Parts {
    store: Box<dyn ObjectStore>,
    runtime: Handle,
    /// A name that no other file has.
    new_name: Box<dyn Fn() -> String + Send + Sync>,
    /// Held while files are written or deleted.
    changing: Mutex<()>,
}

/// The files of one hour.
type Files = Vec<ObjectMeta>;

impl Archive {
    /// Opens an archive. `runtime` does its input and output; `new_name` returns another name at every call.
    ///
    /// # Errors
    /// A folder that cannot be created, or a URL of a store that this program cannot use.
    pub fn open(
        location: &Location,
        runtime: Handle,
        new_name: impl Fn() -> String + Send + Sync + 'static,
    ) -> Result<Self> {
        let store = match location {
            Location::Folder(folder) => open_folder(folder)?,
            Location::Bucket(url) => open_bucket(url)?,
        };
        Ok(Self(Arc::new(Parts { store, runtime, new_name: Box::new(new_name), changing: Mutex::new(()) })))
    }

    /// Writes rows of a scope, flushed to the disk when this returns.
    ///
    /// # Errors
    /// A fault of the store.
    pub fn write(&self, scope: &TrackScope, rows: Vec<ArchivedPosition>) -> Result<()> {
        let _changing = self.change();
        let mut hours: BTreeMap<Hour, Vec<ArchivedPosition>> = BTreeMap::new();
        for row in rows {
            hours.entry(Hour::of(row.time)).or_default().push(row);
        }
        for (hour, mut rows) in hours {
            rows.sort_by(|a, b| a.key().cmp(&b.key()));
            self.write_files(scope, hour, rows.into_iter().map(Ok))?;
            let small = small_of(self.list_hour(scope, hour)?);
            if small.len() >= SMALL_FILES {
                self.rewrite(scope, hour, small, |_| true)?;
            }
        }
        Ok(())
    }

    /// Hands the rows of a selection to `each`, in order of time and track, until it breaks; those after a key alone
    /// where one is stated.
    ///
    /// # Errors
    /// A fault of the store, or a damaged file.
    pub fn scan(
        &self,
        scope: &TrackScope,
        selection: &Selection,
        after: Option<HistoryKey>,
        mut each: impl FnMut(ArchivedPosition) -> ControlFlow<()>,
    ) -> Result<()> {
        let mut after = after;
        let mut selection = selection.clone();
        selection.from = selection.from.max(after.as_ref().map(|after| after.time));
        for day in self.days(scope, &selection)? {
            for (hour, mut files) in self.list_hours(&day, &selection)? {
                let mut attempt = 0;
                loop {
                    match self.scan_files(&files, &selection, &mut after, &mut each) {
                        Ok(ControlFlow::Continue(())) => break,
                        Ok(ControlFlow::Break(())) => return Ok(()),
                        Err(error) if is_missing(&error) && attempt < ATTEMPTS => attempt += 1,
                        Err(error) => return Err(error),
                    }
                    files = self.list_hour(scope, hour)?;
                }
            }
        }
        Ok(())
    }

    /// The tracks that have rows of a selection.
    ///
    /// # Errors
    /// As [`Archive::scan`].
    pub fn tracks(&self, scope: &TrackScope, selection: &Selection) -> Result<BTreeSet<String>> {
        let mut tracks = BTreeSet::new();
        self.scan(scope, selection, None, |row| {
            tracks.insert(row.track);
            ControlFlow::Continue(())
        })?;
        Ok(tracks)
    }

    /// Deletes the rows of a selection in every file, and returns their number. Files without any other row vanish.
    ///
    /// # Errors
    /// A fault of the store; rows that were not deleted yet are still there.
    pub fn delete(&self, scope: &TrackScope, selection: &Selection) -> Result<u64> {
        let _changing = self.change();
        let mut deleted = 0;
        for day in self.days(scope, selection)? {
            for (hour, files) in self.list_hours(&day, selection)? {
                let mut selected = 0;
                let mut count = |_| {
                    selected += 1;
                    ControlFlow::Continue(())
                };
                let _all = self.scan_files(&files, selection, &mut None, &mut count)?;
                if selected > 0 {
                    self.rewrite(scope, hour, files, |row| !selection.contains(row))?;
                    deleted += selected;
                }
            }
        }
        Ok(deleted)
    }

    /// Deletes the hours of a scope that ended before `since`, then the oldest ones until it has at most `max_bytes`.
    /// Returns the bytes that were deleted.
    ///
    /// # Errors
    /// A fault of the store.
    pub fn retain(&self, scope: &TrackScope, since: Option<Timestamp>, max_bytes: u64) -> Result<u64> {
        let _changing = self.change();
        let since = since.map(Hour::of);
        let hours = self.list_hours(&Path::from(folder_of(scope)), &Selection::default())?;
        let size = |files: &Files| files.iter().map(|file| file.size).sum::<u64>();
        let mut bytes: u64 = hours.values().map(size).sum();
        let mut deleted = 0;
        for (hour, files) in hours {
            if since.is_none_or(|since| hour >= since) && bytes <= max_bytes {
                break;
            }
            bytes -= size(&files);
            deleted += size(&files);
            self.remove(&files)?;
        }
        Ok(deleted)
    }

    /// Merges the small files of every hour of a scope that ended before an instant.
    ///
    /// # Errors
    /// A fault of the store.
    pub fn compact(&self, scope: &TrackScope, before: Timestamp) -> Result<()> {
        let _changing = self.change();
        let selection = Selection { until: Some(before), ..Selection::default() };
        for (hour, files) in self.list_hours(&Path::from(folder_of(scope)), &selection)? {
            let small = small_of(files);
            if hour.next() <= Hour::of(before) && small.len() > 1 {
                self.rewrite(scope, hour, small, |_| true)?;
            }
        }
        Ok(())
    }

    /// All scopes that have files.
    ///
    /// # Errors
    /// A fault of the store.
    pub fn scopes(&self) -> Result<Vec<TrackScope>> {
        let mut scopes = Vec::new();
        for kind in ["cameras", "sites"] {
            let folders = self.folders(&Path::from(kind))?;
            scopes.extend(folders.iter().filter_map(|folder| scope_of(kind, folder.filename()?)));
        }
        Ok(scopes)
    }

    /// Size of a scope's files, bytes.
    ///
    /// # Errors
    /// A fault of the store.
    pub fn bytes(&self, scope: &TrackScope) -> Result<u64> {
        Ok(self.list(&Path::from(folder_of(scope)))?.iter().map(|file| file.size).sum())
    }

    fn change(&self) -> MutexGuard<'_, ()> {
        self.0.changing.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn scan_files(
        &self,
        files: &Files,
        selection: &Selection,
        after: &mut Option<HistoryKey>,
        each: &mut impl FnMut(ArchivedPosition) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>> {
        let mut rows = self.merged(files, selection)?;
        while let Some(row) = rows.next_row()? {
            let key = HistoryKey::from(&row);
            if after.as_ref().is_some_and(|after| key <= *after) {
                continue;
            }
            *after = Some(key);
            if each(row).is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    fn merged<'a>(&'a self, files: &Files, selection: &'a Selection) -> Result<Merged<'a, impl Fetch + 'a>> {
        let mut opened = Vec::with_capacity(files.len());
        for file in files {
            let footer = Footer::read(file.size, |range| self.fetch(&file.location, range))?;
            opened.push(FileRows::new(file.location.clone(), footer, selection));
        }
        Merged::new(opened, selection, |path, range| self.fetch(path, range))
    }

    /// Replaces files of an hour by those of the rows that are kept. The new ones are written first.
    fn rewrite(
        &self,
        scope: &TrackScope,
        hour: Hour,
        files: Files,
        keep: impl Fn(&ArchivedPosition) -> bool,
    ) -> Result<()> {
        let all = Selection::default();
        let mut rows = self.merged(&files, &all)?;
        let kept = std::iter::from_fn(|| rows.next_row().transpose());
        self.write_files(scope, hour, kept.filter(|row| row.as_ref().map_or(true, &keep)))?;
        self.remove(&files)
    }

    /// Writes rows of one hour that are in order.
    fn write_files(
        &self,
        scope: &TrackScope,
        hour: Hour,
        rows: impl Iterator<Item = Result<ArchivedPosition>>,
    ) -> Result<()> {
        let mut rows = rows.peekable();
        while rows.peek().is_some() {
            let mut writer = FileWriter::new(scope.clone())?;
            let mut content = Vec::new();
            for row in rows.by_ref().take(FILE_ROWS as usize) {
                content.extend(writer.push(row?)?);
            }
            content.extend(writer.finish()?);
            let path = format!("{}/{}/{}.parquet", folder_of(scope), hour.folder()?, (self.0.new_name)());
            self.wait(self.0.store.put(&Path::from(path), content.into()))?;
        }
        Ok(())
    }

    fn remove(&self, files: &Files) -> Result<()> {
        files.iter().try_for_each(|file| self.wait(self.0.store.delete(&file.location)))
    }

    /// The folders of days of a scope that may have rows of a selection, in order.
    fn days(&self, scope: &TrackScope, selection: &Selection) -> Result<Vec<Path>> {
        let mut days = self.folders(&Path::from(folder_of(scope)))?;
        days.retain(|day| {
            let hour = |hour| day.filename().and_then(|day| Hour::of_folder(day, hour));
            let (first, last) = (hour("00"), hour("23"));
            last.is_some_and(|last| selection.from.is_none_or(|from| Hour::of(from) <= last))
                && first.is_some_and(|first| selection.until.is_none_or(|until| Hour::of(until) >= first))
        });
        days.sort();
        Ok(days)
    }

    fn list_hour(&self, scope: &TrackScope, hour: Hour) -> Result<Files> {
        self.list(&Path::from(format!("{}/{}", folder_of(scope), hour.folder()?)))
    }

    /// The files below a folder by hour, as far as they may have rows of a selection.
    fn list_hours(&self, folder: &Path, selection: &Selection) -> Result<BTreeMap<Hour, Files>> {
        let mut hours: BTreeMap<Hour, Files> = BTreeMap::new();
        for file in self.list(folder)? {
            let Some(hour) = hour_of(&file.location) else { continue };
            let is_wanted = selection.from.is_none_or(|from| hour >= Hour::of(from))
                && selection.until.is_none_or(|until| hour <= Hour::of(until));
            if is_wanted {
                hours.entry(hour).or_default().push(file);
            }
        }
        Ok(hours)
    }

    fn list(&self, folder: &Path) -> Result<Files> {
        self.wait(self.0.store.list(Some(folder)).try_collect())
    }

    fn folders(&self, folder: &Path) -> Result<Vec<Path>> {
        Ok(self.wait(self.0.store.list_with_delimiter(Some(folder)))?.common_prefixes)
    }

    fn fetch(&self, path: &Path, range: Range<u64>) -> Result<Bytes> {
        self.wait(self.0.store.get_range(path, range))
    }

    fn wait<T>(&self, work: impl Future<Output = object_store::Result<T>>) -> Result<T> {
        self.0.runtime.block_on(work).map_err(Error::fault)
    }
}

fn small_of(files: Files) -> Files {
    files.into_iter().filter(|file| file.size < SMALL_BYTES).collect()
}

/// The hour of a file by its path, `<kind>/<id>/<day>/<hour>/<name>`.
fn hour_of(path: &Path) -> Option<Hour> {
    let parts: Vec<_> = path.parts().collect();
    let [_, _, day, hour, _] = parts.as_slice() else { return None };
    Hour::of_folder(day.as_ref(), hour.as_ref())
}

/// True if a file was not found: another task has replaced it.
fn is_missing(error: &Error) -> bool {
    let Error::Fault(fault) = error else { return false };
    matches!(fault.cause(), Some(object_store::Error::NotFound { .. }))
}

fn open_folder(folder: &FilePath) -> Result<Box<dyn ObjectStore>> {
    std::fs::create_dir_all(folder).map_err(Error::fault)?;
    remove_unfinished(folder).map_err(Error::fault)?;
    let store = LocalFileSystem::new_with_prefix(folder).map_err(Error::fault)?;
    Ok(Box::new(store.with_fsync(true).with_automatic_cleanup(true)))
}

fn open_bucket(url: &str) -> Result<Box<dyn ObjectStore>> {
    let refused = |error: &dyn std::fmt::Display| {
        let message = format!(
            "cannot be used as the place of the archive: {error}; name a folder, or s3://bucket/prefix with AWS_ACCESS_KEY_ID \
             and the other variables of the environment"
        );
        Error::invalid("archive", message)
    };
    let parsed = url::Url::parse(url).map_err(|error| refused(&error))?;
    if parsed.scheme() != "s3" {
        return Err(refused(&format!("{}:// is not supported", parsed.scheme())));
    }
    let prefix = Path::from_url_path(parsed.path()).map_err(|error| refused(&error))?;
    // The client takes the provider of the process; another one that is there already serves as well.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let retry = RetryConfig { max_retries: 3, retry_timeout: RETRY_TIME, ..RetryConfig::default() };
    let bucket = AmazonS3Builder::from_env().with_url(url).with_retry(retry).build();
    Ok(Box::new(PrefixStore::new(bucket.map_err(|error| refused(&error))?, prefix)))
}

/// Removes what was being written when the process was killed.
fn remove_unfinished(folder: &FilePath) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            remove_unfinished(&path)?;
        } else if path.extension().is_none_or(|ending| ending != "parquet") {
            match std::fs::remove_file(&path) {
                Err(error) if error.kind() != IoErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
    }
    Ok(())
}

/// The folder of a scope's files.
fn folder_of(scope: &TrackScope) -> String {
    match scope {
        TrackScope::Camera(id) => format!("cameras/{id}"),
        TrackScope::Site(id) => format!("sites/{id}"),
    }
}

/// The scope of a folder; `None` for one that is not of the archive.
fn scope_of(kind: &str, id: &str) -> Option<TrackScope> {
    match kind {
        "cameras" => CameraId::new(id).ok().map(TrackScope::Camera),
        "sites" => SiteId::new(id).ok().map(TrackScope::Site),
        _ => None,
    }
}
