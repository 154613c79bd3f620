//! The items that live observations hand to the tracker of their camera's site.

use tokio::sync::mpsc;

use super::item::{ItemSource, SiteItem};
use super::places::SitePlaces;
use super::task;
use crate::app::live::Live;
use crate::app::registry::ActiveCamera;
use crate::domain::{LiveId, Observation, SiteId};
use crate::fusion::observed::ObservedPositions;
use crate::telemetry::SiteItemOutcome;

impl Live<'_> {
    /// Hands what an observation measured to the tracker of its camera's site, and returns the world track of
    /// its target as of the latest frame. A full queue drops it, counted.
    pub(in crate::app::live) fn feed_site(
        &self,
        camera: &ActiveCamera,
        observation: &Observation,
        observed: &ObservedPositions<'_>,
    ) -> Option<LiveId> {
        let id = camera.site.as_ref()?;
        let site = self.site_registry.get(id)?;
        let queue = site.live.queue.get_or_init(|| {
            let (sender, receiver) = mpsc::channel(self.limits.site_queue.max(1));
            let task = task::run(site.live.clone(), receiver, self.site_resources(id));
            self.tasks.spawn(task);
            sender
        });
        for item in items_of(camera, observation, observed) {
            if queue.try_send(item).is_err() {
                self.metrics.site_item(SiteItemOutcome::Overflow);
            }
        }
        site.live.track_of(&camera.id, &observation.tracked_as()?)
    }

    fn site_resources(&self, id: &SiteId) -> task::SiteResources {
        task::SiteResources {
            places: SitePlaces { site: id.clone(), monitor: self.places.clone() },
            clock: self.clock.clone(),
            limits: self.limits.clone(),
            metrics: self.metrics.clone(),
            history: self.archived_history.queue().clone(),
            matching_slot: self.matching_slot.clone(),
            findings: self.residuals.findings(),
        }
    }
}

/// The box and the fix of an observation, each if it gives a position. A fix without a target names no receiver,
/// so nothing can be tracked by it.
fn items_of<'a>(
    camera: &'a ActiveCamera,
    observation: &'a Observation,
    observed: &'a ObservedPositions<'_>,
) -> impl Iterator<Item = SiteItem> + 'a {
    let item = |position, source| SiteItem {
        camera: camera.id.clone(),
        time: observation.time(),
        target_id: observation.target_id().cloned(),
        tracked_as: observation.tracked_as(),
        class: observation.class().cloned(),
        position,
        source,
    };
    let by_box = observed.usable_box().zip(observed.plane).map(|(observed_box, plane)| {
        let regression = &observed_box.independent;
        let (covariance, scale) = (regression.covariance, regression.normal_scale());
        let model = camera.model();
        let joint = model
            .zip(observation.bounding_box())
            .and_then(|((regressor, _), own)| Some(regressor.joint_error(&own, regression)?.scaled(scale)));
        let source = ItemSource::Box {
            model_version: model.map_or(0, |(_, version)| version),
            covariance_m2: covariance.scaled(scale),
            map_covariance_m2: covariance.minus(regression.box_noise).scaled(scale),
            joint,
            model_origin: plane.origin(),
        };
        item(plane.to_position(regression.regressed), source)
    });
    let fix = observed.fix.filter(|_| observation.target_id().is_some());
    let by_fix = fix.map(|fix| item(fix.position, ItemSource::Fix { variance_m2: fix.variance_m2 }));
    by_box.into_iter().chain(by_fix)
}
