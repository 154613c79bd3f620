//! One client's live stream: its slot, its items, its acknowledgements.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use jiff::Timestamp;
use tokio::sync::watch;

use super::ItemResult;
use super::acknowledgements::{AckTracker, Acknowledgement, NotStoredReason};
use super::camera::{StreamCount, UnplacedBox};
use super::sample_committer::{self, SampleSink};
use super::sample_recorder::{SampleRecorder, UnpairedItem};
use super::sync::lock;
use crate::admission::{ClientId, Lease};
use crate::app::App;
use crate::app::cluster::CameraLease;
use crate::app::registry::ActiveCamera;
use crate::domain::{
    CameraId, CameraMoved, Detection, Durability, Error, ErrorKind, LiveItem, Observation, Result, Sample,
    Score, check_text,
};

/// How long a request waits until its items are decided by what comes after them; then they are decided.
/// Silent targets are decided after the allowed lateness, so this is reached only if another client goes on
/// sending earlier times.
const PAIRING_PATIENCE: Duration = Duration::from_secs(10);
/// Longest name of a client, in bytes.
const LONGEST_CLIENT_NAME: usize = 128;

/// Streams that are open, counted by client.
#[derive(Default)]
pub(in crate::app) struct StreamSlots(Arc<Mutex<HashMap<String, usize>>>);

/// A stream's slot; free again when dropped.
struct SlotGuard {
    slots: Arc<Mutex<HashMap<String, usize>>>,
    client: String,
}

impl StreamSlots {
    fn take(&self, client: &str, most: usize, most_of_client: usize) -> Result<SlotGuard> {
        let mut open = lock(&self.0);
        if open.values().sum::<usize>() >= most {
            return Err(overloaded(format!("{most} live streams are open already; try again later")));
        }
        let of_client = open.entry(client.to_owned()).or_default();
        if *of_client >= most_of_client {
            return Err(overloaded(format!("this client has {most_of_client} live streams open already")));
        }
        *of_client += 1;
        Ok(SlotGuard { slots: self.0.clone(), client: client.to_owned() })
    }
}

impl Drop for SlotGuard {
    fn drop(&mut self) {
        let mut open = lock(&self.slots);
        if let Some(of_client) = open.get_mut(&self.client) {
            *of_client -= 1;
            if *of_client == 0 {
                open.remove(&self.client);
            }
        }
    }
}

fn overloaded(message: String) -> Error {
    Error::refused(ErrorKind::Overloaded, message)
}

/// An open stream.
pub struct LiveStream {
    app: App,
    /// As it was when the stream was opened; its key and its live state do not change.
    camera: Arc<ActiveCamera>,
    /// `None` only while it is dropped.
    lease: Option<CameraLease>,
    recording: Option<StreamRecording>,
    last_seq: u64,
    _slot: SlotGuard,
    _count: StreamCount,
    _client_lease: Lease,
}

struct StreamRecording {
    recorder: Arc<SampleRecorder>,
    tracker: Arc<AckTracker>,
}

/// The pairing that all storing streams of the camera share.
fn recorder_of(app: &App, camera: &ActiveCamera) -> Arc<SampleRecorder> {
    let mut shared = lock(&camera.live.recorder);
    match shared.upgrade().filter(|recorder| !recorder.has_failed()) {
        Some(recorder) => recorder,
        None => {
            let sink = SampleSink {
                store: app.store.clone(),
                metrics: app.metrics.clone(),
                id: camera.id.clone(),
                key: camera.key,
            };
            let recorder = sample_committer::start(sink, |task| drop(app.tasks.spawn(task)));
            *shared = Arc::downgrade(&recorder);
            recorder
        }
    }
}

impl LiveStream {
    /// Opens a live stream of one client for one camera. With `store_samples` boxes and fixes are
    /// paired and stored, and items acknowledged, both with that durability.
    ///
    /// # Errors
    /// `CameraNotFound`; `InvalidArgument` naming `client_name`; `Overloaded` beyond the limits of
    /// streams; `CameraOnOtherNode`, `CameraBetweenNodes`.
    pub async fn open(
        app: &App,
        id: &CameraId,
        client_name: &str,
        client_id: ClientId,
        resume_after_seq: u64,
        store_samples: Option<Durability>,
    ) -> Result<Self> {
        check_text("client_name", client_name, LONGEST_CLIENT_NAME)?;
        app.active_camera(id).await?;
        let limits = &app.limits;
        // Names are the client's choice; its address is not.
        let client_lease = app.quotas.live_streams.try_acquire(client_id, 1)?;
        let slot = app.stream_slots.take(client_name, limits.live_streams, limits.live_streams_per_client)?;
        let (camera, lease) = app.nodes().own_camera(id).await?;
        let recording = store_samples.map(|durability| StreamRecording {
            recorder: recorder_of(app, &camera),
            tracker: AckTracker::beginning_after(resume_after_seq, durability),
        });
        app.metrics.stream_opened();
        Ok(Self {
            app: app.clone(),
            _count: camera.live.count_stream(),
            camera,
            lease: Some(lease),
            recording,
            last_seq: resume_after_seq,
            _slot: slot,
            _client_lease: client_lease,
        })
    }

