//! A sink of files: tracks as GPX or KML in the folder of the setting `export_folder`.
//!
//! A file is written whole beside its place and renamed, so that a reader never finds half of one, and what is in it
//! counts as delivered when it is on the disk. A new file begins after `rotate_s`, or when the file is full; the
//! oldest are deleted.

use std::path::{Path, PathBuf};

use futures_util::future::BoxFuture;
use jiff::Timestamp;
use tokio::fs;
use tokio::io::AsyncWriteExt as _;

use crate::connect::credentials::PeerError;
use crate::connect::sink::{Outcomes, Sink};
use crate::domain::{ConnectionId, OutboxMessage};
use crate::exchange::{TrackFile, kinds};

/// Points of a file; some hundred kilobytes.
const MAX_POINTS: usize = 5_000;

/// Writes the files of one connection.
pub(super) struct FileSink {
    folder: PathBuf,
    settings: kinds::FileSink,
    /// Files that are kept.
    max_files: usize,
    current: Option<OpenFile>,
}

struct OpenFile {
    path: PathBuf,
    began_at: Timestamp,
    content: TrackFile,
}

impl FileSink {
    /// Makes the connection's folder.
    pub(super) async fn open(
        export_folder: &Path,
        connection: &ConnectionId,
        settings: kinds::FileSink,
        max_files: usize,
    ) -> Result<Self, PeerError> {
        let folder = export_folder.join(connection.as_str());
        fs::create_dir_all(&folder)
            .await
            .map_err(|error| PeerError(format!("the folder {} cannot be made: {error}", folder.display())))?;
        Ok(Self { folder, settings, max_files, current: None })
    }

    /// True if a message of this time still goes to the current file.
    fn takes(&self, time: Timestamp) -> bool {
        self.current.as_ref().is_some_and(|file| {
            let age_s = time.duration_since(file.began_at).as_secs_f64();
            file.content.points() < MAX_POINTS && age_s < self.settings.rotate_s
        })
    }

    /// Begins a file; the oldest are deleted to make room for it.
    async fn begin(&mut self, time: Timestamp) -> Result<(), PeerError> {
        let files = self.files().await?;
        let surplus = (files.len() + 1).saturating_sub(self.max_files);
        for path in files.iter().take(surplus) {
            fs::remove_file(path).await?;
        }
        let path = self.next_path(&files, time);
        let content = TrackFile::new(self.settings.format);
        self.current = Some(OpenFile { path, began_at: time, content });
        Ok(())
    }

    /// A name by the time, with a number above those of the files of the same second. Names sort as their files began.
    fn next_path(&self, files: &[PathBuf], time: Timestamp) -> PathBuf {
        let name = time.strftime("%Y%m%dT%H%M%SZ").to_string();
        let number_of = |path: &PathBuf| {
            let rest = path.file_stem()?.to_str()?.strip_prefix(name.as_str())?;
            Some(rest.strip_prefix('_').map_or(1, |number| number.parse().unwrap_or(1)))
        };
        let ending = self.settings.format.ending();
        self.folder.join(match files.iter().filter_map(number_of).max() {
            None => format!("{name}.{ending}"),
            Some(last) => format!("{name}_{:03}.{ending}", last + 1_u32),
        })
    }

    /// The files that are kept, the oldest first.
    async fn files(&self) -> Result<Vec<PathBuf>, PeerError> {
        let mut files = Vec::new();
        let mut entries = fs::read_dir(&self.folder).await?;
        while let Some(entry) = entries.next_entry().await? {
            let path = entry.path();
            if path.extension().is_some_and(|ending| ending == self.settings.format.ending()) {
                files.push(path);
            }
        }
        files.sort();
        Ok(files)
    }

    /// Writes the current file to the disk.
    async fn write(&self) -> Result<(), PeerError> {
        let Some(file) = &self.current else { return Ok(()) };
        let unfinished = file.path.with_extension("part");
        let mut out = fs::File::create(&unfinished).await?;
        out.write_all(file.content.to_text().as_bytes()).await?;
        out.sync_all().await?;
        fs::rename(&unfinished, &file.path).await?;
        // The name is on the disk with its folder.
        fs::File::open(&self.folder).await?.sync_all().await?;
        Ok(())
    }
}

