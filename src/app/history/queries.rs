//! Queries and deletions of the history.

use std::ops::ControlFlow;

use tokio::sync::mpsc;

use super::queue::{ArchivedHistory, on_archive};
use crate::app::active_cameras::ActiveCameras;
use crate::app::places::place_settings;
use crate::app::registry::Registry;
use crate::app::{App, Page, page_of};
use crate::archive::{Archive, BoundingArea, Selection};
use crate::clock::Clock;
use crate::domain::{
    ArchivedPosition, Error, ErrorKind, HistoryKey, PlaceId, ReceiverId, Result, TargetClass, TargetId,
    TrackScope,
};
use crate::geo::Outline;
use crate::store::Store;
use jiff::{SignedDuration, Timestamp};

/// Rows that are handed over at once.
const BATCH: usize = 1_024;
/// Batches that wait for a slow reader.
const WAITING: usize = 4;
/// Cameras of a site that are read at a time.
const CAMERAS: u32 = 1_000;
/// The time after the end of a query in which the target of a track that it has no target of is looked for.
const IDENTIFIED_WITHIN: SignedDuration = SignedDuration::from_hours(1);

/// Which positions of a camera or a site are asked for.
#[derive(Debug, Clone, Default)]
pub struct HistorySelection {
    /// Not before this instant.
    pub from: Option<Timestamp>,
    /// Before this instant.
    pub until: Option<Timestamp>,
    /// Within this area.
    pub area: Option<BoundingArea>,
    /// In this place, an area or a disc of the same camera or site.
    pub place: Option<PlaceId>,
    /// Of this class.
    pub class: Option<TargetClass>,
    /// Of this target.
    pub target: Option<TargetId>,
    /// Of the carrier of this receiver.
    pub receiver: Option<ReceiverId>,
    /// Of this track.
    pub track: Option<String>,
}

/// Positions as they are read, in batches; they end early with an error.
pub struct HistoryRows {
    batches: mpsc::Receiver<Result<Vec<ArchivedPosition>>>,
}

impl HistoryRows {
    /// The next positions, in order of time and track; `None` after the last.
    ///
    /// # Errors
    /// A fault of the archive.
    pub async fn next(&mut self) -> Result<Option<Vec<ArchivedPosition>>> {
        self.batches.recv().await.transpose()
    }
}

/// The use cases of the history.
#[derive(Clone, Copy)]
pub struct History<'a> {
    pub(super) archived: &'a ArchivedHistory,
    pub(super) store: &'a Store,
    pub(super) registry: &'a Registry,
    cameras: ActiveCameras<'a>,
    pub(super) clock: &'a Clock,
}

impl App {
    /// The use cases of the history.
    #[must_use]
    pub fn history(&self) -> History<'_> {
        History {
            archived: &self.archived_history,
            store: &self.store,
            registry: &self.registry,
            cameras: self.active_cameras(),
            clock: &self.clock,
        }
    }
}