    /// Answers observations as [`Live::follow`](super::Live::follow) and stores samples of them, and of what the camera's streams
    /// bring. Returns when it is decided what becomes of each.
    ///
    /// # Errors
    /// As [`LiveStream::open`] and [`Live::follow`](super::Live::follow); the samples could not be stored.
    pub async fn follow_and_store(
        app: &App,
        camera: &Arc<ActiveCamera>,
        observations: Vec<Observation>,
        client: ClientId,
        durability: Durability,
    ) -> Result<(Vec<ItemResult>, Acknowledgement)> {
        let name = format!("requests of {}", camera.id);
        let mut stream = Self::open(app, &camera.id, &name, client, 0, Some(durability)).await?;
        let mut followed = Vec::with_capacity(observations.len());
        for (seq, observation) in (1..).zip(observations) {
            stream.check_seq(seq)?;
            let now = app.clock.now();
            followed.push(stream.observe(camera, (seq, now), observation, None).await?);
        }
        // Deciding early would take other requests' and streams' items from each other.
        stream.settle_within(PAIRING_PATIENCE).await?;
        let acknowledgement = stream.acknowledgement()?;
        Ok((followed, acknowledgement.ok_or_else(|| Error::fault("a stream that stores nothing"))?))
    }

    /// The model version that answers now.
    #[must_use]
    pub fn model_version(&self) -> Option<u32> {
        self.current_camera().ok()?.model.as_ref().map(|(_, version)| *version)
    }

    /// The camera as it is now.
    ///
    /// # Errors
    /// `CameraNotFound` if it was deleted, even if another has its id now.
    pub fn current_camera(&self) -> Result<Arc<ActiveCamera>> {
        let current = self.app.registry.get(&self.camera.id);
        current.filter(|camera| camera.key == self.camera.key).ok_or_else(|| self.camera_deleted())
    }

