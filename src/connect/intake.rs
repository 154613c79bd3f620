//! From messages to the live tracks and samples of cameras, as the items of a live stream.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use super::credentials::PeerError;
use super::source::{Message, Settled};
use crate::admission::ClientId;
use crate::app::{ActiveCamera, App, LastMessage, LiveConnection, LiveStream};
use crate::domain::{
    BoundingBox, CameraId, ConnectionId, Durability, Error, ErrorKind, ImageArea, ImageSize, LiveItem,
    ReceivedFix, ReceiverId, Result, TargetId, TrackerId,
};
use crate::exchange::{
    DetectedBox, MessageContext, MessageDecoder, MessageItem, NamedDetection, Reading, SourceSettings,
    source_decoder,
};

/// How long a source waits for a camera that another node has, and how often it looks. Meanwhile it reads nothing, so that
/// nothing is lost that its peer cannot send again.
const OWNING_TIME: Duration = Duration::from_secs(30);
const OWNING_PAUSE: Duration = Duration::from_millis(200);
/// The name that stands for any camera of a sender.
const ANY_CAMERA: &str = "*";

/// A camera of the sender.
#[derive(Clone)]
struct SenderCamera {
    /// The camera here.
    id: CameraId,
    /// Size of the sender's stream, if it is not that of the camera's images.
    stream_size: Option<ImageSize>,
    /// The part of the camera's image whose boxes are taken.
    area: Option<Arc<ImageArea>>,
}

/// Which camera an item is for.
pub(super) struct Routing {
    cameras: HashMap<String, SenderCamera>,
    fix_cameras: Vec<CameraId>,
    receiver: Option<ReceiverId>,
    ids_name_targets: bool,
}

impl Routing {
    pub(super) fn of(settings: &SourceSettings) -> Result<Self> {
        let cameras = settings.cameras.iter().map(|(name, mapping)| {
            let (id, stream_size) = (mapping.camera()?, mapping.stream_size()?);
            Ok((name.clone(), SenderCamera { id, stream_size, area: mapping.area()?.map(Arc::new) }))
        });
        Ok(Self {
            cameras: cameras.collect::<Result<_>>()?,
            fix_cameras: settings.fix_cameras()?,
            receiver: settings.receiver()?,
            ids_name_targets: settings.ids_name_targets,
        })
    }

    /// The camera of a sender's name.
    fn camera(&self, name: &str) -> Result<SenderCamera> {
        match self.cameras.get(name).or_else(|| self.cameras.get(ANY_CAMERA)) {
            Some(known) => Ok(known.clone()),
            None => {
                let id = CameraId::new(name).map_err(|_| {
                    Error::invalid("cameras", format!("names no camera for the sender's camera `{name}`"))
                })?;
                Ok(SenderCamera { id, stream_size: None, area: None })
            }
        }
    }

    /// The target and the tracker's id of a detection; one of both.
    fn identity(&self, detection: &NamedDetection) -> Result<(Option<TargetId>, Option<TrackerId>)> {
        if self.ids_name_targets {
            Ok((Some(detection.target_id.clone()), None))
        } else {
            Ok((None, Some(TrackerId::new(detection.target_id.as_str())?)))
        }
    }

    /// The receiver of a fix.
    fn receiver(&self, fix: &ReceivedFix) -> Result<ReceiverId> {
        fix.receiver_id.clone().or_else(|| self.receiver.clone()).ok_or_else(|| {
            Error::invalid("receiver_id", "the message names no receiver; set receiver_id of the connection")
        })
    }
}

/// One camera's stream of a connection.
struct CameraStream {
    stream: LiveStream,
    last_seq: u64,
}

/// A message of which something is not stored yet.
struct PendingMessage {
    receipt: u64,
    /// Items that are to be settled: camera and seq.
    items: Vec<(CameraId, u64)>,
    outcome: Result<(), String>,
}

impl PendingMessage {
    fn size(&self) -> usize {
        self.items.len().max(1)
    }
}

/// Takes the messages of one source.
pub(super) struct Intake {
    app: App,
    id: ConnectionId,
    live: Arc<LiveConnection>,
    routing: Routing,
    durability: Option<Durability>,
    /// True if a message is acknowledged when all that was to be stored of it is stored.
    awaits_storage: bool,
    decoder: Box<dyn MessageDecoder>,
    streams: HashMap<CameraId, CameraStream>,
    pending: VecDeque<PendingMessage>,
    /// Items of the pending messages; a message without any counts as one.
    pending_items: usize,
}

