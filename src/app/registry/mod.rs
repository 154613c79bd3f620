//! Profiles and active models, loaded and ready, read without a lock.
//!
//! A request reads the map that is current at that moment; a change replaces it. Reading never waits for
//! the database.

#[cfg(test)]
mod schedules;

use std::collections::{BTreeSet, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use arc_swap::ArcSwap;
use jiff::Timestamp;
use tokio::sync::Mutex;

use super::live::camera::CameraLive;
use crate::domain::{
    CameraId, CameraKey, CameraMoved, Error, ErrorKind, GnssError, HeldOutError, HistorySettings, ImageSize,
    ModelMetadata, Receivers, Result, Revision, SiteId, TimeBounds,
};
use crate::exchange::RowRules;
use crate::model::{Artifact, Regressor, ViewArea};
use crate::store::{CameraContent, CameraVersion, CameraVersions, ChangeMark, Store};

/// Cameras that a refresh reads at once.
const READ_AT_ONCE: usize = 256;
/// Cameras that are worth a thread to load.
const LEAST_PER_CORE: usize = 32;
/// Loaded cameras that a refresh shows at once. Every change copies the map, so that few at a time would cost the square
/// of their number at the start of a server.
const SHOWN_AT_ONCE: usize = 4_096;
/// A refresh reads what has changed since the one before. One in this number of refreshes compares all cameras, since a
/// server that was restored, copied or replaced may not tell all of its changes.
const REFRESHES_OF_CHANGES: u32 = 150;

/// Where cameras are stored.
pub trait CameraSource: Sync {
    /// As [`Store::camera_versions`].
    fn versions(&self, since: Option<ChangeMark>) -> impl Future<Output = Result<CameraVersions>> + Send;

    /// As [`Store::camera_contents`].
    fn contents(&self, ids: &[CameraId]) -> impl Future<Output = Result<Vec<Result<CameraContent>>>> + Send;
}

impl CameraSource for Store {
    async fn versions(&self, since: Option<ChangeMark>) -> Result<CameraVersions> {
        self.camera_versions(since).await
    }

    async fn contents(&self, ids: &[CameraId]) -> Result<Vec<Result<CameraContent>>> {
        self.camera_contents(ids).await
    }
}

/// Everything that answers for one camera.
#[derive(Clone)]
pub struct ActiveCamera {
    /// The camera's id.
    pub id: CameraId,
    /// Which one of those that had this id.
    pub key: CameraKey,
    /// Revision of the profile that this was made from.
    pub revision: Revision,
    /// Size of the image, if the profile states it.
    pub image_size: Option<ImageSize>,
    /// The receiver's variance per axis in m2, if the profile states it.
    pub e_gnss_m2: Option<f64>,
    /// Which target carries which receiver, for pairing.
    pub receivers: Receivers,
    /// True if the camera is trained again automatically after it was moved.
    pub retrain_when_moved: bool,
    /// True if the camera learns automatically while there is no model.
    pub learn_automatically: bool,
    /// The site whose tracks the camera contributes to.
    pub site: Option<SiteId>,
    /// How finished tracks are kept; `None` keeps none.
    pub history: Option<HistorySettings>,
    /// The movement that the drift detector found with that model.
    pub moved: Option<Arc<CameraMoved>>,
    /// The active model and its version number.
    pub model: Option<(Arc<Regressor>, u32)>,
    /// The summary of that model for an operator.
    pub model_summary: Option<Arc<ModelSummary>>,
    /// Why the active model cannot be used; then `model` is `None`.
    pub model_fault: Option<ModelFault>,
    /// Tracks, drift detection and listeners; the same as long as the camera exists.
    pub(super) live: Arc<CameraLive>,
}

/// How well a model does, and where.
#[derive(Debug)]
pub struct ModelSummary {
    /// Its error on held-out samples, if there were enough.
    pub held_out: Option<HeldOutError>,
    regressor: Arc<Regressor>,
    view_area: OnceLock<ViewArea>,
}

impl ModelSummary {
    fn new(held_out: Option<HeldOutError>, regressor: Arc<Regressor>) -> Self {
        Self { held_out, regressor, view_area: OnceLock::new() }
    }

    /// The area that its training boxes cover; computed when it is asked for, which few cameras of many are.
    #[must_use]
    pub fn view_area(&self) -> &ViewArea {
        self.view_area.get_or_init(|| self.regressor.view_area())
    }
}

/// An active model version that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelFault {
    pub version: u32,
    /// A sentence for the operator.
    pub reason: String,
}

