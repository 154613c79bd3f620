//! Profiles and active models, loaded and ready, read without a lock.
//!
//! A fusion takes the pointer that stands at that moment; an activation swaps it. Nothing here
//! waits for the database while a request is answered.

use std::collections::HashMap;
use std::sync::Arc;

use arc_swap::ArcSwap;
use tokio::sync::Mutex;

use crate::domain::{
    CameraId, CameraMoved, Error, ErrorKind, GnssError, ImageSize, Receivers, Result, Revision,
};
use crate::model::{Artifact, Regressor};
use crate::store::Store;

/// What answers for one camera.
pub struct Serving {
    /// Revision of the profile that this was made from.
    pub revision: Revision,
    /// Size of the image, if told.
    pub image_size: Option<ImageSize>,
    /// The receiver's variance per axis in m2, if the profile tells it.
    pub e_gnss_m2: Option<f64>,
    /// Whose the receivers are, for pairing.
    pub receivers: Receivers,
    /// What the watch found with that model.
    pub moved: Option<Arc<CameraMoved>>,
    /// The active model and its version number.
    pub model: Option<(Arc<Regressor>, u32)>,
}

/// All cameras, by id.
#[derive(Default)]
pub struct Registry {
    cameras: ArcSwap<HashMap<CameraId, Arc<Serving>>>,
    /// Held while the map is replaced, so that two changes at once cannot undo each other.
    change: Mutex<()>,
}

impl Registry {
    /// What answers for a camera.
    #[must_use]
    pub fn get(&self, id: &CameraId) -> Option<Arc<Serving>> {
        self.cameras.load().get(id).cloned()
    }

    /// Brings one camera up to date with the store.
    ///
    /// # Errors
    /// `CameraNotFound`; a fault if the model cannot be loaded.
    pub async fn refresh_camera(&self, store: &Store, id: &CameraId) -> Result<Arc<Serving>> {
        let _change = self.change.lock().await;
        let serving = self.load(store, id).await?;
        let mut cameras = HashMap::clone(&self.cameras.load());
        cameras.insert(id.clone(), serving.clone());
        self.cameras.store(Arc::new(cameras));
        Ok(serving)
    }

    /// Brings all cameras up to date: what another process on the same file has changed, too.
    ///
    /// A model that cannot be loaded leaves its camera without one, with a line in the log, so that
    /// one bad row does not keep the others from being served.
    ///
    /// # Errors
    /// A fault if the store cannot be read.
    pub async fn refresh(&self, store: &Store) -> Result<()> {
        let _change = self.change.lock().await;
        let heads = store.camera_heads().await?;
        let known = self.cameras.load_full();
        let unchanged = |id: &CameraId, revision: Revision, active: Option<u32>| {
            known.get(id).filter(|serving| {
                serving.revision == revision && serving.model.as_ref().map(|(_, number)| *number) == active
            })
        };
        let mut cameras = HashMap::with_capacity(heads.len());
        let mut changed = heads.len() != known.len();
        for (id, revision, active) in heads {
            if let Some(serving) = unchanged(&id, revision, active) {
                cameras.insert(id, serving.clone());
                continue;
            }
            changed = true;
            match self.load(store, &id).await {
                Ok(serving) => {
                    cameras.insert(id, serving);
                }
                Err(Error::Refused(refusal)) if refusal.kind == ErrorKind::CameraNotFound => {}
                Err(error) => {
                    tracing::error!(camera.id = %id, %error, "cannot load the camera's active model");
                }
            }
        }
        if changed {
            self.cameras.store(Arc::new(cameras));
        }
        Ok(())
    }

    /// Forgets a deleted camera.
    pub fn forget(&self, id: &CameraId) {
        self.cameras.rcu(|cameras| {
            let mut cameras = HashMap::clone(cameras);
            cameras.remove(id);
            cameras
        });
    }

    async fn load(&self, store: &Store, id: &CameraId) -> Result<Arc<Serving>> {
        let camera = store.camera(id).await?;
        let moved = match camera.active_model {
            Some(number) => store.camera_move(id, number).await?.map(Arc::new),
            None => None,
        };
        let loaded = self.get(id).filter(|serving| serving.moved == moved);
        let loaded = loaded.and_then(|serving| serving.model.clone());
        let model = match (camera.active_model, loaded) {
            (None, _) => None,
            (Some(number), Some(loaded)) if loaded.1 == number => Some(loaded),
            (Some(number), _) => {
                let regressor = load_regressor(store, id, number).await?;
                // Wrong by about the shift, it must not go on being confident.
                let regressor = match &moved {
                    Some(moved) => regressor.with_added_error(moved.change_variance_m2()),
                    None => regressor,
                };
                Some((Arc::new(regressor), number))
            }
        };
        Ok(Arc::new(Serving {
            moved,
            revision: camera.revision,
            image_size: camera.profile.image_size,
            e_gnss_m2: match camera.profile.gnss_error {
                GnssError::Known(sigma) => Some(sigma.variance_m2()),
                GnssError::Unknown => None,
            },
            receivers: camera.profile.receivers,
            model,
        }))
    }
}

/// A stored model version, ready to answer.
///
/// # Errors
/// `ModelNotFound`; a fault if what is stored cannot be loaded.
pub(super) async fn load_regressor(store: &Store, id: &CameraId, number: u32) -> Result<Regressor> {
    let metadata = store.model(id, number).await?.metadata;
    let weights = store.weights(id, number).await?.into();
    Artifact { metadata, weights }.load().map_err(Error::fault)
}
