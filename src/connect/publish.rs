//! From the tracks of cameras to the outbox of a sink.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio_util::task::AbortOnDropHandle;

use crate::app::{App, CameraEvent, CameraEvents, LiveConnection, TrackPoint};
use crate::domain::{CameraId, ConnectionKey, OutboxMessage, Result, TargetId};
use crate::exchange::{
    OutgoingFormat, OutgoingPosition, SinkSettings, cot_event, onvif_frame, position_json,
};

/// Time over which messages are gathered for one transaction.
const GATHERING: Duration = Duration::from_millis(100);
/// Messages of one transaction.
const MAX_BATCH: usize = 256;
/// Time until a camera that does not exist is looked for again.
const RETRY_CAMERA: Duration = Duration::from_secs(2);
/// Targets whose last position is remembered; beyond, those that are silent are forgotten.
const MAX_TARGETS: usize = 4_096;
const DEFAULT_INTERVAL_S: f64 = 1.0;
const DEFAULT_STALE_S: f64 = 30.0;
const DEFAULT_COT_TYPE: &str = "a-u-G";

/// Writes the positions of a sink's cameras into its outbox, for as long as it is polled.
pub(super) struct Publisher<'a> {
    pub(super) app: &'a App,
    pub(super) key: ConnectionKey,
    pub(super) settings: &'a SinkSettings,
    pub(super) live: &'a Arc<LiveConnection>,
}

impl Publisher<'_> {
    pub(super) async fn run(self) -> Result<std::convert::Infallible> {
        let (points, mut incoming) = mpsc::channel(self.app.limits.connection_queue);
        let cameras = self.settings.cameras()?;
        let mut readers = Vec::with_capacity(cameras.len());
        for camera in cameras {
            let events = self.app.own_camera_events(&camera).await.ok();
            let reader = read_camera(self.app.clone(), camera, events, points.clone(), self.live.clone());
            readers.push(AbortOnDropHandle::new(tokio::spawn(reader)));
        }
        // Set before, where the settings have changed since.
        let _ = self.live.publishing.set(());
        let mut last_sent = HashMap::new();
        let mut batch = Vec::new();
        loop {
            // The sender above keeps the channel open.
            let Some(first) = incoming.recv().await else { return std::future::pending().await };
            let mut next = Some(first);
            let gathered = tokio::time::sleep(GATHERING);
            tokio::pin!(gathered);
            while let Some((camera, point)) = next {
                if self.is_due(&mut last_sent, &camera, &point) {
                    batch.push(self.message(&camera, &point));
                }
                if batch.len() >= MAX_BATCH {
                    break;
                }
                next = tokio::select! {
                    () = &mut gathered => None,
                    point = incoming.recv() => point,
                };
            }
            self.store(&mut batch).await;
        }
    }

    async fn store(&self, batch: &mut Vec<OutboxMessage>) {
        if batch.is_empty() {
            return;
        }
        let count = batch.len() as u64;
        match self.app.store.append_to_outbox(self.key, batch).await {
            Ok(dropped) => self.live.update(|status| {
                status.items += count;
                status.dropped += dropped;
            }),
            Err(error) => {
                let now = self.app.clock.now();
                self.live.update(|status| {
                    status.dropped += count;
                    status.last_error = Some((now, format!("positions could not be queued: {error}")));
                });
            }
        }
        batch.clear();
        self.live.queued.notify_one();
    }

    /// Whether a target's last position was sent long enough ago.
    fn is_due(
        &self,
        last_sent: &mut HashMap<(CameraId, TargetId), f64>,
        camera: &CameraId,
        point: &TrackPoint,
    ) -> bool {
        let interval_s = self.settings.min_interval_s.unwrap_or(DEFAULT_INTERVAL_S);
        let time_s = point.state.time.as_microsecond() as f64 * 1e-6;
        if last_sent.len() >= MAX_TARGETS {
            last_sent.retain(|_, sent_s| time_s - *sent_s < 60.0_f64.max(interval_s));
        }
        let key = (camera.clone(), point.target_id.clone());
        match last_sent.get_mut(&key) {
            // A time that steps back is another run of the same target.
            Some(sent_s) if (0.0..interval_s).contains(&(time_s - *sent_s)) => false,
            Some(sent_s) => {
                *sent_s = time_s;
                true
            }
            None => {
                last_sent.insert(key, time_s);
                true
            }
        }
    }

    fn message(&self, camera: &CameraId, point: &TrackPoint) -> OutboxMessage {
        let now = self.app.clock.now();
        let message_id = self.app.randomness.uuid_v7(now).to_string();
        let position = OutgoingPosition {
            message_id: &message_id,
            camera_id: camera,
            target_id: &point.target_id,
            time: point.state.time,
            position: point.position,
            covariance: point.state.normal_covariance(),
            r95_m: point.state.r95_m,
            velocity_m_s: [point.state.velocity.east_m_s, point.state.velocity.north_m_s],
        };
        OutboxMessage {
            number: 0,
            subject: self.settings.topic_of(camera, &point.target_id),
            payload: payload(self.settings, &position),
            created_at: now,
            message_id,
        }
    }
}

/// A position in the format of a sink.
pub(super) fn payload(settings: &SinkSettings, position: &OutgoingPosition<'_>) -> Vec<u8> {
    match settings.format {
        // Files are written from the same objects.
        OutgoingFormat::Json | OutgoingFormat::Gpx | OutgoingFormat::Kml => position_json(position),
        OutgoingFormat::Onvif => onvif_frame(position),
        OutgoingFormat::Cot => {
            let cot_type = settings.cot_type.as_deref().unwrap_or(DEFAULT_COT_TYPE);
            cot_event(position, cot_type, settings.stale_s.unwrap_or(DEFAULT_STALE_S))
        }
    }
}

/// Hands on the points of a camera's tracks, also of one that is created later, or again.
async fn read_camera(
    app: App,
    camera: CameraId,
    mut opened: Option<CameraEvents>,
    points: mpsc::Sender<(CameraId, Arc<TrackPoint>)>,
    live: Arc<LiveConnection>,
) {
    loop {
        if opened.is_none() {
            opened = app.own_camera_events(&camera).await.ok();
        }
        if let Some(mut events) = opened.take() {
            while let Some(event) = events.next().await {
                match event {
                    Ok((_, event)) => {
                        let CameraEvent::Track(update) = &*event else { continue };
                        if points.send((camera.clone(), update.point.clone())).await.is_err() {
                            return;
                        }
                    }
                    Err(lost) => live.update(|status| status.dropped += lost.count.unwrap_or(1)),
                }
            }
        }
        tokio::time::sleep(RETRY_CAMERA).await;
    }
}