impl ActiveCamera {
    /// The active model and its version number.
    #[must_use]
    pub fn model(&self) -> Option<(&Regressor, u32)> {
        self.model.as_ref().map(|(regressor, version)| (&**regressor, *version))
    }

    /// The rules for rows of the camera.
    #[must_use]
    pub fn row_rules(&self, now: Timestamp) -> RowRules {
        RowRules { time_bounds: TimeBounds::at(now), image_size: self.image_size }
    }
}

/// Until where the last refresh has read.
#[derive(Default)]
struct Refreshed {
    /// `None` before the first one, and after one that could not read every camera.
    upto: Option<ChangeMark>,
    /// Refreshes since one that read all.
    of_changes: u32,
}

/// All cameras, by id.
#[derive(Default)]
pub struct Registry {
    cameras: ArcSwap<HashMap<CameraId, Arc<ActiveCamera>>>,
    /// Held from reading the store to replacing the map, so that no change undoes a later one.
    change: Mutex<Refreshed>,
    /// True if the known cameras may be of a history that the database has not; they are read again, whatever version.
    is_distrusted: AtomicBool,
    /// Tells this run of the server apart from others.
    run_id: u64,
}

impl Registry {
    /// An empty registry of one run of the server.
    #[must_use]
    pub fn of_run(run_id: u64) -> Self {
        Self { run_id, ..Self::default() }
    }

    /// Number of the event log of a camera; keys are never used twice.
    const fn event_log(&self, key: CameraKey) -> u64 {
        self.run_id.wrapping_add(key.0.cast_unsigned())
    }

    /// All cameras, by id.
    pub(super) fn all(&self) -> Arc<HashMap<CameraId, Arc<ActiveCamera>>> {
        self.cameras.load_full()
    }

    /// Returns the active camera of an id.
    #[must_use]
    pub fn get(&self, id: &CameraId) -> Option<Arc<ActiveCamera>> {
        self.cameras.load().get(id).cloned()
    }

    /// The cameras that a rule selects.
    pub(super) fn select(&self, rule: impl Fn(&ActiveCamera) -> bool) -> Vec<Arc<ActiveCamera>> {
        self.cameras.load().values().filter(|camera| rule(camera)).cloned().collect()
    }

    /// The first camera that a rule selects; it is asked of no camera after that.
    pub(super) fn find(&self, rule: impl Fn(&ActiveCamera) -> bool) -> Option<Arc<ActiveCamera>> {
        self.cameras.load().values().find(|camera| rule(camera)).cloned()
    }

    /// Brings one camera up to date with the store.
    ///
    /// # Errors
    /// `CameraNotFound`; a fault if the store cannot be read.
    pub async fn refresh_camera(
        &self,
        store: &impl CameraSource,
        id: &CameraId,
    ) -> Result<Arc<ActiveCamera>> {
        let _change = self.change.lock().await;
        let read = store.contents(std::slice::from_ref(id)).await?.pop();
        let loaded = read.ok_or_else(|| Error::fault("the store answers for no camera"))?;
        let loaded =
            loaded.and_then(|content| self.load(content, self.is_distrusted.load(Ordering::Acquire)));
        match &loaded {
            Ok(camera) => self.replace(|cameras| cameras.insert(id.clone(), camera.clone())),
            Err(error) if error.kind() == ErrorKind::CameraNotFound => self.remove(vec![id.clone()]),
            Err(_) => {}
        }
        loaded
    }

    /// Brings all cameras up to date, including changes of other processes.
    ///
    /// A model that cannot be loaded leaves its camera without one ([`ActiveCamera::model_fault`]), so that one
    /// damaged row does not keep others from being served. It is tried again with every refresh.
    ///
    /// # Errors
    /// A fault if the store cannot be read.
    pub async fn refresh(&self, store: &impl CameraSource) -> Result<()> {
        let mut change = self.change.lock().await;
        let Refreshed { upto, of_changes } = std::mem::take(&mut *change);
        let is_distrusted = self.is_distrusted.swap(false, Ordering::AcqRel);
        let refreshed = self.refresh_since(store, upto, of_changes, is_distrusted).await;
        match &refreshed {
            Ok(Some(_)) => {}
            // Whatever goes wrong, the next refresh reads it all.
            Ok(None) | Err(_) => drop(self.is_distrusted.fetch_or(is_distrusted, Ordering::AcqRel)),
        }
        *change = refreshed?.unwrap_or_default();
        Ok(())
    }

