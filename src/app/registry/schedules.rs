//! Changes of cameras beside refreshes, under thousands of orders of their steps.

use std::collections::HashMap;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Mutex};

use jiff::Timestamp;
use sightfix_schedules::{below, block_on, explore, explore_planted, pause, spawn};

use super::{CameraSource, Registry};
use crate::app::live::sync::lock;
use crate::domain::{
    Camera, CameraId, CameraKey, Error, ErrorKind, NewCamera, Result, Revision, SampleCount,
};
use crate::store::{CameraContent, CameraVersion, CameraVersions, ChangeMark};

/// Cameras of a database, each answer of which is of one moment.
#[derive(Default)]
struct Stored {
    cameras: Mutex<HashMap<CameraId, Camera>>,
    last_key: AtomicI64,
}

impl Stored {
    fn create(&self, id: &CameraId) {
        let key = CameraKey(self.last_key.fetch_add(1, Ordering::Relaxed) + 1);
        let camera = Camera {
            key,
            profile: NewCamera::named(id.clone()),
            revision: Revision(1),
            created_at: Timestamp::UNIX_EPOCH,
            updated_at: Timestamp::UNIX_EPOCH,
            active_model: None,
            samples: SampleCount::default(),
        };
        lock(&self.cameras).insert(id.clone(), camera);
    }

    fn change(&self, id: &CameraId) {
        if let Some(camera) = lock(&self.cameras).get_mut(id) {
            camera.revision.0 += 1;
        }
    }

    /// What the registry is to know of a camera.
    fn state(&self, id: &CameraId) -> Option<(CameraKey, Revision)> {
        lock(&self.cameras).get(id).map(|camera| (camera.key, camera.revision))
    }
}

impl CameraSource for Stored {
    async fn versions(&self, _: Option<ChangeMark>) -> Result<CameraVersions> {
        pause().await;
        let version = |camera: &Camera| CameraVersion {
            id: camera.id().clone(),
            key: camera.key,
            revision: camera.revision,
            active_model: None,
        };
        let versions = lock(&self.cameras).values().map(version).collect();
        pause().await;
        Ok(CameraVersions { versions, deleted: None, upto: None })
    }

    async fn contents(&self, ids: &[CameraId]) -> Result<Vec<Result<CameraContent>>> {
        pause().await;
        let content = |id: &CameraId| {
            let camera = lock(&self.cameras).get(id).cloned();
            let camera =
                camera.ok_or_else(|| Error::refused(ErrorKind::CameraNotFound, "there is no such camera"));
            camera.map(|camera| CameraContent { camera, moved: None, model: None })
        };
        let contents = ids.iter().map(content).collect();
        pause().await;
        Ok(contents)
    }
}

fn known(registry: &Registry, id: &CameraId) -> Option<(CameraKey, Revision)> {
    registry.get(id).map(|camera| (camera.key, camera.revision))
}

/// Two cameras, each of which is created, changed and deleted by one client and changed by another process, too,
/// beside the refreshes that look for such changes; `forget` tells the registry of a deletion.
fn changes_beside_refreshes<F: Future<Output = ()> + Send + 'static>(
    forget: impl Fn(Arc<Registry>, CameraId) -> F + Copy + Send + Sync + 'static,
) {
    block_on(async move {
        let (registry, stored) = (Arc::new(Registry::default()), Arc::new(Stored::default()));
        let mut tasks = Vec::new();
        for id in ["gate", "yard"].map(|name| CameraId::new(name).expect("a slug")) {
            let (another, another_id) = (Arc::clone(&stored), id.clone());
            let (registry, stored) = (Arc::clone(&registry), Arc::clone(&stored));
            tasks.push(spawn(async move {
                for _ in 0..6 {
                    pause().await;
                    let acknowledged = match (stored.state(&id), below(3)) {
                        (Some(_), 0) => {
                            lock(&stored.cameras).remove(&id);
                            pause().await;
                            forget(Arc::clone(&registry), id.clone()).await;
                            None
                        }
                        (before, _) => {
                            match before {
                                Some(_) => stored.change(&id),
                                None => stored.create(&id),
                            }
                            let changed = stored.state(&id);
                            pause().await;
                            registry.refresh_camera(&*stored, &id).await.expect("stored");
                            changed
                        }
                    };
                    pause().await;
                    let known = known(&registry, &id);
                    // The other process may have changed the camera since, but nobody else deletes or creates it.
                    let is_undone =
                        known.map(|it| it.0) != acknowledged.map(|it| it.0) || known < acknowledged;
                    assert!(!is_undone, "an acknowledged change is undone: {acknowledged:?} is {known:?}");
                }
            }));
            let (stored, id) = (another, another_id);
            tasks.push(spawn(async move {
                for _ in 0..6 {
                    pause().await;
                    stored.change(&id);
                }
            }));
        }
        for _ in 0..2 {
            let (registry, stored) = (Arc::clone(&registry), Arc::clone(&stored));
            tasks.push(spawn(async move {
                for _ in 0..4 {
                    pause().await;
                    registry.refresh(&*stored).await.expect("stored");
                }
            }));
        }
        for task in tasks {
            task.await.expect("no panic");
        }
    });
}

#[test]
fn refreshes_undo_no_acknowledged_change() {
    explore(|| changes_beside_refreshes(|registry, id| async move { registry.forget(&id).await }));
}

#[test]
fn a_deletion_that_waits_for_no_refresh_is_found() {
    explore_planted("an acknowledged change is undone", || {
        changes_beside_refreshes(|registry, id| async move { registry.remove(vec![id]) });
    });
}