    /// Waits until the camera is deleted, or this node is no longer surely its owner.
    pub async fn ended(&self) -> Error {
        let lost = async {
            match &self.lease {
                Some(lease) => lease.ended().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = self.camera.live.deleted() => self.camera_deleted(),
            error = lost => error,
        }
    }

    fn lease(&self) -> Result<&CameraLease> {
        self.lease.as_ref().ok_or_else(|| self.camera_deleted())
    }

    fn camera_deleted(&self) -> Error {
        Error::refused(ErrorKind::CameraNotFound, format!("camera {} was deleted", self.camera.id))
    }

    /// When items are acknowledged; `None` on a stream that stores nothing.
    #[must_use]
    pub fn durability(&self) -> Option<Durability> {
        self.recording.as_ref().map(|recording| recording.tracker.durability())
    }

    /// Checks that seqs rise; an item that cannot be read has one, too.
    ///
    /// # Errors
    /// `InvalidArgument` naming `seq`.
    pub fn check_seq(&mut self, seq: u64) -> Result<()> {
        if seq <= self.last_seq {
            return Err(Error::invalid(
                "seq",
                format!("must be above {}, that of the item before", self.last_seq),
            ));
        }
        self.last_seq = seq;
        Ok(())
    }

    /// Acknowledges an item that was answered with an error.
    pub fn ack_refused(&self, seq: u64) {
        self.ack_without_storing(seq, NotStoredReason::Refused);
    }

    fn ack_without_storing(&self, seq: u64, reason: NotStoredReason) {
        if let Some(StreamRecording { tracker, .. }) = &self.recording {
            tracker.ack_without_storing(seq, reason);
        }
    }

    /// Takes an item: its own position, its target's track with it, and its part in a sample. `now` is a reading of the
    /// wall clock after the item had come.
    ///
    /// # Errors
    /// `CameraBetweenNodes`, which ends the stream; `InvalidArgument` for neither box nor fix, or for a time ahead of the server's clock, naming the
    /// field; as [`Live::follow`](super::Live::follow).
    pub async fn take(
        &self,
        camera: &Arc<ActiveCamera>,
        seq: u64,
        item: LiveItem,
        now: Timestamp,
    ) -> Result<ItemResult> {
        let (target_id, time, fix) = match (item.target_id, &item.receiver_id) {
            (None, Some(receiver_id)) => {
                let (target_id, time) = camera.receivers.resolve(receiver_id, item.time);
                let fix = item.fix.map(|fix| camera.receivers.with_sigma(receiver_id, fix));
                (Some(target_id), time, fix)
            }
            (target_id, _) => (target_id, item.time, item.fix),
        };
        let observation =
            Observation::new(time, target_id, item.bounding_box, fix)?.with_tracker_id(item.tracker_id)?;
        self.observe(camera, (seq, now), observation.with_class(item.class), item.score).await
    }

    /// Takes an observation as [`LiveStream::take`] does. The lease is checked where the live state changes; a sample that
    /// was recorded before is a duplicate once the client repeats the item.
    async fn observe(
        &self,
        camera: &Arc<ActiveCamera>,
        (seq, now): (u64, Timestamp),
        observation: Observation,
        score: Option<Score>,
    ) -> Result<ItemResult> {
        // A time that no track takes must not move the pairing either.
        let time = observation.time();
        self.app.limits.live_time_bounds(now).check(time)?;
        if let Some(bounding_box) = observation.bounding_box().filter(|_| camera.model().is_none()) {
            camera.live.announce_box(self.app.clock.monotonic(), || UnplacedBox {
                time,
                target_id: observation.target_id().cloned(),
                tracker_id: observation.tracker_id().cloned(),
                bounding_box,
                class: observation.class().cloned(),
                score,
            });
        }
        let live = self.app.live();
        let identified = live.identify(camera, observation);
        if identified.is_sure {
            self.record(seq, &identified.of_sample(), score).await?;
        } else {
            self.ack_without_storing(seq, NotStoredReason::Unmatched);
        }
        live.follow_identified((camera, self.lease()?), identified, now)
    }

    async fn record(&self, seq: u64, observation: &Observation, score: Option<Score>) -> Result<()> {
        let Some(StreamRecording { recorder, tracker }) = &self.recording else { return Ok(()) };
        let time = observation.time();
        let Some(target_id) = observation.target_id().cloned() else {
            self.ack_without_storing(seq, NotStoredReason::NoTarget);
            return Ok(());
        };
        let class = observation.class().cloned();
        match (observation.bounding_box(), observation.fix()) {
            (Some(bounding_box), Some(fix)) => {
                let sample = Sample { time, target_id, bounding_box, fix, class, score, truth: None };
                recorder.push_sample(tracker, seq, sample).await
            }
            (Some(bounding_box), None) => {
                let detection = Detection { time, target_id, bounding_box, class, score };
                recorder.push_unpaired(tracker, seq, UnpairedItem::Box(detection)).await
            }
            (None, Some(fix)) => {
                recorder.push_unpaired(tracker, seq, UnpairedItem::Fix(target_id, time, fix)).await
            }
            (None, None) => Ok(()),
        }
    }

    /// Returns the items that are settled; `None` on a stream that stores nothing.
    ///
    /// # Errors
    /// The samples could not be stored; the stream must end, for nothing after them is acknowledged.
    pub fn acknowledgement(&self) -> Result<Option<Acknowledgement>> {
        let Some(recording) = &self.recording else { return Ok(None) };
        recording.tracker.is_settled()?;
        Ok(Some(recording.tracker.acknowledgement()))
    }

    /// Waits until more may be settled; without end on a stream that stores nothing.
    pub async fn acknowledgement_changed(&self) {
        match &self.recording {
            Some(recording) => recording.tracker.changed().await,
            None => std::future::pending().await,
        }
    }

    /// The alarms from now on.
    #[must_use]
    pub fn change_notices(&self) -> ChangeNotices {
        ChangeNotices(self.camera.live.moved.subscribe())
    }

    /// Settles everything at the end of the items: late partners on other streams get their time,
    /// then the rest is decided.
    ///
    /// # Errors
    /// The samples could not be stored.
    pub async fn settle(&self) -> Result<()> {
        let Some(StreamRecording { recorder, .. }) = &self.recording else { return Ok(()) };
        let is_alone = Arc::strong_count(recorder) == 1;
        self.settle_within(if is_alone { Duration::ZERO } else { recorder.allowed_lateness() }).await
    }

    /// Waits until everything is settled, for at most `patience`, then decides the rest.
    async fn settle_within(&self, patience: Duration) -> Result<()> {
        let Some(StreamRecording { recorder, tracker }) = &self.recording else { return Ok(()) };
        // Elapsed is no failure: the rest is decided below.
        let _ = tokio::time::timeout(patience, tracker.settled()).await;
        if !tracker.is_settled()? {
            recorder.end_stream(tracker).await?;
        }
        tracker.settled().await
    }
}

/// Alarms that a camera was moved, as they are raised.
pub struct ChangeNotices(watch::Receiver<Option<Arc<CameraMoved>>>);

impl ChangeNotices {
    /// Waits for the next one.
    pub async fn next(&mut self) -> Arc<CameraMoved> {
        loop {
            if self.0.changed().await.is_err() {
                return std::future::pending().await;
            }
            if let Some(moved) = self.0.borrow_and_update().clone() {
                return moved;
            }
        }
    }
}

impl Drop for LiveStream {
    fn drop(&mut self) {
        self.lease = None;
        self.app.cluster.let_go();
        self.app.metrics.stream_closed();
    }
}
