//! The task that smooths finished tracks and writes them, and keeps the archive within its bounds.

use std::collections::HashMap;
use std::sync::Weak;
use std::time::Duration;

use jiff::SignedDuration;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use super::path::FinishedTrack;
use super::queries::History;
use super::queue::{Work, on_archive};
use crate::app::{App, Parts};
use crate::archive::Archive;
use crate::domain::{ArchivedPosition, ErrorKind, HistorySettings, Result, TrackScope};

/// How often tracks are looked for that have not been measured for too long, and finished ones written.
const WRITE_EVERY: Duration = Duration::from_secs(1);
/// Tracks that are written together.
const BATCH: usize = 256;
/// Rounds of writing between two looks for what is too old or too much, and for small files to merge.
const RETAIN_EVERY: u32 = 600;

/// Time that writing gets when the server ends.
const FINISH_TIME: Duration = Duration::from_secs(10);

/// Writes finished tracks until the application ends.
pub(in crate::app) async fn write_finished_tracks(mut waiting: mpsc::Receiver<Work>, parts: Weak<Parts>) {
    let app = || Some(App::of_program(parts.upgrade()?, "history"));
    let mut tick = tokio::time::interval(WRITE_EVERY);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut tracks, mut round) = (Vec::new(), 0);
    loop {
        let work = tokio::select! {
            _ = tick.tick() => None,
            // What could not be written waits, and so does the queue.
            work = waiting.recv(), if tracks.len() < BATCH => match work {
                Some(work) => Some(work),
                None => return,
            }
        };
        let Some(app) = app() else { return };
        match work {
            Some(Work::Write(track)) => {
                tracks.push(*track);
                continue;
            }
            Some(Work::Flush(done)) => {
                app.history().write_tracks(&mut tracks).await;
                // Whoever asked may have gone.
                let _ = done.send(());
            }
            None => {
                app.history().finish_silent_tracks();
                app.history().write_tracks(&mut tracks).await;
                round = (round + 1) % RETAIN_EVERY;
                if round == 1 {
                    app.history().retain().await;
                }
            }
        }
    }
}

impl History<'_> {
    /// Ends the tracks of cameras with a history that have not been measured for too long.
    fn finish_silent_tracks(&self) {
        let now = self.clock.monotonic();
        for camera in self.registry.all().values().filter(|camera| camera.history.is_some()) {
            camera.live.finish_silent_tracks(now);
        }
    }

    /// Writes what is followed still, for the server ends. Streams must have ended.
    pub(in crate::app) async fn finish(&self) {
        let finish = async {
            for camera in self.registry.all().values().filter(|camera| camera.history.is_some()) {
                self.archived.queue().send_all(camera.live.finish_all_tracks()).await;
            }
            self.archived.flush().await;
        };
        if tokio::time::timeout(FINISH_TIME, finish).await.is_err() {
            tracing::error!("tracks that ended with the server could not be written to the archive in time");
        }
    }

    /// Writes the tracks and forgets them. What cannot be written stays, to be tried again.
    async fn write_tracks(&self, tracks: &mut Vec<FinishedTrack>) {
        let Some(archive) = self.archived.archive.get().cloned() else {
            tracks.clear();
            return;
        };
        if tracks.is_empty() {
            return;
        }
        let finished = std::mem::take(tracks);
        let written = tokio::task::spawn_blocking(move || {
            let written = write(&archive, &finished);
            (finished, written)
        });
        match written.await {
            Ok((_, Ok(()))) => {}
            Ok((finished, Err(error))) => {
                tracing::error!(%error, "finished tracks could not be written to the archive; it is tried again");
                *tracks = finished;
            }
            Err(error) => tracing::error!(%error, "finished tracks could not be smoothed"),
        }
    }

    /// Deletes what is too old or too much, and merges small files. The history of a camera or a site that was deleted
    /// goes with it.
    async fn retain(&self) {
        if let Err(error) = self.try_retain().await {
            tracing::error!(%error, "the archive could not be kept within its bounds; it is tried again");
        }
    }

    async fn try_retain(&self) -> Result<()> {
        let Some(archive) = self.archived.archive.get().cloned() else { return Ok(()) };
        let now = self.store.time(self.clock.now()).await?;
        let scopes = on_archive(&archive, Archive::scopes).await?;
        for scope in scopes {
            let settings = self.settings(&scope).await?;
            on_archive(&archive, move |archive| match settings {
                Kept::Deleted => archive.delete(&scope, &crate::archive::Selection::default()).map(drop),
                Kept::Unbounded => archive.compact(&scope, now),
                Kept::Within(settings) => {
                    let age = SignedDuration::from_hours(24 * i64::from(settings.keep_days()));
                    archive.retain(&scope, now.checked_sub(age).ok(), settings.max_bytes())?;
                    archive.compact(&scope, now)
                }
            })
            .await?;
        }
        Ok(())
    }

    async fn settings(&self, scope: &TrackScope) -> Result<Kept> {
        let settings = match scope {
            TrackScope::Camera(id) => self.store.camera(id).await.map(|camera| camera.profile.history),
            TrackScope::Site(id) => self.store.site(id).await.map(|site| site.profile.history),
        };
        match settings {
            Ok(settings) => Ok(settings.map_or(Kept::Unbounded, Kept::Within)),
            Err(error) if matches!(error.kind(), ErrorKind::CameraNotFound | ErrorKind::SiteNotFound) => {
                Ok(Kept::Deleted)
            }
            Err(error) => Err(error),
        }
    }
}

/// How long the history of a scope is kept.
enum Kept {
    Within(HistorySettings),
    /// Until somebody deletes it: no more tracks are kept.
    Unbounded,
    /// Not at all: the camera or site was deleted.
    Deleted,
}

fn write(archive: &Archive, tracks: &[FinishedTrack]) -> Result<()> {
    let mut by_scope: HashMap<&TrackScope, Vec<ArchivedPosition>> = HashMap::new();
    for track in tracks {
        by_scope.entry(&track.scope).or_default().extend(track.rows());
    }
    by_scope.into_iter().try_for_each(|(scope, rows)| archive.write(scope, rows))
}
