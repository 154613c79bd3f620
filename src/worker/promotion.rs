//! Whether a new model version becomes active by itself.

use crate::app::App;
use crate::domain::{CameraId, ModelMetadata, Result, Sample};
use crate::model::{Artifact, Regressor};

/// The verdict and a sentence for the operator.
pub(super) struct Verdict {
    pub(super) activate: bool,
    pub(super) reason: String,
}

/// Compares a new version with the active one by their mean distance to fixes not trained on.
///
/// The active version's error is the larger of what it was held to when it was trained and what it
/// shows on the new run's samples, so that a model of a camera that has been moved since gives way.
pub(super) async fn judge(
    app: &App,
    id: &CameraId,
    artifact: &Artifact,
    samples: &[Sample],
) -> Result<Verdict> {
    let camera = app.store.camera(id).await?;
    let Some(number) = camera.active_model else {
        return Ok(Verdict { activate: true, reason: "became active: the camera had no model".to_owned() });
    };
    let Some(new_m) = held_out_m(&artifact.metadata) else {
        return Ok(keep(number, "the new version has no held-out error to compare".to_owned()));
    };
    let active = app.registry.refresh_camera(&app.store, id).await?.model.clone();
    let recorded_m = held_out_m(&app.store.model(id, number).await?.metadata);
    let seen_m = active.and_then(|(regressor, _)| mean_to_fix_m(&regressor, samples));
    let Some(active_m) = [recorded_m, seen_m].into_iter().flatten().reduce(f64::max) else {
        return Ok(Verdict {
            activate: true,
            reason: format!("became active: version {number} has no held-out error to compare"),
        });
    };
    let compared = format!("held-out mean {new_m:.3} m against {active_m:.3} m of version {number}");
    if new_m <= active_m {
        Ok(Verdict { activate: true, reason: format!("became active: {compared}") })
    } else {
        Ok(keep(number, compared))
    }
}

fn keep(number: u32, why: String) -> Verdict {
    Verdict {
        activate: false,
        reason: format!(
            "version {number} stays active: {why}; activate the new one by hand if you know better"
        ),
    }
}

fn held_out_m(metadata: &ModelMetadata) -> Option<f64> {
    metadata.held_out.as_ref().map(|held_out| held_out.mean_to_fix_m)
}

fn mean_to_fix_m(regressor: &Regressor, samples: &[Sample]) -> Option<f64> {
    let plane = regressor.plane();
    let sum: f64 = samples
        .iter()
        .map(|sample| {
            let fix = plane.to_plane(sample.fix.position);
            // From the box alone, as held-out errors are measured.
            regressor.regress(&sample.bounding_box, None).regressed.distance_m(fix)
        })
        .sum();
    (!samples.is_empty()).then(|| sum / samples.len() as f64)
}