impl Sink for FileSink {
    fn deliver<'a>(
        &'a mut self,
        messages: &'a [OutboxMessage],
        outcomes: &'a mut Outcomes,
    ) -> BoxFuture<'a, Result<(), PeerError>> {
        Box::pin(async move {
            let mut pushed = Outcomes::new();
            for message in messages {
                if !self.takes(message.created_at) {
                    self.write().await?;
                    outcomes.append(&mut pushed);
                    self.begin(message.created_at).await?;
                }
                if let Some(file) = &mut self.current {
                    pushed.push((message.number, file.content.push(&message.payload)));
                }
            }
            self.write().await?;
            outcomes.append(&mut pushed);
            Ok(())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exchange::TrackFileFormat;

    fn message(number: i64, second: i64) -> OutboxMessage {
        let created_at = Timestamp::from_second(1_700_000_000 + second).expect("a time");
        let position = serde_json::json!({
            "camera_id": "gate", "target_id": "van", "time": created_at,
            "position": {"longitude_deg": 103.98678, "latitude_deg": 30.628},
        });
        OutboxMessage {
            number,
            message_id: number.to_string(),
            subject: String::new(),
            payload: position.to_string().into_bytes(),
            created_at,
        }
    }

    fn points_by_file(folder: &Path) -> Vec<(String, usize)> {
        let files = std::fs::read_dir(folder).expect("a folder").map(|entry| {
            let path = entry.expect("an entry").path();
            let points = std::fs::read_to_string(&path).expect("a file").matches("<trkpt ").count();
            (path.file_name().expect("a name").to_string_lossy().into_owned(), points)
        });
        let mut files: Vec<_> = files.collect();
        files.sort();
        files
    }

    #[tokio::test]
    async fn a_new_file_begins_in_time_or_when_one_is_full_and_the_oldest_are_deleted() {
        let exports = tempfile::tempdir().expect("a folder");
        let id = ConnectionId::new("gpx").expect("a slug");
        let settings = kinds::FileSink { format: TrackFileFormat::Gpx, rotate_s: 60.0 };
        let mut sink = FileSink::open(exports.path(), &id, settings, 2).await.expect("opens");
        let folder = exports.path().join("gpx");
        let mut outcomes = Outcomes::new();
        let messages = [message(1, 0), message(2, 59), message(3, 60)];
        sink.deliver(&messages, &mut outcomes).await.expect("written");
        assert_eq!(outcomes, [1, 2, 3].map(|number| (number, Ok(()))));
        let [first, second] = ["20231114T221320Z.gpx", "20231114T221420Z.gpx"].map(str::to_owned);
        assert_eq!(points_by_file(&folder), [(first, 2), (second.clone(), 1)]);

        // A sink that is opened again begins a file of its own, and the oldest gives way.
        let mut sink = FileSink::open(exports.path(), &id, settings, 2).await.expect("opens");
        let full: Vec<OutboxMessage> = (0..MAX_POINTS as i64).map(|number| message(number, 60)).collect();
        sink.deliver(&full, &mut Outcomes::new()).await.expect("written");
        let again = "20231114T221420Z_002.gpx".to_owned();
        assert_eq!(points_by_file(&folder), [(second, 1), (again.clone(), MAX_POINTS)]);
        sink.deliver(&[message(9, 60)], &mut Outcomes::new()).await.expect("written");
        assert_eq!(
            points_by_file(&folder),
            [(again, MAX_POINTS), ("20231114T221420Z_003.gpx".to_owned(), 1)]
        );

        let mut outcomes = Outcomes::new();
        let unreadable = OutboxMessage { payload: b"{}".to_vec(), ..message(10, 60) };
        sink.deliver(&[unreadable, message(11, 60)], &mut outcomes).await.expect("written");
        assert!(outcomes[0].1.as_ref().is_err_and(|reason| reason.contains("is no position")));
        assert_eq!(outcomes[1], (11, Ok(())));
    }
}
