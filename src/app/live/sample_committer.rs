//! The task that commits what a camera's recorder has decided, in order, and acknowledges it.

use std::sync::{Arc, Weak};
use std::time::Duration;

use tokio::sync::mpsc;

use super::sample_recorder::{Commit, SampleRecorder};
use crate::domain::{CameraId, CameraKey, Durability, Error, Result, Sample};
use crate::store::{Inserted, Store};
use crate::telemetry::Metrics;

/// How often silent targets are looked for.
const TICK: Duration = Duration::from_secs(1);

/// What stores the samples of a camera.
pub(super) trait SampleStore: Send + Sync + 'static {
    /// As [`Store::insert_samples_of`].
    fn insert(
        &self,
        camera: (&CameraId, CameraKey),
        samples: Vec<Sample>,
        durability: Durability,
    ) -> impl Future<Output = Result<Inserted>> + Send;
}

impl SampleStore for Store {
    async fn insert(
        &self,
        (id, key): (&CameraId, CameraKey),
        samples: Vec<Sample>,
        durability: Durability,
    ) -> Result<Inserted> {
        self.insert_samples_of(id, key, samples, durability).await
    }
}

/// Where samples go.
pub(super) struct SampleSink<S> {
    pub(super) store: S,
    pub(super) metrics: Metrics,
    pub(super) id: CameraId,
    pub(super) key: CameraKey,
}

/// Commits until the recorder is dropped with its last stream and the queue is empty, or a commit fails.
pub(super) async fn commit_all(
    recorder: Weak<SampleRecorder>,
    mut queue: mpsc::Receiver<Commit>,
    sink: SampleSink<impl SampleStore>,
) {
    let mut tick = tokio::time::interval(TICK);
    loop {
        let mut commit = tokio::select! {
            // A tick decides nothing as long as the queue is not empty.
            biased;
            commit = queue.recv() => match commit {
                Some(commit) => commit,
                None => return,
            },
            _ = tick.tick() => {
                let Some(recorder) = recorder.upgrade() else { continue };
                recorder.end_silent_targets(|| queue.is_empty())
            }
        };
        while let Ok(more) = queue.try_recv() {
            commit.append(more);
        }
        if let Err(error) = sink.store(commit).await {
            sink.fail(&recorder, &mut queue, &error);
            return;
        }
    }
}

impl<S: SampleStore> SampleSink<S> {
    async fn store(&self, commit: Commit) -> Result<()> {
        let Commit { samples, released, .. } = commit;
        if !samples.is_empty() {
            // Streams share a commit: the strongest durability that one of them asks for holds for all of it.
            let durability = released.iter().map(|item| item.tag.durability()).max().unwrap_or_default();
            match self.store.insert((&self.id, self.key), samples, durability).await {
                Ok(inserted) => self.metrics.imported(inserted.accepted, inserted.duplicate, 0),
                Err(error) => {
                    released.iter().for_each(|item| item.tag.fail(error.kind()));
                    return Err(error);
                }
            }
        }
        released.into_iter().for_each(|item| item.tag.ack(item.outcome));
        Ok(())
    }

    /// Ends every stream with something pending; none of it is acknowledged.
    fn fail(&self, recorder: &Weak<SampleRecorder>, queue: &mut mpsc::Receiver<Commit>, error: &Error) {
        if matches!(error, Error::Fault(_)) {
            tracing::error!(camera.id = %self.id, %error, "the samples of a stream cannot be stored");
        }
        queue.close();
        while let Ok(commit) = queue.try_recv() {
            commit.released.iter().for_each(|item| item.tag.fail(error.kind()));
        }
        if let Some(recorder) = recorder.upgrade() {
            recorder.fail(error.kind());
        }
    }
}

/// Starts a recorder with its task; `spawn` runs the task until it ends by itself.
pub(super) fn start(
    sink: SampleSink<impl SampleStore>,
    spawn: impl FnOnce(std::pin::Pin<Box<dyn Future<Output = ()> + Send>>),
) -> Arc<SampleRecorder> {
    let (recorder, queue) = SampleRecorder::new();
    spawn(Box::pin(commit_all(Arc::downgrade(&recorder), queue, sink)));
    recorder
}

#[cfg(test)]
mod tests {
    use super::super::acknowledgements::AckTracker;
    use super::*;
    use crate::simulation::{Options, simulate};

    #[tokio::test]
    async fn a_failed_commit_ends_every_stream_and_acknowledges_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(folder.path()).await.expect("a new store");
        let id = CameraId::new("nowhere").expect("a slug");
        let sink = SampleSink { store, metrics: Metrics::new(), id, key: CameraKey(1) };
        let recorder = start(sink, |task| drop(tokio::spawn(task)));
        let samples = simulate(&Options { samples: 2, ..Options::demo() }).training_samples();
        let (first, second) = (
            AckTracker::beginning_after(0, Durability::default()),
            AckTracker::beginning_after(7, Durability::default()),
        );
        recorder.push_sample(&first, 1, samples[0].clone()).await.expect("handed in");
        while first.is_settled().is_ok() {
            first.changed().await;
        }
        assert_eq!(first.acknowledgement().seq, 0);
        assert!(recorder.has_failed());
        // The other stream had nothing in the commit that failed.
        assert!(second.is_settled().is_ok());
        recorder.push_sample(&second, 8, samples[1].clone()).await.expect_err("stored by nobody");
        second.is_settled().expect_err("must end");
        assert_eq!(second.acknowledgement().seq, 7);
    }
}
