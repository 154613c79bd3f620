//! Cameras with their latest training runs, for a look at all of them.

use std::collections::HashMap;

use crate::database::Database;
use crate::domain::{Camera, CameraId, JobState, Result, RunId};
use crate::jobs::{job_state, read_state};
use crate::query::query;
use crate::row_decoder::RowDecoder;

impl Database {
    pub(crate) async fn cameras_with_latest_run(
        &self,
        after: Option<&CameraId>,
        limit: u32,
    ) -> Result<Vec<(Camera, Option<(RunId, JobState)>)>> {
        let cameras = self.cameras(None, after, limit).await?;
        let Some(last) = cameras.last() else { return Ok(Vec::new()) };
        let mut reader = self.reader().await?;
        // Ids of runs are UUIDs of version 7: the largest is the latest.
        let rows = query(concat!(
            "SELECT cameras.id, runs.id, ",
            job_state!("runs"),
            " FROM cameras JOIN training_runs AS runs ON runs.id = \
                 (SELECT max(id) FROM training_runs WHERE training_runs.camera_key = key) \
                 WHERE cameras.id > $1 AND cameras.id <= $2"
        ))
        .bind(after.map_or("", CameraId::as_str).to_owned())
        .bind(last.id().as_str().to_owned())
        .fetch_all(&mut reader)
        .await?;
        let read = |row| {
            let mut fields = RowDecoder::new("training_runs", row);
            let camera = fields.parse(CameraId::new)?;
            let run = fields.parse(|run: &str| run.parse::<RunId>())?;
            Ok((camera, (run, fields.parse(read_state)?)))
        };
        let mut runs: HashMap<_, _> = rows.iter().map(read).collect::<Result<_>>()?;
        let with_run = |camera: Camera| {
            let run = runs.remove(camera.id());
            (camera, run)
        };
        Ok(cameras.into_iter().map(with_run).collect())
    }
}
