//! The rules of the store, each shown on a file of its own.

mod cameras;
mod evaluations;
mod file;
mod group;
mod models;
mod runs;
mod samples;

use jiff::Timestamp;
use tempfile::TempDir;
use uuid::Uuid;

use super::Store;
use crate::domain::{
    BoundingBox, CameraId, Durability, ErrorKind, Fix, GnssErrorSource, ModelMetadata, NewCamera, OriginDeg,
    Recipe, Result, RunId, Sample, TargetId, TrainingOptions,
};
use crate::geo::Position;

/// A store with the camera `square`, in a folder that is deleted with it.
struct Fixture {
    folder: TempDir,
    store: Store,
    camera: CameraId,
}

impl Fixture {
    async fn new() -> Self {
        let folder = TempDir::new().expect("a folder");
        let store = Store::open(folder.path()).await.expect("opens");
        let camera = id("square");
        store.insert_camera(&NewCamera::named(camera.clone()), at(0)).await.expect("new");
        Self { folder, store, camera }
    }

    /// Executes statements without the checks of the store.
    async fn tamper(&self, sql: &'static str) {
        let mut writer = self.store.relaxed().await.expect("the writer");
        let mut transaction = writer.begin().await.expect("begins");
        sqlx::raw_sql(sql).execute(&mut *transaction).await.expect("runs");
        transaction.commit().await.expect("commits");
    }
}

fn id(text: &str) -> CameraId {
    CameraId::new(text).expect("a slug")
}

/// So many seconds into a day of 2020.
fn at(second: i64) -> Timestamp {
    Timestamp::from_second(1_607_900_000 + second).expect("in range")
}

fn target(text: &str) -> TargetId {
    TargetId::new(text).expect("a name")
}

fn sample(second: i64, target_id: &str) -> Sample {
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
fn run_id(n: u128) -> RunId {
    RunId(Uuid::from_u128(n))
}

fn options() -> TrainingOptions {
    TrainingOptions {
        recipe: Recipe::Hybrid,
        seed: u64::MAX - 3,
        epochs: Some(7),
        from: None,
        until: Some(at(9)),
    }
}

fn metadata() -> ModelMetadata {
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
        parameters: std::collections::BTreeMap::new(),
    }
}

fn kind<T: std::fmt::Debug>(outcome: Result<T>) -> ErrorKind {
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
    movable(store.insert_run(run, &camera, &options(), 1, at(0)));
    movable(store.claim_run(lease, at(0)));
    movable(store.heartbeat_run(run, 1, &crate::domain::RunProgress::default(), lease, at(0)));
    movable(store.append_epochs(run, 1, &[]));
    movable(store.finish_run(run, 1, super::RunEnd::Cancelled, at(0)));
    movable(store.claim_evaluation(lease, at(0)));
    movable(store.roll_back(&camera, at(0)));
}
