//! Tests of what both backends promise. Every case has a file of its own, or, where `SIGHTFIX_TEST_POSTGRES` is the URL
//! of a server's database, a database of its own on that server (`.ci/postgres`).

mod cameras;
mod connections;
pub(super) mod copy;
mod evaluations;
pub(super) mod group;
mod idempotency;
mod keys;
mod models;
mod places;
mod recordings;
mod runs;
mod samples;
mod schedules;
mod site_runs;

use std::sync::Arc;

use jiff::Timestamp;
use tempfile::TempDir;
use uuid::Uuid;

use super::database::Backend;
use super::{DatabaseUrl, Location, Store, StoreOptions, on_backend};
use crate::domain::{
    BoundingBox, CameraId, Durability, ErrorKind, Fix, GnssErrorSource, ModelMetadata, NewCamera, OriginDeg,
    Recipe, Result, RunId, Sample, TargetId, TrainingOptions,
};
use crate::geo::Position;

/// Where the store of a case is.
pub(super) enum Home {
    Folder(Arc<TempDir>),
    Database(DatabaseUrl),
}

impl Home {
    async fn new() -> Self {
        match std::env::var("SIGHTFIX_TEST_POSTGRES") {
            Ok(url) => Self::Database(new_database(&url).await),
            Err(_) => Self::Folder(Arc::new(TempDir::new().expect("a folder"))),
        }
    }

    pub(super) fn location(&self) -> Location {
        match self {
            Self::Folder(folder) => Location::Folder(folder.path().to_owned()),
            Self::Database(url) => Location::Database(url.clone()),
        }
    }

    pub(super) async fn open(&self) -> Store {
        Store::open_at(&self.location(), StoreOptions::default()).await.expect("opens")
    }
}

/// A connection of a case's own, which a pooler takes too.
pub(super) async fn connect(url: &str) -> sqlx::PgConnection {
    use sqlx::Connection as _;

    let options: sqlx::postgres::PgConnectOptions = url.parse().expect("a URL");
    let options = options.extra_float_digits(None::<i8>);
    sqlx::PgConnection::connect_with(&options).await.expect("the server of SIGHTFIX_TEST_POSTGRES")
}

/// A database that nobody else uses.
pub(super) async fn new_database(server: &str) -> DatabaseUrl {
    use sqlx::Connection as _;

    static NUMBER: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    let name = format!("case_{}_{number}", std::process::id());
    let mut connection = connect(server).await;
    let create = sqlx::AssertSqlSafe(format!("CREATE DATABASE {name}"));
    sqlx::raw_sql(create).execute(&mut connection).await.expect("a database");
    connection.close().await.expect("closes");
    let (server, _) = server.rsplit_once('/').expect("a URL with a database");
    DatabaseUrl::new(&format!("{server}/{name}")).expect("a URL")
}

/// A store with the camera `square`, in a place of its own.
pub(super) struct Fixture {
    pub(super) folder: Home,
    pub(super) store: Store,
    pub(super) camera: CameraId,
}

impl Fixture {
    async fn new() -> Self {
        Self::at(Home::new().await).await
    }

    pub(super) async fn at(folder: Home) -> Self {
        let store = folder.open().await;
        let camera = id("square");
        store.insert_camera(&NewCamera::named(camera.clone()), at(0)).await.expect("new");
        Self { folder, store, camera }
    }

    /// Executes statements without the checks of the store.
    pub(super) async fn tamper(&self, sql: &'static str) {
        on_backend!(self.store, store => store.tamper(sql).await);
    }

    /// Lets the leases of all jobs expire, by whichever clock they are measured.
    async fn let_leases_expire(&self) {
        self.tamper(
            "UPDATE training_runs SET lease_until_us = 1 WHERE state = 'running'; \
             UPDATE site_training_runs SET lease_until_us = 1 WHERE state = 'running'; \
             UPDATE evaluations SET lease_until_us = 1 WHERE state = 'running'",
        )
        .await;
    }