impl Intake {
    pub(super) fn new(
        app: App,
        id: ConnectionId,
        live: Arc<LiveConnection>,
        settings: &SourceSettings,
    ) -> Result<Self> {
        Ok(Self {
            app,
            id,
            live,
            routing: Routing::of(settings)?,
            durability: settings.store_samples.then_some(Durability::Synced),
            awaits_storage: settings.store_samples && !settings.answers_at_once(),
            decoder: source_decoder(settings),
            streams: HashMap::new(),
            pending: VecDeque::new(),
            pending_items: 0,
        })
    }

    /// Boxes, fixes, and messages without either, that are not settled.
    pub(super) const fn pending(&self) -> usize {
        self.pending_items
    }

    /// Takes a message. Faults of the message, or of one of its items, are counted and shown in the status.
    ///
    /// # Errors
    /// A failure that is not the message's fault, so the message must come again.
    pub(super) async fn take(&mut self, message: Message) -> Result<(), PeerError> {
        let now = self.app.clock.now();
        let time_bounds = self.app.limits.live_time_bounds(now);
        let context = MessageContext { subject: &message.subject, received_at: now, time_bounds };
        let content = message.content(self.app.limits.connection_message_bytes);
        let read = content.and_then(|content| self.decoder.decode(content, &context));
        let mut account = Account { now, ..Account::default() };
        let mut items = Vec::new();
        let outcome = match read {
            Ok(Reading { items: read, skipped }) => {
                account.skip_all(skipped, &example_of(&message));
                for item in read {
                    self.take_item(item, &mut items, &mut account).await?;
                }
                Ok(())
            }
            Err(reason) => Err(reason),
        };
        account.report(&self.live, &message, &outcome);
        let pending = PendingMessage { receipt: message.receipt, items, outcome };
        self.pending_items += pending.size();
        self.pending.push_back(pending);
        Ok(())
    }

