//! One client's live stream: its place, its items, its acknowledgements.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use tokio::sync::watch;

use super::keeping::{Half, Keeping, Ledger};
use super::{CameraLive, Followed, lock};
use crate::app::App;
use crate::domain::{
    CameraId, CameraMoved, Detection, Durability, Error, ErrorKind, LiveItem, Observation, Result, Sample,
    Score, TargetClass, check_text,
};

/// Longest name of a client, in bytes.
const LONGEST_CLIENT_NAME: usize = 128;

/// Streams that are open, counted by client.
#[derive(Default)]
pub(super) struct Places(Arc<Mutex<HashMap<String, usize>>>);

/// A stream's place; free again when dropped.
struct Place {
    places: Arc<Mutex<HashMap<String, usize>>>,
    client: String,
}

impl Places {
    fn take(&self, client: &str, most: usize, most_of_client: usize) -> Result<Place> {
        let mut open = lock(&self.0);
        if open.values().sum::<usize>() >= most {
            return Err(overloaded(format!("{most} live streams are open already; try again later")));
        }
        let of_client = open.entry(client.to_owned()).or_default();
        if *of_client >= most_of_client {
            return Err(overloaded(format!("this client has {most_of_client} live streams open already")));
        }
        *of_client += 1;
        Ok(Place { places: self.0.clone(), client: client.to_owned() })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut open = lock(&self.places);
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
    id: CameraId,
    live: Arc<CameraLive>,
    kept: Option<Kept>,
    last_seq: u64,
    _place: Place,
}

struct Kept {
    keeping: Arc<Keeping>,
    ledger: Arc<Ledger>,
}

impl App {
    /// Opens a live stream of one client for one camera. With `store_samples` boxes and fixes are
    /// paired and stored, and items acknowledged, both with that durability.
    ///
    /// # Errors
    /// `CameraNotFound`; `InvalidArgument` naming `client_name`; `Overloaded` beyond the limits of
    /// streams.
    pub async fn open_stream(
        &self,
        id: &CameraId,
        client_name: &str,
        resume_after_seq: u64,
        store_samples: Option<Durability>,
    ) -> Result<LiveStream> {
        check_text("client_name", client_name, LONGEST_CLIENT_NAME)?;
        self.serving(id).await?;
        let limits = &self.limits;
        let place =
            self.live.places.take(client_name, limits.live_streams, limits.live_streams_per_client)?;
        let live = self.live.of(id);
        let kept = store_samples.map(|durability| Kept {
            keeping: live.keeping(self, id),
            ledger: Ledger::beginning_after(resume_after_seq, durability),
        });
        self.metrics.stream_opened();
        Ok(LiveStream {
            app: self.clone(),
            id: id.clone(),
            live,
            kept,
            last_seq: resume_after_seq,
            _place: place,
        })
    }
}

impl CameraLive {
    /// The pairing that all storing streams of the camera share.
    fn keeping(&self, app: &App, id: &CameraId) -> Arc<Keeping> {
        let mut shared = lock(&self.keeping);
        match shared.upgrade().filter(|keeping| !keeping.has_failed()) {
            Some(keeping) => keeping,
            None => {
                let keeping = Keeping::start(id.clone(), app.store.clone(), app.metrics.clone());
                *shared = Arc::downgrade(&keeping);
                keeping
            }
        }
    }
}

impl LiveStream {
    /// The model version that answers now.
    #[must_use]
    pub fn model_version(&self) -> Option<u32> {
        self.app.registry.get(&self.id)?.model.as_ref().map(|(_, version)| *version)
    }

    /// When items are acknowledged; `None` on a stream that stores nothing.
    #[must_use]
    pub fn durability(&self) -> Option<Durability> {
        self.kept.as_ref().map(|kept| kept.ledger.durability())
    }

    /// Checks that seqs rise; an item that cannot be read has one, too.
    ///
    /// # Errors
    /// `InvalidArgument` naming `seq`.
    pub fn number(&mut self, seq: u64) -> Result<()> {
        if seq <= self.last_seq {
            return Err(Error::invalid(
                "seq",
                format!("must be above {}, that of the item before", self.last_seq),
            ));
        }
        self.last_seq = seq;
        Ok(())
    }

