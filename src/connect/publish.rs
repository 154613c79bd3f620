//! From the positions of cameras to the outbox of a sink.

use std::sync::Arc;
use std::time::Duration;

use sha2::{Digest as _, Sha256};
use uuid::Builder;

use crate::app::{App, LiveConnection, SinkFeed, SinkPosition};
use crate::domain::{ConnectionKey, Observation, OutboxMessage, TargetId};
use crate::exchange::kinds::Topic;
use crate::exchange::{
    OutgoingFormat, OutgoingPosition, SinkSettings, cot_event, home_assistant_attributes, onvif_frame,
    position_json,
};

/// Time over which messages are gathered for one transaction.
const GATHERING: Duration = Duration::from_millis(100);
/// Messages of one transaction.
const MAX_BATCH: usize = 256;
/// Time until what the outbox did not take is offered again.
const RETRY: Duration = Duration::from_millis(200);
const DEFAULT_STALE_S: f64 = 30.0;
const DEFAULT_COT_TYPE: &str = "a-u-G";

/// Writes the positions of a sink's cameras into its outbox, until the server ends.
pub(super) struct Publisher<'a> {
    pub(super) app: &'a App,
    pub(super) key: ConnectionKey,
    pub(super) settings: &'a SinkSettings,
    pub(super) topic: Topic,
    pub(super) live: &'a Arc<LiveConnection>,
}

impl Publisher<'_> {
    pub(super) async fn run(self) {
        let Some(feed) = self.app.sink_feeds.of(self.key) else {
            // The events of places come to the outbox with their own transaction.
            let _ = self.live.publishing.set(());
            return std::future::pending().await;
        };
        // The database first learns of the log, so that it is known if this process ends too soon.
        self.store(&[]).await;
        // Set before, where the settings have changed since.
        let _ = self.live.publishing.set(());
        loop {
            tokio::select! {
                () = self.app.sink_feeds.closed() => return,
                waiting = feed.waiting() => if waiting < MAX_BATCH {
                    tokio::time::sleep(GATHERING).await;
                }
            }
            self.publish(&feed).await;
        }
    }

    /// Brings the oldest positions into the outbox. Where that is interrupted, they are still the oldest.
    async fn publish(&self, feed: &SinkFeed) {
        let positions = feed.oldest(MAX_BATCH);
        let messages: Vec<_> = positions
            .iter()
            .filter_map(|position| Some(self.message(position, &self.target(position)?)))
            .collect();
        self.store(&messages).await;
        let lost = feed.take_lost();
        self.live.update(|status| {
            status.items += messages.len() as u64;
            status.dropped += lost;
        });
        feed.settle(positions.last().map_or(0, |last| last.number));
        self.live.queued.notify_one();
    }

    /// The target of a position; `None` for one that the sink is not to have. Home Assistant keeps every device that it was
    /// told of, so a target that only a tracker's number names is the device of its receiver, or none.
    fn target(&self, SinkPosition { observation, point, .. }: &SinkPosition) -> Option<TargetId> {
        let has_name = observation.tracker_id().is_none();
        if has_name || self.settings.format != OutgoingFormat::HomeAssistant {
            return Some(point.target_id.clone());
        }
        point.receiver_match.as_ref().map(|own| TargetId::from(own.receiver_id.clone()))
    }

    /// Appends messages, again and again until the outbox has them.
    async fn store(&self, messages: &[OutboxMessage]) {
        let mut is_first = true;
        loop {
            match self.app.outboxes().append(self.key, messages).await {
                Ok(dropped) => return self.live.update(|status| status.dropped += dropped),
                Err(error) => {
                    if std::mem::take(&mut is_first) {
                        tracing::warn!(%error, "positions wait for the outbox of a sink; it is tried again");
                    }
                    let error = format!("positions wait for the outbox: {error}");
                    let now = self.app.clock.now();
                    self.live.update(|status| status.last_error = Some((now, error)));
                }
            }
            tokio::time::sleep(RETRY).await;
        }
    }

    fn message(&self, position: &SinkPosition, target_id: &TargetId) -> OutboxMessage {
        let SinkPosition { number, camera, point, .. } = position;
        let message_id = message_id(self.key, position);
        let outgoing = OutgoingPosition {
            message_id: &message_id,
            camera_id: camera,
            target_id,
            receiver_match: point.receiver_match.as_ref(),
            time: point.state.time,
            position: point.position,
            covariance: point.state.normal_covariance(),
            r95_m: point.state.r95_m,
            velocity_m_s: [point.state.velocity.east_m_s, point.state.velocity.north_m_s],
        };
        OutboxMessage {
            number: number.cast_signed(),
            subject: self.topic.of(camera, target_id),
            payload: payload(self.settings, &outgoing),
            created_at: self.app.clock.now(),
            message_id,
        }
    }
}

/// The id of a position for a sink: a UUID of version 7 of the observation's time, whose other bits are a hash of what was
/// observed. A client that sends an observation again, to whichever node, makes no other message of it.
fn message_id(key: ConnectionKey, position: &SinkPosition) -> String {
    let SinkPosition { camera, observation, point, .. } = position;
    let mut hash = Sha256::new();
    hash.update(key.0.to_le_bytes());
    for name in [camera.as_str(), point.target_id.as_str()] {
        hash.update((name.len() as u64).to_le_bytes());
        hash.update(name);
    }
    hash.update(observation.time().as_microsecond().to_le_bytes());
    hash_measurements(&mut hash, observation);
    let mut random = [0; 10];
    random.copy_from_slice(&hash.finalize()[..10]);
    let millis = u64::try_from(observation.time().as_millisecond()).unwrap_or_default();
    Builder::from_unix_timestamp_millis(millis, &random).into_uuid().to_string()
}

fn hash_measurements(hash: &mut Sha256, observation: &Observation) {
    let mut add = |mark: u8, numbers: &[f64]| {
        hash.update([mark]);
        numbers.iter().for_each(|number| hash.update(number.to_le_bytes()));
    };
    if let Some(bounding_box) = observation.bounding_box() {
        add(1, &bounding_box.sides_px());
    }
    if let Some(fix) = observation.fix() {
        let sigma_m = fix.sigma_m.map_or(f64::NAN, |sigma_m| sigma_m.metres());
        add(2, &[fix.position.longitude_deg(), fix.position.latitude_deg(), sigma_m]);
    }
}

/// A position in the format of a sink.
pub(super) fn payload(settings: &SinkSettings, position: &OutgoingPosition<'_>) -> Vec<u8> {
    match settings.format {
        // Files are written from the same objects.
        OutgoingFormat::Json | OutgoingFormat::Gpx | OutgoingFormat::Kml => position_json(position),
        OutgoingFormat::Onvif => onvif_frame(position),
        OutgoingFormat::HomeAssistant => home_assistant_attributes(position),
        OutgoingFormat::Cot => {
            let cot_type = settings.cot_type.as_deref().unwrap_or(DEFAULT_COT_TYPE);
            cot_event(position, cot_type, settings.stale_s.unwrap_or(DEFAULT_STALE_S))
        }
    }
}
