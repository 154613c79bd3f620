//! Imports against rusqlite: the same rows into the same table and indexes.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use sightfix::domain::{CameraId, Durability, NewCamera, Sample};
use sightfix::exchange::{Format, write_samples};
use sightfix::simulation::{Options, Scene, simulate};

use crate::load;
use crate::ratio::{self, in_turn};
use crate::served::{Served, runtime};

/// Files of a round. Every few files SQLite copies its log into the database, which takes longer than a file; a round has
/// several of these.
const FILES: usize = 16;
const CLIENTS: usize = 256;
const EACH: usize = 40;

pub(crate) fn run() {
    let samples = simulate(&Options { samples: 10_000, ..Options::new(Scene::Square) }).training_samples();
    let runtime = runtime();
    let served = runtime.block_on(Served::start());
    let round = AtomicUsize::new(0);
    let new_camera = || {
        let name = format!("import-{}", round.fetch_add(1, Ordering::Relaxed));
        let id = CameraId::new(&name).expect("a slug");
        runtime.block_on(served.app.cameras().create(NewCamera::named(id.clone()))).expect("a new camera");
        id
    };
    ratio::head(
        "Import of rows, compared with one prepared statement of rusqlite in one transaction",
        "rows/s",
    );
    let csv = write_samples(Vec::new(), Format::Csv, &samples).expect("memory can be written");
    let csv = String::from_utf8(csv).expect("CSV is text");
    let folder = tempfile::tempdir().expect("a folder");
    let peer = Peer::open(folder.path(), &samples);
    for durability in [Durability::Synced, Durability::Relaxed] {
        let by_rest = || {
            let ids: Vec<CameraId> = (0..FILES).map(|_| new_camera()).collect();
            let path = |id: &CameraId| format!("/v1/cameras/{id}/samples?durability={durability}");
            let requests: Vec<_> = ids.iter().map(|id| load::post(&path(id), "text/csv", &csv)).collect();
            let began = Instant::now();
            for request in &requests {
                drop(runtime.block_on(load::one(served.address, request)));
            }
            let rate = (FILES * samples.len()) as f64 / began.elapsed().as_secs_f64();
            for id in &ids {
                let stored = runtime.block_on(served.app.samples().count(id, &Default::default()));
                assert_eq!(stored.expect("a count").all as usize, samples.len(), "every row is stored");
            }
            rate
        };
        ratio::row(
            &format!("{FILES} files of {} rows as CSV through REST, {durability}", samples.len()),
            &in_turn(by_rest, || peer.insert_all(FILES)),
        );
        let one_by_one = || {
            let id = new_camera();
            let (app, samples) = (served.app.clone(), Arc::new(samples.clone()));
            let began = Instant::now();
            runtime.block_on(async {
                let mut clients = tokio::task::JoinSet::new();
                for client in 0..CLIENTS {
                    let (app, id, samples) = (app.clone(), id.clone(), samples.clone());
                    clients.spawn(async move {
                        for sample in samples.iter().skip(client * EACH).take(EACH) {
                            let sample = vec![sample.clone()];
                            app.store.insert_samples(&id, sample, durability).await.expect("stored");
                        }
                    });
                }
                clients.join_all().await;
            });
            samples.len().min(CLIENTS * EACH) as f64 / began.elapsed().as_secs_f64()
        };
        ratio::row(
            &format!("single rows of {CLIENTS} clients, each acknowledged after its commit, {durability}"),
            &in_turn(one_by_one, || peer.insert_all(1)),
        );
    }
    served.end();
}

/// rusqlite on a database of its own with our schema.
struct Peer {
    connection: std::cell::RefCell<rusqlite::Connection>,
    samples: Vec<Sample>,
    round: AtomicUsize,
}

impl Peer {
    fn open(folder: &std::path::Path, samples: &[Sample]) -> Self {
        let made = runtime().block_on(async {
            let store = sightfix::store::Store::open(folder).await?;
            store.close().await;
            Ok::<(), sightfix::domain::Error>(())
        });
        made.expect("a new database");
        let connection = rusqlite::Connection::open(folder.join("sightfix.db")).expect("the database");
        connection.pragma_update(None, "synchronous", "NORMAL").expect("a setting of SQLite's");
        connection.pragma_update(None, "foreign_keys", true).expect("a setting of SQLite's");
        Self { connection: connection.into(), samples: samples.to_vec(), round: AtomicUsize::new(0) }
    }

    /// Rows per second of so many transactions, each for a camera of its own.
    fn insert_all(&self, transactions: usize) -> f64 {
        let seconds: f64 = (0..transactions).map(|_| self.insert().as_secs_f64()).sum();
        (transactions * self.samples.len()) as f64 / seconds
    }

    fn insert(&self) -> Duration {
        let round = self.round.fetch_add(1, Ordering::Relaxed);
        let mut connection = self.connection.borrow_mut();
        let camera: i64 = connection
            .query_row(
                "INSERT INTO cameras (id, profile, learn_automatically, revision, created_at_us, updated_at_us) \
                 VALUES (?, '{}', 0, 1, 0, 0) RETURNING key",
                [format!("peer-{round}")],
                |row| row.get(0),
            )
            .expect("a camera");
        let began = Instant::now();
        let transaction = connection.transaction().expect("a transaction");
        {
            let mut insert = transaction.prepare(INSERT).expect("the table");
            for sample in &self.samples {
                let [left, top, width, height] = sample.bounding_box.sides_px();
                insert
                    .execute(rusqlite::params![
                        camera,
                        sample.time.as_microsecond(),
                        sample.target_id.as_str(),
                        left,
                        top,
                        width,
                        height,
                        sample.fix.position.longitude_deg(),
                        sample.fix.position.latitude_deg(),
                        sample.fix.sigma_m.map(|sigma| sigma.metres()),
                        sample.class.as_ref().map(|class| class.as_str()),
                        sample.score.map(|score| score.value()),
                        sample.truth.map(|truth| truth.longitude_deg()),
                        sample.truth.map(|truth| truth.latitude_deg()),
                    ])
                    .expect("a row");
            }
        }
        transaction.commit().expect("a commit");
        began.elapsed()
    }
}

const INSERT: &str = "INSERT INTO samples (camera_key, time_us, target_id, left_px, top_px, width_px, height_px, \
    longitude_deg, latitude_deg, sigma_m, class, score, truth_longitude_deg, truth_latitude_deg) \
    VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING";
