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
    /// Why the active model cannot be used; then `model` is `None`.
    pub model_fault: Option<ModelFault>,
}

/// An active model version that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelFault {
    /// The version.
    pub version: u32,
    /// A sentence for the operator.
    pub reason: String,
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
    /// `CameraNotFound`; a fault if the store cannot be read.
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
    /// A model that cannot be loaded leaves its camera without one ([`Serving::model_fault`]), so that one
    /// damaged row does not keep others from being served. It is tried again with every refresh.
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
                Err(error) => tracing::error!(camera.id = %id, %error, "cannot read the camera"),
            }
        }
        if changed {
            self.cameras.store(Arc::new(cameras));
        }
        Ok(())
    }

    /// The cameras whose active model cannot be used, by id.
    #[must_use]
    pub fn model_faults(&self) -> Vec<(CameraId, ModelFault)> {
        let cameras = self.cameras.load();
        let faults =
            cameras.iter().filter_map(|(id, camera)| Some((id.clone(), camera.model_fault.clone()?)));
        let mut faults: Vec<_> = faults.collect();
        faults.sort_by(|one, other| one.0.as_str().cmp(other.0.as_str()));
        faults
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
        let mut model_fault = None;
        let model = match (camera.active_model, loaded) {
            (None, _) => None,
            (Some(number), Some(loaded)) if loaded.1 == number => Some(loaded),
            (Some(number), _) => match load_regressor(store, id, number).await {
                Ok(regressor) => {
                    // Wrong by about the shift, it must not go on being confident.
                    let regressor = match &moved {
                        Some(moved) => regressor.with_added_error(moved.change_variance_m2()),
                        None => regressor,
                    };
                    Some((Arc::new(regressor), number))
                }
                Err(error) => {
                    model_fault = Some(self.model_fault(id, number, error)?);
                    None
                }
            },
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
            model_fault,
        }))
    }

    /// What to say of a model that cannot be loaded; logged when it is found, not with every refresh.
    ///
    /// # Errors
    /// A refusal that says nothing of the model: the camera was deleted, the store is overloaded or closed.
    fn model_fault(&self, id: &CameraId, version: u32, error: Error) -> Result<ModelFault> {
        let reason = match &error {
            Error::Refused(refusal) if refusal.kind == ErrorKind::ModelUnusable => refusal.message.clone(),
            Error::Fault(_) => {
                format!("version {version} cannot be read from the database; the server's log says why")
            }
            Error::Refused(_) => return Err(error),
        };
        let fault = ModelFault { version, reason };
        let known = self.get(id).and_then(|serving| serving.model_fault.clone());
        if known.as_ref() != Some(&fault) {
            tracing::error!(
                camera.id = %id, model = version, %error,
                "the camera's active model cannot be used; its fixes pass through without it"
            );
        }
        Ok(fault)
    }
}

/// A stored model version, ready to answer.
///
/// # Errors
/// `ModelNotFound`; `ModelUnusable` if what is stored is damaged or does not pass the checks of a model.
pub(super) async fn load_regressor(store: &Store, id: &CameraId, number: u32) -> Result<Regressor> {
    let (metadata, weights) = store.model_content(id, number).await?;
    Artifact { metadata, weights: weights.into() }.load().map_err(|error| match error {
        Error::Refused(refusal) => Error::refused(
            ErrorKind::ModelUnusable,
            format!("version {number} of camera {id} cannot be used: {}", Error::Refused(refusal)),
        ),
        fault @ Error::Fault(_) => fault,
    })
}
