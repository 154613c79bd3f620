//! Fusion: positions for observations, from the registry alone.

use std::sync::Arc;

use super::App;
use super::live::ResidualQueue;
use super::registry::{ActiveCamera, Registry};
use crate::clock::Clock;
use crate::config::Limits;
use crate::domain::{Error, ErrorKind, Flag, FusedFix, Observation, Result};
use crate::fusion::observed::ObservedPositions;
use crate::fusion::two_step;
use crate::store::Store;
use crate::telemetry::Metrics;

/// Positions for observations, from the registry alone.
#[derive(Clone, Copy)]
pub struct Fusion<'a> {
    store: &'a Store,
    registry: &'a Registry,
    residuals: &'a ResidualQueue,
    clock: &'a Clock,
    limits: &'a Limits,
    metrics: &'a Metrics,
}

impl App {
    /// Positions for observations, from the registry alone.
    #[must_use]
    pub fn fusion(&self) -> Fusion<'_> {
        Fusion {
            store: &self.store,
            registry: &self.registry,
            residuals: &self.residuals,
            clock: &self.clock,
            limits: &self.limits,
            metrics: &self.metrics,
        }
    }
}

impl Fusion<'_> {
    /// Answers observations of one camera, all by the same model version. Takes no lock and never waits
    /// for the database, but to look for a model where there is none.
    ///
    /// # Errors
    /// `CameraNotFound`; `NoModel` if there is a box and no active model; `TooLarge` beyond the
    /// limit of observations.
    pub async fn fuse(
        &self,
        camera: Arc<ActiveCamera>,
        observations: &[Observation],
    ) -> Result<Vec<FusedFix>> {
        self.limits.check_batch(observations.len())?;
        let mut camera = camera;
        if camera.model.is_none()
            && camera.model_fault.is_none()
            && observations.iter().any(|observation| observation.bounding_box().is_some())
        {
            // A run may have ended a moment ago, here or in another process.
            camera = self.registry.refresh_camera(self.store, &camera.id).await?;
        }
        let regressor = camera.model().map(|(regressor, _)| regressor);
        let observed: Vec<_> = observations
            .iter()
            .map(|observation| {
                let (image_size, e_gnss_m2) = (camera.image_size, camera.e_gnss_m2);
                (observation, ObservedPositions::of(observation, regressor, image_size, e_gnss_m2, None))
            })
            .collect();
        let fused = observed
            .iter()
            .map(|(observation, observed)| {
                fuse_for_camera(&camera, observation, observed).ok_or_else(|| no_model(&camera))
            })
            .collect::<Result<Vec<_>>>()?;
        self.metrics.fused(&fused);
        let bounds = self.limits.live_time_bounds(self.clock.now());
        self.residuals.hand_over_last(&camera, &observed, bounds);
        Ok(fused)
    }
}

/// The position of one observation; `None` for a box while the camera has no model. Where the active model
/// cannot be used, a box beside a fix is left out, and the fix passes through.
pub(super) fn fuse_for_camera(
    camera: &ActiveCamera,
    observation: &Observation,
    observed: &ObservedPositions<'_>,
) -> Option<FusedFix> {
    let without_box = camera.model_fault.as_ref().and_then(|_| observation.without_box());
    let observation = without_box.as_ref().unwrap_or(observation);
    let mut fused = two_step::fuse_observed(observation, observed, camera.model(), camera.image_size)?;
    if camera.moved.is_some() && fused.regressed.is_some() {
        fused.flags.push(Flag::CameraMoved);
    }
    Some(fused)
}

fn no_model(camera: &ActiveCamera) -> Error {
    let id = &camera.id;
    if let Some(fault) = &camera.model_fault {
        let message = format!("camera {id} has no usable model: {}; give fixes meanwhile", fault.reason);
        return Error::refused(ErrorKind::NoModel, message);
    }
    Error::refused(
        ErrorKind::NoModel,
        format!(
            "camera {id} has no active model: import samples, start a training run \
             (POST /v1/cameras/{id}/training-runs) and wait until it has succeeded"
        ),
    )
}