    /// Until where this refresh has read; `None` if not every camera could be read.
    async fn refresh_since(
        &self,
        store: &impl CameraSource,
        upto: Option<ChangeMark>,
        of_changes: u32,
        is_distrusted: bool,
    ) -> Result<Option<Refreshed>> {
        let since = upto.filter(|_| of_changes < REFRESHES_OF_CHANGES && !is_distrusted);
        let CameraVersions { versions, deleted, upto } = store.versions(since).await?;
        let known = self.cameras.load_full();
        let deleted = deleted.unwrap_or_else(|| missing(&known, &versions));
        let is_known = |(id, key): &(CameraId, CameraKey)| known.get(id).is_some_and(|it| it.key == *key);
        self.remove(deleted.into_iter().filter(is_known).map(|(id, _)| id).collect());
        let ids = if is_distrusted {
            versions.into_iter().map(|version| version.id).collect()
        } else {
            stale(&known, versions)
        };
        let is_complete = self.read(store, &ids, is_distrusted).await?;
        let of_changes = if since.is_some() { of_changes + 1 } else { 0 };
        Ok(is_complete.then_some(Refreshed { upto, of_changes }))
    }

    /// Lets the next refresh read every camera and its model again: the database's history has changed, in which
    /// revisions, versions and fences are given out again.
    pub(super) fn distrust(&self) {
        self.is_distrusted.store(true, Ordering::Release);
        self.cameras.load().values().for_each(|camera| camera.live.note_gap());
    }

