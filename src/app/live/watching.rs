//! The watch on a camera: compares what its model says with what receivers say, and raises the alarm.

use std::sync::{Arc, Mutex};

use super::{CameraLive, lock};
use crate::app::App;
use crate::app::registry::Serving;
use crate::domain::{CameraId, CameraMoved, Error, ErrorKind, Observation, Result};
use crate::fusion::drift_detector::{DriftAlarm, DriftDetector, DriftDetectorSettings, ResidualSample};
use crate::fusion::track::TrackSettings;
use crate::fusion::two_step;
use crate::model::Regressor;

/// One camera's watch; begun anew with every model version.
#[derive(Default)]
pub(super) struct Watching(Mutex<Option<Watched>>);

struct Watched {
    model_version: u32,
    watch: DriftDetector,
    /// Raised, but not yet kept: keeping it has failed.
    unsaved: Option<DriftAlarm>,
}

impl Watching {
    /// Takes up a comparison of a model version; `Some` while there is an alarm to be kept.
    pub(super) fn compare(
        &self,
        (regressor, model_version): (&Regressor, u32),
        compared: &ResidualSample,
    ) -> Option<CameraMoved> {
        let mut watched = lock(&self.0);
        if watched.as_ref().is_none_or(|watched| watched.model_version != model_version) {
            let gnss = TrackSettings::from_model(regressor).gnss;
            let watch =
                DriftDetector::new(DriftDetectorSettings { gnss, ..DriftDetectorSettings::default() });
            *watched = Some(Watched { model_version, watch, unsaved: None });
        }
        let watched = watched.as_mut()?;
        if let Some(alarm) = watched.watch.observe(compared) {
            watched.unsaved = Some(alarm);
        }
        watched.unsaved.map(|alarm| moved(model_version, &alarm))
    }

    fn saved(&self) {
        if let Some(watched) = lock(&self.0).as_mut() {
            watched.unsaved = None;
        }
    }
}

fn moved(model_version: u32, alarm: &DriftAlarm) -> CameraMoved {
    CameraMoved {
        model_version,
        began_at: alarm.onset_at,
        raised_at: alarm.detected_at,
        shift_east_m: alarm.shift.east_m,
        shift_north_m: alarm.shift.north_m,
        statistic: alarm.glr_statistic,
        targets: u32::try_from(alarm.supporting_targets).unwrap_or(u32::MAX),
    }
}

impl App {
    /// Compares the last of some observations, of those with box, fix and target: for clients who
    /// only ask for positions. One of a batch is enough, and costs the others nothing.
    pub(in crate::app) async fn watch_over(
        &self,
        id: &CameraId,
        serving: &Serving,
        observations: &[Observation],
    ) {
        let Some((regressor, version)) = &serving.model else { return };
        let live = self.live.of(id);
        let comparable = observations.iter().rev().find_map(|observation| {
            let Observation { time, target_id: Some(target_id), bounding_box: Some(drawn), fix: Some(fix) } =
                observation
            else {
                return None;
            };
            let regression = regressor.regress(drawn, None);
            let plane = live.tracks.plane(fix.position);
            Some(ResidualSample {
                time: *time,
                target_id: target_id.clone(),
                regressed: plane.to_plane(regressor.plane().to_position(regression.regressed)),
                fix: plane.to_plane(fix.position),
                e_regression_m2: regression.variance_m2(),
                e_gnss_m2: two_step::fix_variance_m2(observation, Some(regressor), serving.e_gnss_m2),
            })
        });
        if let Some(compared) = comparable {
            self.compare(id, &live, (regressor, *version), &compared).await;
        }
    }

    /// Takes up a comparison, and raises the alarm if it comes to that. An alarm that cannot be kept
    /// is logged and comes again with the next comparison; positions are answered all the same.
    pub(super) async fn compare(
        &self,
        id: &CameraId,
        live: &CameraLive,
        model: (&Regressor, u32),
        compared: &ResidualSample,
    ) {
        let Some(moved) = live.watching.compare(model, compared) else { return };
        if let Err(error) = self.raise(id, live, moved).await {
            tracing::error!(camera.id = %id, %error, "the alarm that the camera was moved cannot be kept");
        }
    }

    /// Keeps an alarm and tells everyone, once per model version.
    ///
    /// # Errors
    /// A fault of the store.
    async fn raise(&self, id: &CameraId, live: &CameraLive, moved: CameraMoved) -> Result<()> {
        let is_new = match self.store.insert_move(id, &moved).await {
            Err(Error::Refused(refusal)) if refusal.kind == ErrorKind::CameraNotFound => return Ok(()),
            kept => kept?,
        };
        live.watching.saved();
        self.registry.refresh_camera(&self.store, id).await?;
        if is_new {
            tracing::warn!(
                camera.id = %id, model = moved.model_version, began_at = %moved.began_at,
                shift_east_m = moved.shift_east_m, shift_north_m = moved.shift_north_m,
                "the camera no longer looks where it looked when its model was trained"
            );
            self.metrics.camera_moved();
            live.tell_moved(Arc::new(moved));
        }
        Ok(())
    }

    /// Starts a training run for every camera that was moved, wants it and has the samples; each
    /// move starts one run. To be called every now and then.
    ///
    /// # Errors
    /// A fault of the store.
    pub async fn retrain_moved(&self) -> Result<()> {
        for (id, moved) in self.store.moves_to_retrain().await? {
            let request = crate::app::RunRequest { from: Some(moved.began_at), ..Default::default() };
            match self.start_run(&id, request).await {
                Ok(run) => {
                    self.store.note_retraining(&id, moved.model_version, run.id).await?;
                    tracing::info!(camera.id = %id, run.id = %run.id, "training anew, for the camera was moved");
                }
                // Too few samples since then, or another run is live: later.
                Err(Error::Refused(_)) => {}
                Err(fault) => return Err(fault),
            }
        }
        Ok(())
    }
}