    /// Sets the clock back by 400 days, as the leases of training runs see it.
    async fn set_clock_back(&self) {
        self.tamper("UPDATE training_runs SET lease_until_us = lease_until_us + 34560000000000").await;
    }

    /// As [`Fixture::tamper`], in the words of each backend.
    async fn tamper_each(&self, sqlite: &'static str, postgres: &'static str) {
        match &self.store.0.backend {
            Backend::Sqlite(store) => store.tamper(sqlite).await,
            Backend::Postgres(store) => store.tamper(postgres).await,
        }
    }
}

pub(super) fn id(text: &str) -> CameraId {
    CameraId::new(text).expect("a slug")
}

/// An instant this number of seconds into a day of 2020.
pub(super) fn at(second: i64) -> Timestamp {
    Timestamp::from_second(1_607_900_000 + second).expect("in range")
}

fn target(text: &str) -> TargetId {
    TargetId::new(text).expect("a name")
}

pub(super) fn sample(second: i64, target_id: &str) -> Sample {
    let offset = second as f64;
    Sample {
        time: at(second),
        target_id: target(target_id),
        bounding_box: BoundingBox::new(0.1 + offset, 20.3, 31.7, 60.9).expect("a box"),
        fix: Fix { position: Position::new(120.1 + 1e-7 * offset, 30.2).expect("a place"), sigma_m: None },
        class: None,
        score: None,
        truth: None,
    }
}

/// The nth run's id; ids sort by n.
pub(super) fn run_id(n: u128) -> RunId {
    RunId(Uuid::from_u128(n))
}

pub(super) fn options() -> TrainingOptions {
    TrainingOptions {
        recipe: Recipe::Hybrid,
        seed: u64::MAX - 3,
        epochs: Some(7),
        from: None,
        until: Some(at(9)),
    }
}

pub(super) fn metadata() -> ModelMetadata {
    ModelMetadata {
        format: 1,
        requested_recipe: "auto".to_owned(),
        recipe: "hybrid".to_owned(),
        features: Vec::new(),
        origin: OriginDeg { longitude_deg: 120.5, latitude_deg: 30.25 },
        seed: 1,
        epochs: 7,
        training_rows_sha256: "00".to_owned(),
        samples: 10,
        targets: 1,
        passes: 1,
        error_scale: 0.5,
        e_gnss_m2: 4.0,
        e_gnss_source: GnssErrorSource::Estimated,
        held_out: None,
        candidates: Vec::new(),
        report: None,
        joint_training: None,
        parameters: std::collections::BTreeMap::new(),
    }
}

pub(super) fn kind<T: std::fmt::Debug>(outcome: Result<T>) -> ErrorKind {
    outcome.expect_err("is refused").kind()
}

/// Handlers run on any thread, so every future of the store must be able to move between threads.
#[tokio::test]
async fn futures_can_move_between_threads() {
    fn movable<F: Future + Send>(_: F) {}
    let Fixture { store, camera, folder: _folder } = Fixture::new().await;
    let (filter, run, lease) = (super::SampleFilter::default(), run_id(1), std::time::Duration::ZERO);
    movable(Store::open(std::path::Path::new("none")));
    movable(store.close());
    movable(store.ping());
    movable(store.cameras(None, Some(&camera), 1));
    movable(store.delete_camera(&camera, None, at(9)));
    movable(store.insert_samples(&camera, Vec::<Sample>::new(), Durability::Synced));
    movable(store.samples(&camera, &filter, None, 1));
    movable(store.delete_samples(&camera, &filter, at(9)));
    movable(store.insert_run(run, &camera, &options(), 1, None, at(0)));
    movable(store.claim_run::<CameraId>(lease, at(0)));
    movable(store.heartbeat_run::<CameraId>(run, 1, &crate::domain::RunProgress::default(), lease, at(0)));
    movable(store.append_epochs(run, 1, &[]));
    movable(store.finish_run::<CameraId>(run, 1, super::RunEnd::Cancelled, at(0)));
    movable(store.claim_evaluation(lease, at(0)));
    movable(store.roll_back(&camera, at(0)));
}
