//! Cameras with what is stored of them, for a look at all of them.

use std::collections::HashMap;

use super::Store;
use super::errors::failed;
use super::jobs::read_state;
use super::row_decoder::RowDecoder;
use crate::domain::{Camera, CameraId, JobState, Result, RunId};

/// What is stored of a camera besides its profile.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StoredActivity {
    /// Its samples.
    pub samples: u64,
    /// Its latest training run.
    pub latest_run: Option<(RunId, JobState)>,
}

impl Store {
    /// A page of cameras ordered by id, after an id, each with what is stored of it.
    ///
    /// # Errors
    /// Faults only.
    pub async fn camera_activities(
        &self,
        after: Option<&CameraId>,
        limit: u32,
    ) -> Result<Vec<(Camera, StoredActivity)>> {
        let cameras = self.cameras(after, limit).await?;
        let Some(last) = cameras.last() else { return Ok(Vec::new()) };
        // Ids of runs are UUIDs of version 7: the largest is the latest.
        let rows = sqlx::query(
            "SELECT cameras.id, coalesce(samples, 0), runs.id, runs.state FROM cameras \
             LEFT JOIN sample_counts ON sample_counts.camera_key = key \
             LEFT JOIN training_runs AS runs ON runs.id = \
                 (SELECT max(id) FROM training_runs WHERE training_runs.camera_key = key) \
             WHERE cameras.id > ? AND cameras.id <= ?",
        )
        .bind(after.map_or("", CameraId::as_str).to_owned())
        .bind(last.id().as_str().to_owned())
        .fetch_all(self.readers())
        .await
        .map_err(failed)?;
        let read = |row| {
            let mut fields = RowDecoder::new("cameras", row);
            let id = fields.parse(CameraId::new)?;
            let samples = fields.parse(|stored: i64| u64::try_from(stored))?;
            let run = fields.parse_optional(|run: &str| run.parse::<RunId>())?;
            let state = fields.parse_optional(read_state)?;
            Ok((id, StoredActivity { samples, latest_run: run.zip(state) }))
        };
        let mut activities: HashMap<_, _> = rows.iter().map(read).collect::<Result<_>>()?;
        let with_activity = |camera: Camera| {
            // A camera that was deleted since the first query has none.
            let activity = activities.remove(camera.id()).unwrap_or_default();
            (camera, activity)
        };
        Ok(cameras.into_iter().map(with_activity).collect())
    }
}
