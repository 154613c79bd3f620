//! Streams that share a camera's recorder, under thousands of orders of their steps: what is acknowledged is stored.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use sightfix_schedules::{below, block_on, explore, explore_planted, pause, spawn};
use tokio::runtime::Builder;

use super::acknowledgements::AckTracker;
use super::sample_committer::{SampleSink, SampleStore, start};
use super::sample_recorder::{SampleRecorder, UnpairedItem};
use super::sync::lock;
use crate::domain::{CameraId, CameraKey, Detection, Durability, Error, ErrorKind, Result, Sample, TargetId};
use crate::simulation::{Options, simulate};
use crate::store::Inserted;
use crate::telemetry::Metrics;

/// Items of a stream.
const ITEMS: usize = 6;

/// An error of what stores samples.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Planted {
    None,
    /// It answers before it has stored.
    AnswersFirst,
}

/// Stored samples, by target and time in microseconds.
type Table = Arc<Mutex<BTreeSet<(TargetId, i64)>>>;

struct Model {
    table: Table,
    planted: Planted,
}

impl SampleStore for Model {
    async fn insert(
        &self,
        _: (&CameraId, CameraKey),
        samples: Vec<Sample>,
        _: Durability,
    ) -> Result<Inserted> {
        pause().await;
        if below(16) == 0 {
            return Err(Error::refused(ErrorKind::InsufficientStorage, "there is no space"));
        }
        let inserted = Inserted { accepted: samples.len() as u64, ..Inserted::default() };
        let table = Arc::clone(&self.table);
        let store = move || lock(&table).extend(samples.iter().map(key));
        if self.planted == Planted::AnswersFirst {
            drop(spawn(async move {
                pause().await;
                store();
            }));
        } else {
            store();
            pause().await;
        }
        Ok(inserted)
    }
}

fn key(sample: &Sample) -> (TargetId, i64) {
    (sample.target_id.clone(), sample.time.as_microsecond())
}

/// The items of a stream: whole samples and halves of samples whose other half comes by the other stream.
#[derive(Clone)]
enum Item {
    Whole(Sample),
    Half(Sample),
}

impl Item {
    const fn sample(&self) -> &Sample {
        match self {
            Self::Whole(sample) | Self::Half(sample) => sample,
        }
    }
}

/// Sends items as stream `number`, and checks every acknowledgement; whether all was settled.
async fn stream(recorder: Arc<SampleRecorder>, table: Table, number: usize, items: Vec<Item>) -> bool {
    let tracker = AckTracker::beginning_after(0, Durability::default());
    let check = || {
        let acknowledged = tracker.acknowledgement();
        let settled = usize::try_from(acknowledged.seq).expect("few");
        let not_stored: u64 = acknowledged.not_stored.iter().map(|reason| reason.count).sum();
        let missing = {
            let table = lock(&table);
            items[..settled].iter().filter(|item| !table.contains(&key(item.sample()))).count()
        };
        assert!(missing as u64 <= not_stored, "{missing} samples are acknowledged and not stored");
        acknowledged
    };
    for (index, item) in items.iter().enumerate() {
        let seq = index as u64 + 1;
        let sample = item.sample().clone();
        let sent = match item {
            Item::Whole(_) => recorder.push_sample(&tracker, seq, sample).await,
            Item::Half(_) if number == 0 => {
                let Sample { time, target_id, bounding_box, .. } = sample;
                let detection = Detection { time, target_id, bounding_box, class: None, score: None };
                recorder.push_unpaired(&tracker, seq, UnpairedItem::Box(detection)).await
            }
            Item::Half(_) => {
                let item = UnpairedItem::Fix(sample.target_id, sample.time, sample.fix);
                recorder.push_unpaired(&tracker, seq, item).await
            }
        };
        check();
        if sent.is_err() {
            return false;
        }
        pause().await;
        check();
    }
    let ended = recorder.end_stream(&tracker).await.is_ok() && tracker.settled().await.is_ok();
    let acknowledged = check();
    if ended {
        assert_eq!(acknowledged.seq, items.len() as u64, "all is settled at the end");
        let not_stored: u64 = acknowledged.not_stored.iter().map(|reason| reason.count).sum();
        assert_eq!(acknowledged.stored + not_stored, items.len() as u64, "each item has one outcome");
    }
    ended
}

fn scenario(samples: &[Sample], metrics: &Metrics, planted: Planted) {
    let of = |number: usize| {
        let item = |index: usize| match index % 2 {
            0 => Item::Whole(samples[ITEMS * (number + 1) + index].clone()),
            _ => Item::Half(samples[index].clone()),
        };
        (0..ITEMS).map(item).collect::<Vec<_>>()
    };
    let table = Table::default();
    let sink = SampleSink {
        store: Model { table: Arc::clone(&table), planted },
        metrics: metrics.clone(),
        id: CameraId::new("yard").expect("a slug"),
        key: CameraKey(1),
    };
    block_on(async {
        let mut committer = None;
        let recorder = start(sink, |task| committer = Some(spawn(task)));
        let streams: Vec<_> = (0..2)
            .map(|number| spawn(stream(Arc::clone(&recorder), Arc::clone(&table), number, of(number))))
            .collect();
        drop(recorder);
        for stream in streams {
            stream.await.expect("no panic");
        }
        // It ends with the last stream.
        committer.expect("started").await.expect("no panic");
    });
}

fn explored(planted: Planted) -> impl Fn() + Send + Sync + 'static {
    let samples = simulate(&Options { samples: 3 * ITEMS, ..Options::demo() }).training_samples();
    let metrics = Metrics::new();
    // Its clock stands still: no target falls silent within a schedule.
    let runtime = Builder::new_current_thread().enable_time().build().expect("a runtime");
    move || {
        let _within = runtime.enter();
        scenario(&samples, &metrics, planted);
    }
}

#[test]
fn what_streams_are_told_is_stored() {
    explore(explored(Planted::None));
}

#[test]
fn an_acknowledgement_before_the_commit_is_found() {
    explore_planted("acknowledged and not stored", explored(Planted::AnswersFirst));
}