    /// An item that could not be taken: it is settled as it is.
    pub fn pass(&self, seq: u64) {
        if let Some(kept) = &self.kept {
            kept.ledger.pass(seq);
        }
    }

    /// Takes an item: its own position, its target's track with it, and its part in a sample.
    ///
    /// # Errors
    /// `InvalidArgument` for neither box nor fix, naming the field; `CameraNotFound`; as
    /// [`App::follow`].
    pub async fn take(&mut self, seq: u64, item: LiveItem) -> Result<Followed> {
        let serving = self.app.serving(&self.id).await?;
        let (target_id, time) = match (item.target_id, &item.receiver_id) {
            (Some(target_id), _) => (Some(target_id), item.time),
            (None, Some(receiver_id)) => {
                let (target_id, time) = serving.receivers.resolve(receiver_id, item.time);
                (Some(target_id), time)
            }
            (None, None) => (None, item.time),
        };
        let observation = Observation::new(time, target_id, item.bounding_box, item.fix)?;
        self.keep(seq, observation.clone(), item.class, item.score).await?;
        self.app.follow_in(&self.live, &self.id, &serving, &observation).await
    }

    async fn keep(
        &self,
        seq: u64,
        observation: Observation,
        class: Option<TargetClass>,
        score: Option<Score>,
    ) -> Result<()> {
        let Some(Kept { keeping, ledger }) = &self.kept else { return Ok(()) };
        let Observation { time, target_id, bounding_box, fix } = observation;
        let Some(target_id) = target_id else {
            ledger.pass(seq);
            return Ok(());
        };
        match (bounding_box, fix) {
            (Some(bounding_box), Some(fix)) => {
                let sample = Sample { time, target_id, bounding_box, fix, class, score, truth: None };
                keeping.whole(ledger, seq, sample).await
            }
            (Some(bounding_box), None) => {
                let detection = Detection { time, target_id, bounding_box, class, score };
                keeping.half(ledger, seq, Half::Box(detection)).await
            }
            (None, Some(fix)) => keeping.half(ledger, seq, Half::Fix(target_id, time, fix)).await,
            (None, None) => Ok(()),
        }
    }

    /// The seq up to which everything is settled; `None` on a stream that keeps nothing.
    ///
    /// # Errors
    /// The samples could not be stored; the stream must end, for nothing behind is acknowledged.
    pub fn acknowledged(&self) -> Result<Option<u64>> {
        let Some(kept) = &self.kept else { return Ok(None) };
        kept.ledger.is_settled()?;
        Ok(Some(kept.ledger.settled()))
    }

    /// Waits until more may be settled; for ever on a stream that keeps nothing.
    pub async fn acknowledgement_changed(&self) {
        match &self.kept {
            Some(kept) => kept.ledger.changed().await,
            None => std::future::pending().await,
        }
    }

    /// The alarms from now on.
    #[must_use]
    pub fn moves(&self) -> Moves {
        Moves(self.live.moved.subscribe())
    }

    /// Settles everything at the end of the items: late partners on other streams get their time,
    /// then what is left is decided.
    ///
    /// # Errors
    /// The samples could not be stored.
    pub async fn settle(&self) -> Result<()> {
        let Some(Kept { keeping, ledger }) = &self.kept else { return Ok(()) };
        let alone = Arc::strong_count(keeping) == 1;
        if !alone {
            // Elapsed is no failure: what is still open is decided below.
            let _ = tokio::time::timeout(keeping.lateness(), settled(ledger)).await;
        }
        if !ledger.is_settled()? {
            keeping.end(ledger).await?;
        }
        settled(ledger).await
    }
}

/// Alarms that a camera was moved, as they are raised.
pub struct Moves(watch::Receiver<Option<Arc<CameraMoved>>>);

impl Moves {
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

async fn settled(ledger: &Ledger) -> Result<()> {
    while !ledger.is_settled()? {
        ledger.changed().await;
    }
    Ok(())
}

impl Drop for LiveStream {
    fn drop(&mut self) {
        self.app.metrics.stream_closed();
    }
}
