//! A server as it is, in this process, with a trained camera.

use std::net::SocketAddr;

use sightfix::app::{App, RunRequest};
use sightfix::clock::{Clock, Randomness};
use sightfix::config::{Config, Limits};
use sightfix::domain::{CameraId, Durability, NewCamera, Observation};
use sightfix::server::Server;
use sightfix::shutdown::Shutdown;
use sightfix::simulation::{Options, simulate};
use tempfile::TempDir;

pub(crate) struct Served {
    pub(crate) app: App,
    pub(crate) address: SocketAddr,
    pub(crate) camera: CameraId,
    pub(crate) observations: Vec<Observation>,
    shutdown: Shutdown,
    _folder: TempDir,
}

impl Served {
    /// Starts on the runtime of the caller.
    pub(crate) async fn start() -> Self {
        Self::start_with(1).await
    }

    /// Starts with `workers` training workers.
    pub(crate) async fn start_with(workers: usize) -> Self {
        Self::start_limited(workers, Limits::default()).await
    }

    /// Starts with these limits.
    pub(crate) async fn start_limited(workers: usize, limits: Limits) -> Self {
        Self::start_configured(workers, |config| config.limits = limits).await
    }

    /// Starts with settings that a function changes.
    pub(crate) async fn start_configured(workers: usize, configure: impl FnOnce(&mut Config)) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let mut config = Config { data: folder.path().to_owned(), ..Config::default() };
        config.listen.set_port(0);
        configure(&mut config);
        config.training.workers = workers;
        let server = Server::bind(config, Clock::system(), Randomness::seeded(1)).await.expect("a free port");
        let (app, address, shutdown) =
            (server.app().clone(), server.address().expect("an address"), server.shutdown());
        tokio::spawn(async move { server.run().await.expect("the server ends in order") });
        let camera = CameraId::new("bench").expect("a slug");
        let world = simulate(&Options::demo());
        let profile = NewCamera { image_size: Some(world.image_size), ..NewCamera::named(camera.clone()) };
        app.cameras().create(profile).await.expect("a new camera");
        let samples = world.training_samples();
        let observations = samples
            .iter()
            .map(|sample| {
                let target_id = Some(sample.target_id.clone());
                Observation::with_fix(sample.time, target_id, Some(sample.bounding_box), sample.fix)
            })
            .collect();
        app.store.insert_samples(&camera, samples, Durability::Synced).await.expect("samples are stored");
        let served = Self { app, address, camera, observations, shutdown, _folder: folder };
        // As an operator who says nothing more gets it.
        served.train(RunRequest::default()).await;
        served
    }

    /// Trains and waits.
    pub(crate) async fn train(&self, request: RunRequest) {
        let run = self.app.training().start(&self.camera, request, None).await.expect("a run");
        loop {
            let run = self.app.training().get(&self.camera, run.id).await.expect("the run");
            if run.state.has_ended() {
                assert!(run.model_version.is_some(), "{:?}", run.outcome);
                return;
            }
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    }

    pub(crate) fn end(&self) {
        self.shutdown.drain();
    }
}

/// As many threads as the machine has cores.
pub(crate) fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime")
}