    /// Loads cameras as they are stored, with models that are known already unless they are distrusted; whether all
    /// could be read.
    async fn read(&self, store: &impl CameraSource, ids: &[CameraId], is_distrusted: bool) -> Result<bool> {
        let mut is_complete = true;
        for shown in ids.chunks(SHOWN_AT_ONCE) {
            let mut loaded = Vec::with_capacity(shown.len());
            for group in shown.chunks(READ_AT_ONCE) {
                let contents = store.contents(group).await?;
                let load =
                    |content: Result<CameraContent>| content.and_then(|it| self.load(it, is_distrusted));
                for (id, camera) in group.iter().zip(on_all_cores(contents, load)) {
                    match camera {
                        Ok(camera) => loaded.push((id, Some(camera))),
                        Err(error) => {
                            if error.kind() == ErrorKind::CameraNotFound {
                                self.end(id);
                            } else {
                                tracing::error!(camera.id = %id, %error, "cannot read the camera");
                                is_complete = false;
                            }
                            loaded.push((id, None));
                        }
                    }
                }
            }
            self.replace(|cameras| {
                for (id, camera) in &loaded {
                    match camera {
                        Some(camera) => cameras.insert((*id).clone(), camera.clone()),
                        None => cameras.remove(*id),
                    };
                }
            });
        }
        Ok(is_complete)
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

    /// Prepares a camera's live state for changes under a fence; whether it was cleared, since another node may have
    /// owned the camera in between.
    pub(super) async fn begin_tenure(&self, id: &CameraId, key: CameraKey, fence: i64) -> bool {
        let _change = self.change.lock().await;
        let Some(known) = self.get(id).filter(|known| known.key == key) else { return false };
        if known.live.continue_under(fence) {
            return false;
        }
        self.clear(&known, fence);
        true
    }

    /// Clears a camera's live state if another node has owned the camera since; the camera if it was cleared.
    pub(super) async fn clear_before(&self, key: CameraKey, fence: i64) -> Option<Arc<ActiveCamera>> {
        let _change = self.change.lock().await;
        let former = self.find(|camera| camera.key == key && camera.live.is_before(fence))?;
        self.clear(&former, fence);
        Some(former)
    }

    /// Gives a camera a new live state, under a fence.
    fn clear(&self, known: &ActiveCamera, fence: i64) {
        known.live.replace();
        let tenure = fence.cast_unsigned().rotate_right(16);
        let live = CameraLive::new(self.event_log(known.key).wrapping_add(tenure));
        live.continue_under(fence);
        let cleared = Arc::new(ActiveCamera { live, ..known.clone() });
        self.replace(|cameras| cameras.insert(known.id.clone(), cleared.clone()));
    }

    /// Removes a deleted camera and ends what listens to it. Waits for a refresh under way, which may
    /// have read the camera before it was deleted.
    pub async fn forget(&self, id: &CameraId) {
        let _change = self.change.lock().await;
        self.remove(vec![id.clone()]);
    }

    fn remove(&self, ids: Vec<CameraId>) {
        if ids.is_empty() {
            return;
        }
        for id in &ids {
            self.end(id);
        }
        self.replace(|cameras| {
            for id in &ids {
                cameras.remove(id);
            }
        });
    }

    /// Ends what listens to a camera.
    fn end(&self, id: &CameraId) {
        if let Some(camera) = self.get(id) {
            camera.live.end();
        }
    }

    fn replace<T>(&self, change: impl Fn(&mut HashMap<CameraId, Arc<ActiveCamera>>) -> T) {
        self.cameras.rcu(|cameras| {
            let mut cameras = HashMap::clone(cameras);
            change(&mut cameras);
            cameras
        });
    }

    fn load(&self, content: CameraContent, is_distrusted: bool) -> Result<Arc<ActiveCamera>> {
        let CameraContent { camera, moved, model: stored } = content;
        let (id, moved) = (camera.id(), moved.map(Arc::new));
        let known = self.get(id);
        let same = known.as_ref().filter(|known| known.key == camera.key);
        if let (Some(replaced), None) = (&known, same) {
            replaced.live.end();
        }
        let loaded = same
            .filter(|known| known.moved == moved && !is_distrusted)
            .and_then(|known| Some((known.model.clone()?, known.model_summary.clone()?)));
        let mut model_fault = None;
        let model = match (camera.active_model.zip(stored), loaded) {
            (None, _) => None,
            (Some((number, _)), Some(loaded)) if loaded.0.1 == number => Some(loaded),
            (Some((number, stored)), _) => {
                match stored.read().and_then(|stored| restored(id, number, stored)) {
                    Ok((regressor, held_out)) => {
                        let summary = ModelSummary::new(held_out, regressor.clone());
                        // The error that the model states must contain the shift that was found.
                        let regressor = match &moved {
                            Some(moved) => Arc::new(regressor.with_added_error(moved.change_variance_m2())),
                            None => regressor,
                        };
                        Some(((regressor, number), Arc::new(summary)))
                    }
                    Err(error) => {
                        model_fault = Some(self.model_fault(id, number, error)?);
                        None
                    }
                }
            }
        };
        let (model, model_summary) = model.unzip();
        Ok(Arc::new(ActiveCamera {
            id: id.clone(),
            key: camera.key,
            moved,
            revision: camera.revision,
            image_size: camera.profile.image_size,
            e_gnss_m2: match camera.profile.gnss_error {
                GnssError::Known(sigma) => Some(sigma.variance_m2()),
                GnssError::Unknown => None,
            },
            live: same
                .map_or_else(|| CameraLive::new(self.event_log(camera.key)), |known| known.live.clone()),
            retrain_when_moved: camera.profile.retrain_when_moved,
            learn_automatically: camera.profile.learn_automatically,
            site: camera.profile.site,
            history: camera.profile.history,
            receivers: camera.profile.receivers,
            model,
            model_summary,
            model_fault,
        }))
    }

    /// The fault of a model that cannot be loaded; logged when it is found, not with every refresh.
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

/// The results of work on items, in their order. The calling thread waits meanwhile.
fn on_all_cores<T: Send, R: Send>(items: Vec<T>, work: impl Fn(T) -> R + Sync) -> Vec<R> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let share = items.len().div_ceil(cores).max(LEAST_PER_CORE);
    if items.len() <= share {
        return items.into_iter().map(work).collect();
    }
    let mut items = items.into_iter();
    let shares = std::iter::from_fn(|| Some(items.by_ref().take(share).collect::<Vec<T>>()));
    let shares: Vec<Vec<T>> = shares.take_while(|share| !share.is_empty()).collect();
    let work = &work;
    std::thread::scope(|scope| {
        let begin = |share: Vec<T>| scope.spawn(move || share.into_iter().map(work).collect::<Vec<R>>());
        let threads: Vec<_> = shares.into_iter().map(begin).collect();
        let joined = threads.into_iter().map(|thread| thread.join());
        joined.flat_map(|results| results.unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}

/// The known cameras that are not among all those stored.
fn missing(
    known: &HashMap<CameraId, Arc<ActiveCamera>>,
    stored: &[CameraVersion],
) -> Vec<(CameraId, CameraKey)> {
    let keys: HashMap<_, _> = stored.iter().map(|version| (&version.id, version.key)).collect();
    let missing = known.values().filter(|camera| keys.get(&camera.id) != Some(&camera.key));
    missing.map(|camera| (camera.id.clone(), camera.key)).collect()
}

/// The cameras to read: those that are known in another version or not at all, and those whose model could not be used.
fn stale(known: &HashMap<CameraId, Arc<ActiveCamera>>, versions: Vec<CameraVersion>) -> Vec<CameraId> {
    let is_current = |version: &CameraVersion| {
        known.get(&version.id).is_some_and(|camera| {
            let active = camera.model.as_ref().map(|(_, number)| *number);
            (camera.key, camera.revision, active) == (version.key, version.revision, version.active_model)
        })
    };
    let faulty = known.values().filter(|camera| camera.model_fault.is_some()).map(|camera| camera.id.clone());
    let changed = versions.into_iter().filter(|version| !is_current(version)).map(|version| version.id);
    changed.chain(faulty).collect::<BTreeSet<_>>().into_iter().collect()
}

/// A stored model version, ready to answer, with its error on held-out samples. Its answers were checked when it was
/// stored, and when it was activated; to check those of 10,000 models takes a minute.
///
/// # Errors
/// `ModelUnusable` if it cannot be read.
fn restored(
    id: &CameraId,
    number: u32,
    (metadata, weights): (ModelMetadata, Vec<u8>),
) -> Result<(Arc<Regressor>, Option<HeldOutError>)> {
    let artifact = Artifact { metadata, weights: weights.into() };
    let regressor = artifact.restore().map_err(|error| unusable(id, number, error))?;
    Ok((Arc::new(regressor), artifact.metadata.held_out))
}

/// The error of a stored version that does not pass the checks of a model.
pub(super) fn unusable(id: &CameraId, number: u32, error: Error) -> Error {
    match error {
        Error::Refused(refusal) => Error::refused(
            ErrorKind::ModelUnusable,
            format!("version {number} of camera {id} cannot be used: {}", Error::Refused(refusal)),
        ),
        fault @ Error::Fault(_) => fault,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::NewCamera;

    #[tokio::test]
    async fn a_refresh_under_way_does_not_bring_back_a_deleted_camera() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(folder.path()).await.expect("a new store");
        let (registry, id) = (Registry::default(), CameraId::new("yard").expect("a slug"));
        for _ in 0..50 {
            store.insert_camera(&NewCamera::named(id.clone()), Timestamp::UNIX_EPOCH).await.expect("new");
            let camera = registry.refresh_camera(&store, &id).await.expect("known");
            // Changed, so that the refresh has something to do.
            let changed = NewCamera { display_name: "gate".to_owned(), ..NewCamera::named(id.clone()) };
            store.replace_camera(&changed, None, Timestamp::UNIX_EPOCH).await.expect("changed");
            let delete = async {
                store.delete_camera(&id, None, Timestamp::UNIX_EPOCH).await.expect("deleted");
                registry.forget(&id).await;
            };
            let (refreshed, ()) = tokio::join!(registry.refresh(&store), delete);
            refreshed.expect("refreshed");
            assert!(registry.get(&id).is_none());
            assert!(camera.live.is_deleted(), "what listens to the camera ends");
        }
    }

    #[tokio::test]
    async fn tenures_do_not_continue_over_a_break_of_the_databases_history() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(folder.path()).await.expect("a new store");
        let (registry, id) = (Registry::default(), CameraId::new("yard").expect("a slug"));
        store.insert_camera(&NewCamera::named(id.clone()), Timestamp::UNIX_EPOCH).await.expect("new");
        let key = registry.refresh_camera(&store, &id).await.expect("known").key;
        assert!(!registry.begin_tenure(&id, key, 4).await, "the first");
        assert!(!registry.begin_tenure(&id, key, 5).await, "no other node had it in between");
        // A fail-over undoes fence 5, which another node gets.
        registry.distrust();
        assert!(registry.begin_tenure(&id, key, 6).await, "it begins anew");
        assert!(!registry.begin_tenure(&id, key, 7).await, "no break since");
        assert!(registry.begin_tenure(&id, key, 9).await, "another node had it");
    }
}
