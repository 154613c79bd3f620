//! Fusion: positions for observations, from the registry alone.

use std::sync::Arc;

use super::App;
use super::registry::Serving;
use crate::domain::{CameraId, Error, ErrorKind, Flag, FusedFix, Observation, Result};
use crate::fusion::two_step;

impl App {
    /// Answers observations of one camera, all by the same model version.
    ///
    /// # Errors
    /// `CameraNotFound`; `NoModel` if there is a box and no active model; `TooLarge` beyond the
    /// limit of observations.
    pub async fn fuse(&self, id: &CameraId, observations: &[Observation]) -> Result<Vec<FusedFix>> {
        self.check_batch(observations.len())?;
        let mut serving = self.serving(id).await?;
        if serving.model.is_none()
            && serving.model_fault.is_none()
            && observations.iter().any(|observation| observation.bounding_box.is_some())
        {
            // A run may have ended a moment ago, here or in another process.
            serving = self.registry.refresh_camera(&self.store, id).await?;
        }
        let fused = observations
            .iter()
            .map(|observation| fuse_one(&serving, observation).ok_or_else(|| no_model(id, &serving)))
            .collect::<Result<Vec<_>>>()?;
        self.metrics.fused(&fused);
        self.watch_over(id, &serving, observations).await;
        Ok(fused)
    }

    /// Checks the length of a batch, before its items are read.
    ///
    /// # Errors
    /// `TooLarge` and, for none at all, `InvalidArgument`, naming the field `observations`.
    pub fn check_batch(&self, observations: usize) -> Result<()> {
        if observations == 0 {
            return Err(Error::invalid("observations", "must be one or more"));
        }
        let most = self.limits.batch_observations;
        if observations > most {
            return Err(Error::field(
                ErrorKind::TooLarge,
                "observations",
                format!("are {observations}, at most {most} go into one request; send several"),
            ));
        }
        Ok(())
    }

    /// What answers for a camera; looks into the store for one that another process has made.
    pub(super) async fn serving(&self, id: &CameraId) -> Result<Arc<Serving>> {
        match self.registry.get(id) {
            Some(serving) => Ok(serving),
            None => self.registry.refresh_camera(&self.store, id).await,
        }
    }
}

/// The position of one observation; `None` for a box while the camera has no model. Where the active model
/// cannot be used, a box beside a fix is left out, and the fix passes through.
pub(super) fn fuse_one(serving: &Serving, observation: &Observation) -> Option<FusedFix> {
    let model = serving.model.as_ref().map(|(regressor, number)| (&**regressor, *number));
    let without_box;
    let observation = if serving.model_fault.is_some() && observation.fix.is_some() {
        without_box = Observation { bounding_box: None, ..observation.clone() };
        &without_box
    } else {
        observation
    };
    let mut fused = two_step::fuse(observation, model, serving.image_size, serving.e_gnss_m2)?;
    if serving.moved.is_some() && fused.regressed.is_some() {
        fused.flags.push(Flag::CameraMoved);
    }
    Some(fused)
}

fn no_model(id: &CameraId, serving: &Serving) -> Error {
    if let Some(fault) = &serving.model_fault {
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