impl History<'_> {
    /// A page of positions in order of time and track.
    ///
    /// # Errors
    /// `CameraNotFound`, `SiteNotFound`; `PermissionDenied` for a camera that the key is not for; `InvalidArgument`.
    pub async fn page(
        &self,
        scope: TrackScope,
        selection: HistorySelection,
        after: Option<HistoryKey>,
        limit: u32,
    ) -> Result<Page<ArchivedPosition, HistoryKey>> {
        let mut selection = self.selected(&scope, selection).await?;
        let rows = on_archive(self.archive()?, move |archive| {
            add_tracks(archive, &scope, &mut selection, Some(IDENTIFIED_WITHIN))?;
            let mut rows = Vec::new();
            archive.scan(&scope, &selection, after, |row| {
                rows.push(row);
                if rows.len() > limit as usize { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            })?;
            Ok(rows)
        })
        .await?;
        Ok(page_of(rows, limit, |row| HistoryKey::from(row)))
    }

    /// All positions in order of time and track, read as they are taken.
    ///
    /// # Errors
    /// As [`History::page`].
    pub async fn rows(&self, scope: TrackScope, selection: HistorySelection) -> Result<HistoryRows> {
        let mut selection = self.selected(&scope, selection).await?;
        let archive = self.archive()?.clone();
        let (sender, batches) = mpsc::channel(WAITING);
        tokio::task::spawn_blocking(move || send_rows(&archive, &scope, &mut selection, &sender));
        Ok(HistoryRows { batches })
    }

    /// Deletes positions in every file, and returns their number.
    ///
    /// # Errors
    /// As [`History::page`].
    pub async fn delete(&self, scope: TrackScope, selection: HistorySelection) -> Result<u64> {
        let mut selection = self.selected(&scope, selection).await?;
        self.archived.flush().await;
        on_archive(self.archive()?, move |archive| {
            add_tracks(archive, &scope, &mut selection, None)?;
            archive.delete(&scope, &selection)
        })
        .await
    }

    fn archive(&self) -> Result<&Archive> {
        let closed = || Error::refused(ErrorKind::Overloaded, "this process has not opened the archive");
        self.archived.archive.get().ok_or_else(closed)
    }

    /// The selection of rows of a scope that exists and that the caller may read.
    async fn selected(&self, scope: &TrackScope, selection: HistorySelection) -> Result<Selection> {
        let HistorySelection { from, until, area, place, class, target, receiver, track } = selection;
        if from.zip(until).is_some_and(|(from, until)| from >= until) {
            return Err(Error::invalid("until", "must be after from"));
        }
        if target.is_some() && receiver.is_some() {
            return Err(Error::invalid("receiver_id", "is not possible beside target_id"));
        }
        if area.is_some() && place.is_some() {
            return Err(Error::invalid("place", "is not possible beside an area"));
        }
        match scope {
            TrackScope::Camera(id) => drop(self.cameras.get(id).await?),
            TrackScope::Site(id) => drop(self.store.site(id).await?),
        }
        let targets = match receiver {
            Some(receiver) => self.carriers(scope, &receiver).await?,
            None => target.into_iter().collect(),
        };
        let outline = match place {
            Some(place) => Some(self.outline(scope, &place).await?),
            None => None,
        };
        let bounds = outline.as_ref().map(|outline| {
            let [[west, south], [east, north]] = outline.bounds_deg();
            BoundingArea::new([west, south, east, north])
        });
        let area = bounds.transpose()?.or(area);
        Ok(Selection { from, until, area, outline, class, targets, track, ..Selection::default() })
    }

    /// The area of a place of the scope.
    async fn outline(&self, scope: &TrackScope, id: &PlaceId) -> Result<Outline> {
        let place = self.store.place(id).await?;
        if place.profile.scope != *scope {
            return Err(Error::invalid("place", "is of another camera or site"));
        }
        let outline = place_settings(&place)?.outline()?;
        outline.ok_or_else(|| {
            Error::invalid("place", "is a line, which nothing is inside of; name an area or a disc")
        })
    }

    /// The targets that carry a receiver: those that the camera, or cameras of the site, declare, and the one of the
    /// receiver's own name, which it has where no camera declares it.
    async fn carriers(&self, scope: &TrackScope, receiver: &ReceiverId) -> Result<Vec<TargetId>> {
        let mut carriers = vec![TargetId::new(receiver.as_str()).map_err(|error| error.at("receiver_id"))?];
        match scope {
            TrackScope::Camera(id) => {
                let camera = self.cameras.get(id).await?;
                carriers.extend(camera.receivers.get(receiver).map(|own| own.target_id.clone()));
            }
            TrackScope::Site(id) => {
                let mut page = self.store.cameras(Some(id), None, CAMERAS).await?;
                while let Some(last) = page.last().map(|camera| camera.id().clone()) {
                    let declared = page.iter().filter_map(|camera| camera.profile.receivers.get(receiver));
                    carriers.extend(declared.map(|own| own.target_id.clone()));
                    page = self.store.cameras(Some(id), Some(&last), CAMERAS).await?;
                }
            }
        }
        Ok(carriers)
    }
}

/// Adds the tracks whose target was known only after their first rows were written, within a time of them where one is
/// stated. A camera's tracks have a target from the beginning.
fn add_tracks(
    archive: &Archive,
    scope: &TrackScope,
    selection: &mut Selection,
    within: Option<SignedDuration>,
) -> Result<()> {
    if !selection.targets.is_empty() && scope.site().is_some() {
        let until = within.and_then(|within| selection.until?.checked_add(within).ok());
        let (from, targets) = (selection.from, selection.targets.clone());
        let later = Selection { from, until, targets, ..Selection::default() };
        selection.tracks_of_targets = archive.tracks(scope, &later)?;
    }
    Ok(())
}

fn send_rows(
    archive: &Archive,
    scope: &TrackScope,
    selection: &mut Selection,
    sender: &mpsc::Sender<Result<Vec<ArchivedPosition>>>,
) {
    let mut batch = Vec::with_capacity(BATCH);
    let found = add_tracks(archive, scope, selection, Some(IDENTIFIED_WITHIN));
    let mut send_row = |row| {
        batch.push(row);
        if batch.len() < BATCH {
            return ControlFlow::Continue(());
        }
        let full = std::mem::replace(&mut batch, Vec::with_capacity(BATCH));
        // The reader has gone.
        if sender.blocking_send(Ok(full)).is_err() {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    };
    let scanned = found.and_then(|()| archive.scan(scope, selection, None, &mut send_row));
    // The reader may have gone.
    let _ = sender.blocking_send(scanned.map(|()| batch));
}