    async fn take_item(
        &mut self,
        item: MessageItem,
        items: &mut Vec<(CameraId, u64)>,
        account: &mut Account,
    ) -> Result<(), PeerError> {
        let description = describe(&item);
        let targets = match item {
            MessageItem::Detection(detection) => match self.routing.camera(&detection.camera) {
                Ok(camera) => vec![(camera.id.clone(), LiveSource::Detection(detection, camera))],
                Err(error) => return account.skip(&description, &error),
            },
            MessageItem::Fix(fix) => {
                let receiver = match self.routing.receiver(&fix) {
                    Ok(receiver) => receiver,
                    Err(error) => return account.skip(&description, &error),
                };
                let source =
                    |camera: &CameraId| (camera.clone(), LiveSource::Fix(fix.clone(), receiver.clone()));
                self.routing.fix_cameras.iter().map(source).collect()
            }
        };
        for (camera, source) in targets {
            let time = source.time();
            match self.follow(&camera, source).await {
                Ok(seq) => {
                    account.took(&camera, &description, time);
                    if self.awaits_storage {
                        items.push((camera, seq));
                    }
                }
                Err(error) if is_of_item(error.kind()) => account.skip(&description, &error)?,
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    /// The stream of a camera, opened again for one that was deleted and created. The seqs go on, so that what was
    /// pending for the camera of before counts as settled.
    async fn stream(&mut self, camera: &CameraId) -> Result<&mut CameraStream> {
        let last_seq = match self.streams.get(camera) {
            Some(known) if known.stream.current_camera().is_ok() => None,
            Some(deleted) => Some(deleted.last_seq),
            None => Some(0),
        };
        if let Some(last_seq) = last_seq {
            let name = format!("connection {} {camera}", self.id);
            let stream =
                open_stream(&self.app, camera, &name, last_seq, self.durability).await.map_err(|error| {
                    match error.kind() {
                        ErrorKind::CameraNotFound => error,
                        // No fault of the item: it must come again.
                        _ => Error::fault(error),
                    }
                })?;
            self.streams.insert(camera.clone(), CameraStream { stream, last_seq });
        }
        self.streams.get_mut(camera).ok_or_else(|| Error::fault("the stream was just opened"))
    }

    /// Gives an item to the camera's stream; its seq there.
    async fn follow(&mut self, camera: &CameraId, source: LiveSource) -> Result<u64> {
        let now = self.app.clock.now();
        let active = self.stream(camera).await?.stream.current_camera()?;
        let item = source.item(&active, &self.routing)?;
        let known = self.stream(camera).await?;
        let seq = known.last_seq + 1;
        known.stream.check_seq(seq)?;
        known.last_seq = seq;
        match known.stream.take(&active, seq, item, now).await {
            Ok(_) => Ok(seq),
            Err(error) => {
                // One that was recorded before it was refused is settled by its recording.
                known.stream.ack_refused(seq);
                Err(error)
            }
        }
    }

    /// The oldest messages of which all is stored that was to be, in their order.
    ///
    /// # Errors
    /// Samples could not be stored: nothing after them is acknowledged.
    pub(super) fn settled(&mut self) -> Result<Vec<Settled>> {
        let mut settled = Vec::new();
        for known in self.streams.values() {
            known.stream.acknowledgement()?;
        }
        while let Some(message) = self.pending.front() {
            for (camera, seq) in &message.items {
                if let Some(known) = self.streams.get(camera)
                    && known.stream.acknowledgement()?.is_some_and(|it| it.seq < *seq)
                {
                    return Ok(settled);
                }
            }
            if let Some(message) = self.pending.pop_front() {
                self.pending_items -= message.size();
                settled.push(Settled { receipt: message.receipt, outcome: message.outcome });
            }
        }
        Ok(settled)
    }
}

/// Opens a stream of a camera, which another node gives up for it if it has the camera.
async fn open_stream(
    app: &App,
    camera: &CameraId,
    name: &str,
    last_seq: u64,
    durability: Option<Durability>,
) -> Result<LiveStream> {
    let until = app.clock.monotonic() + OWNING_TIME;
    loop {
        match LiveStream::open(app, camera, name, ClientId::UNKNOWN, last_seq, durability).await {
            Err(error) if is_elsewhere(error.kind()) && app.clock.monotonic() < until => {
                app.nodes().want_camera(camera).await?;
                tokio::time::sleep(OWNING_PAUSE).await;
            }
            opened => return opened,
        }
    }
}

/// True if another node has a camera, or may have it.
const fn is_elsewhere(kind: ErrorKind) -> bool {
    matches!(kind, ErrorKind::CameraOnOtherNode | ErrorKind::CameraBetweenNodes)
}

/// True if an error concerns one item, so that the rest goes on.
const fn is_of_item(kind: ErrorKind) -> bool {
    matches!(kind, ErrorKind::InvalidArgument | ErrorKind::CameraNotFound | ErrorKind::Overloaded)
}

/// An item with what turns it into that of a camera.
enum LiveSource {
    Detection(NamedDetection, SenderCamera),
    Fix(ReceivedFix, ReceiverId),
}

impl LiveSource {
    const fn time(&self) -> Timestamp {
        match self {
            Self::Detection(detection, _) => detection.time,
            Self::Fix(fix, _) => fix.time,
        }
    }

    fn item(self, camera: &ActiveCamera, routing: &Routing) -> Result<LiveItem> {
        Ok(match self {
            Self::Detection(detection, sender) => {
                let (target_id, tracker_id) = routing.identity(&detection)?;
                let image_size = camera.image_size;
                let bounding_box = box_in(image_size, detection.detected_box, sender.stream_size)?;
                let bounding_box =
                    image_size.map_or(Ok(bounding_box), |image_size| bounding_box.within(image_size))?;
                if sender.area.is_some_and(|area| !area.contains_foot_of(&bounding_box)) {
                    return Err(Error::invalid(
                        "area",
                        "the foot of the box is outside of the source's area",
                    ));
                }
                LiveItem {
                    time: detection.time,
                    target_id,
                    receiver_id: None,
                    tracker_id,
                    bounding_box: Some(bounding_box),
                    fix: None,
                    class: detection.class,
                    score: detection.score,
                }
            }
            Self::Fix(fix, receiver_id) => LiveItem {
                time: fix.time,
                target_id: None,
                tracker_id: None,
                receiver_id: Some(receiver_id),
                bounding_box: None,
                fix: Some(fix.fix),
                class: None,
                score: None,
            },
        })
    }
}

/// A detector's rectangle in pixels of the camera's image. A camera without an image size has that of the detector.
fn box_in(
    image: Option<ImageSize>,
    detected: DetectedBox,
    stream_size: Option<ImageSize>,
) -> Result<BoundingBox> {
    let sides = |size: ImageSize| (f64::from(size.width_px()), f64::from(size.height_px()));
    let (edges, (across, down)) = match detected {
        DetectedBox::Fractions(edges) => {
            let size = image.or(stream_size).ok_or_else(|| {
                Error::invalid("image_size", "the camera needs an image_size for boxes without pixels")
            })?;
            (edges, sides(size))
        }
        DetectedBox::Pixels(edges) => {
            let scales = image
                .map(sides)
                .zip(stream_size.map(sides))
                .map(|(image, stream)| (image.0 / stream.0, image.1 / stream.1));
            (edges, scales.unwrap_or((1.0, 1.0)))
        }
    };
    let [left, top, right, bottom] = edges;
    BoundingBox::new(left * across, top * down, (right - left) * across, (bottom - top) * down)
}

/// The reading of a message that was decoded and is empty.
const EMPTY_READING: &str = "the message contains no detection and no fix";
/// Bytes of a message that was not taken which are kept as an example.
const EXAMPLE_BYTES: usize = 200;

/// The beginning of a message, as text.
fn example_of(message: &Message) -> String {
    let shown = &message.payload[..message.payload.len().min(EXAMPLE_BYTES)];
    String::from_utf8_lossy(shown).into_owned()
}

/// The counts of the items of one message.
#[derive(Default)]
struct Account {
    now: Timestamp,
    lines: Vec<String>,
    /// Why items were skipped, and the items in words.
    reasons: Vec<(String, String)>,
    taken: u64,
    skipped: u64,
    latest: Option<Timestamp>,
}

impl Account {
    /// Lines of a message that are shown.
    const MAX_LINES: usize = 32;

    fn line(&mut self, line: String) {
        if self.lines.len() < Self::MAX_LINES {
            self.lines.push(line);
        }
    }

    fn took(&mut self, camera: &CameraId, description: &str, time: Timestamp) {
        self.taken += 1;
        self.latest = Some(self.latest.map_or(time, |latest| latest.max(time)));
        self.line(format!("camera {camera}: {description}"));
    }

    fn skip(&mut self, description: &str, error: &Error) -> Result<(), PeerError> {
        self.skipped += 1;
        self.line(format!("skipped: {description}: {error}"));
        self.reasons.push((error.to_string(), description.to_owned()));
        Ok(())
    }

    fn skip_all(&mut self, reasons: Vec<String>, example: &str) {
        self.skipped += reasons.len() as u64;
        for reason in reasons {
            self.line(format!("skipped: {reason}"));
            self.reasons.push((reason, example.to_owned()));
        }
    }

    fn report(mut self, live: &LiveConnection, message: &Message, outcome: &Result<(), String>) {
        let is_empty = self.taken == 0 && self.skipped == 0;
        let untaken = outcome.as_ref().err().map(|reason| format!("rejected: {reason}"));
        let untaken = untaken.or_else(|| is_empty.then(|| EMPTY_READING.to_owned()));
        if let Some(reason) = untaken {
            self.reasons.push((reason.clone(), example_of(message)));
            self.line(reason);
        }
        let lag = self.latest.map(|latest| self.now.duration_since(latest).as_secs_f64());
        let Self { now, lines, reasons, taken, skipped, .. } = self;
        let last = LastMessage::new(now, message.subject.clone(), &message.payload, lines);
        live.update(|status| {
            reasons.iter().for_each(|(reason, example)| status.count_reason(now, reason, example));
            status.messages += 1;
            status.items += taken;
            status.skipped += skipped;
            status.rejected += u64::from(outcome.is_err());
            status.last_message = Some(last);
            if lag.is_some() {
                status.lag_s = lag;
            }
        });
    }
}

/// An item in words.
pub(super) fn describe(item: &MessageItem) -> String {
    match item {
        MessageItem::Detection(detection) => {
            let (name, [left, top, right, bottom]) = match detection.detected_box {
                DetectedBox::Pixels(edges) => ("px", edges),
                DetectedBox::Fractions(edges) => ("of the image", edges),
            };
            let camera = match detection.camera.as_str() {
                "" => String::new(),
                camera => format!(" of `{camera}`"),
            };
            format!(
                "object {}{camera} at {}: box {left}, {top} to {right}, {bottom} {name}",
                detection.target_id, detection.time
            )
        }
        MessageItem::Fix(fix) => {
            let position = fix.fix.position;
            let receiver = fix.receiver_id.as_ref().map_or("the connection", ReceiverId::as_str);
            let sigma = fix.fix.sigma_m.map(|sigma| format!(", sigma {:.3} m per axis", sigma.metres()));
            format!(
                "fix of {receiver} at {}: longitude {}, latitude {} degrees{}",
                fix.time,
                position.longitude_deg(),
                position.latitude_deg(),
                sigma.unwrap_or_default()
            )
        }
    }
}
