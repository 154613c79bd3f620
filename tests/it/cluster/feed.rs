//! A client that stores samples by live streams: it follows the owner's address and resumes after what was acknowledged.

use std::time::{Duration, Instant};

use sightfix::grpc::proto;
use sightfix::grpc::proto::fusion_service_client::FusionServiceClient;
use tokio::sync::{mpsc, watch};
use tonic::Status;
use tonic::transport::Endpoint;
use tonic_types::StatusExt as _;

use crate::live_client::{Received, Sent, messages};

/// Time between two items.
pub(super) const PACE: Duration = Duration::from_millis(4);
/// A node that says nothing for so long while something is not acknowledged counts as gone.
const SILENCE: Duration = Duration::from_millis(1_500);
/// Pause before another attempt.
const PAUSE: Duration = Duration::from_millis(50);

/// The items of one camera, and how far they are acknowledged.
pub(super) struct Feed {
    pub(super) camera: String,
    pub(super) items: Vec<proto::StreamItem>,
    /// How many of them are sent.
    pub(super) upto: usize,
    pub(super) acknowledged: u64,
    /// The second half of the items is sent once this is true.
    pub(super) goes_on: watch::Receiver<bool>,
    /// When each answer came, and from which node.
    pub(super) answers: Vec<(Instant, String)>,
    pub(super) redirects: usize,
    pub(super) attempts: usize,
}

impl Feed {
    pub(super) fn new(camera: &str, items: Vec<proto::StreamItem>) -> Self {
        let camera = camera.to_owned();
        let upto = items.len();
        // Without a sender, the value stays as it is.
        let goes_on = watch::channel(true).1;
        Self { camera, items, upto, acknowledged: 0, goes_on, answers: Vec::new(), redirects: 0, attempts: 0 }
    }

    /// Streams to a node from the last acknowledgement on, until all is acknowledged.
    pub(super) async fn stream(&mut self, node: &str, pace: Duration) -> Result<(), Status> {
        self.attempts += 1;
        let endpoint = Endpoint::from_shared(node.to_owned()).expect("an address");
        let endpoint = endpoint.connect_timeout(Duration::from_secs(1));
        let channel = endpoint.connect().await.map_err(|error| Status::unavailable(error.to_string()))?;
        let (sent, queue) = mpsc::channel(64);
        let request = |kind| proto::StreamRequest { kind: Some(kind) };
        let opening = proto::StreamOpening {
            camera_id: self.camera.clone(),
            client_name: format!("feed of {}", self.camera),
            resume_after_seq: self.acknowledged,
            store_samples: true,
            ..Default::default()
        };
        sent.send(request(Sent::Opening(opening))).await.expect("room");
        let mut service = FusionServiceClient::new(channel);
        let opened = service.stream(messages(queue));
        let opened = tokio::time::timeout(SILENCE, opened).await.map_err(|_| silent())?;
        let mut responses = opened?.into_inner();
        let rest: Vec<_> =
            (1..).zip(self.items[..self.upto].to_vec()).skip(self.acknowledged as usize).collect();
        let (half, mut goes_on) = (self.upto as u64 / 2, self.goes_on.clone());
        let mut sending = Some(tokio::spawn(async move {
            for (seq, item) in rest {
                if seq > half && goes_on.wait_for(|goes_on| *goes_on).await.is_err() {
                    return;
                }
                if sent.send(request(Sent::Item(proto::StreamItem { seq, ..item }))).await.is_err() {
                    return;
                }
                tokio::time::sleep(pace).await;
            }
            // The stream stays open until all is acknowledged.
            std::future::pending::<()>().await;
        }));
        let ended = loop {
            let next = tokio::time::timeout(SILENCE, responses.message()).await;
            let message = match next.map_err(|_| silent()).flatten() {
                Ok(Some(message)) => message,
                Ok(None) => break Err(Status::unavailable("the stream was ended in order")),
                Err(status) => break Err(status),
            };
            match message.kind {
                Some(Received::Answer(_)) => self.answers.push((Instant::now(), node.to_owned())),
                Some(Received::Acknowledgement(upto)) => {
                    assert!(upto.seq >= self.acknowledged, "an acknowledgement is never taken back");
                    self.acknowledged = upto.seq;
                    if self.acknowledged as usize == self.upto {
                        break Ok(());
                    }
                }
                // Half-close, and read what is still acknowledged.
                Some(Received::Reconnect(_)) => sending.take().iter().for_each(|task| task.abort()),
                _ => {}
            }
        };
        sending.iter().for_each(|task| task.abort());
        ended
    }

    /// Streams to any of some nodes until all is acknowledged.
    pub(super) async fn resume_at(&mut self, nodes: &[&str]) {
        let mut owner: Option<String> = None;
        for attempt in 0..2_000 {
            let node = owner.take().unwrap_or_else(|| nodes[attempt % nodes.len()].to_owned());
            match self.stream(&node, PACE).await {
                Ok(()) => return,
                Err(status) => {
                    let info = status.get_details_error_info();
                    owner = info.and_then(|info| info.metadata.get("owner").cloned());
                    self.redirects += usize::from(owner.is_some());
                }
            }
            tokio::time::sleep(PAUSE).await;
        }
        panic!("{} of {} items are acknowledged", self.acknowledged, self.upto);
    }

    /// Time from an instant to the first answer of another node than one.
    pub(super) fn taken_over_after(&self, instant: Instant, from: &str) -> Duration {
        let first = self.answers.iter().find(|(at, node)| *at > instant && node != from);
        first.expect("an answer of another node").0 - instant
    }

    /// The longest time between two answers, the second of them after an instant.
    pub(super) fn longest_silence_after(&self, instant: Instant) -> Duration {
        let pairs = self.answers.windows(2).filter(|pair| pair[1].0 > instant);
        pairs.map(|pair| pair[1].0 - pair[0].0).max().unwrap_or_default()
    }

    /// The node that gave the latest answer.
    pub(super) fn answered_by(&self) -> &str {
        &self.answers.last().expect("an answer").1
    }
}

fn silent() -> Status {
    Status::deadline_exceeded("the node is silent")
}
