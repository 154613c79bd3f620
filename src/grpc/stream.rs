//! `FusionService.Stream`: reads items, answers each, acknowledges what is settled, ends in order.

use std::time::Duration;

use futures_util::FutureExt as _;
use tokio::time::Instant;
use tonic::{Status, Streaming};

use super::convert::{camera_id, durability, live_item, timestamp};
use super::outbox::{Outbox, Responses, outbox};
use super::proto;
use super::proto::stream_answer::Outcome;
use super::proto::stream_request::Kind;
use super::statuses::{broken, to_status};
use crate::app::{Acknowledgement, App, ItemResult, LiveStream, NotStored, NotStoredReason, TrackPoint};
use crate::domain::{CameraMoved, Error, ErrorKind, Flag, ReceiverMatch, Result};
use crate::fusion::track::{MeasurementSource, Rejection, RejectionReason};
use crate::request::RequestContext;
use crate::shutdown::Shutdown;
use crate::status;

/// How often age, idle time and the reader are checked.
const TICK: Duration = Duration::from_secs(1);
/// Time that a client gets to half-close after it was asked to reconnect.
pub(crate) const HALF_CLOSE_GRACE: Duration = Duration::from_secs(5);
/// Why a client is asked to reconnect when the server shuts down.
pub(super) const SERVER_IS_ENDING: &str = "the server is ending; reconnect to continue the stream";
/// Items that are answered together, if they are there.
const BATCH: u32 = 32;

/// Begins to answer a stream; all errors come as its end.
pub(super) fn serve(
    app: App,
    shutdown: &Shutdown,
    context: RequestContext,
    requests: Streaming<proto::StreamRequest>,
) -> Responses {
    let (outbox, responses) = outbox(app.limits.live_answers);
    let mut session = StreamSession { app, shutdown: shutdown.clone(), context, requests, outbox };
    shutdown.spawn(async move {
        let ended = session.run().await;
        let status = ended.err().map(|error| to_status(&error, session.context.id()));
        session.outbox.end(status);
    });
    responses
}

struct StreamSession {
    app: App,
    shutdown: Shutdown,
    context: RequestContext,
    requests: Streaming<proto::StreamRequest>,
    outbox: Outbox,
}

/// Why reading of items ends.
enum StopReason {
    /// The client has sent its last.
    HalfClosed,
    /// The client was asked to reconnect, and has had time to half-close.
    Reconnect,
    /// The client does not read any more.
    ReaderGone,
}

/// Age and silence of a stream.
struct StreamClock {
    opened_at: Instant,
    last_item_at: Instant,
    reconnect_sent_at: Option<Instant>,
}

impl StreamSession {
    async fn run(&mut self) -> Result<()> {
        let mut stream = self.open().await?;
        let limits = &self.app.limits;
        let idle_limit = Duration::from_secs(limits.live_idle_s);
        let opened = proto::StreamOpened {
            model_version: stream.model_version(),
            idle_limit: prost_types::Duration::try_from(idle_limit).ok(),
            durability: stream
                .durability()
                .map_or(proto::Durability::Unspecified, proto::Durability::from)
                .into(),
        };
        self.outbox.opened(opened);
        let shutdown = self.shutdown.clone();
        // Also while an item waits for the database.
        let stop = tokio::select! {
            stop = self.answer_items(&mut stream, idle_limit) => stop?,
            () = shutdown.forced() => return Err(ending()),
        };
        if matches!(stop, StopReason::ReaderGone) {
            return Ok(());
        }
        let settled = tokio::select! {
            settled = stream.settle() => settled,
            error = stream.ended() => Err(error),
            () = self.shutdown.forced() => Err(ending()),
        };
        // Settled items are acknowledged even where the rest could not be.
        if let Ok(Some(acknowledgement)) = stream.acknowledgement() {
            self.outbox.acknowledge(acknowledgement.into());
        }
        settled?;
        if self.shutdown.is_draining() { Err(ending()) } else { Ok(()) }
    }

    /// Reads the first message.
    async fn open(&mut self) -> Result<LiveStream> {
        let patience = self.app.limits.header_time();
        let first = tokio::select! {
            first = tokio::time::timeout(patience, self.requests.message()) => first,
            () = self.shutdown.draining() => return Err(ending()),
        };
        let first = first.map_err(|_| {
            let message = format!("no opening message came within {} s", patience.as_secs());
            Error::refused(ErrorKind::Timeout, message)
        })?;
        let Some(proto::StreamRequest { kind: Some(Kind::Opening(opening)) }) =
            first.map_err(|status| broken(&status))?
        else {
            return Err(Error::invalid("opening", "must be the first message of a stream"));
        };
        let camera = camera_id(&opening.camera_id)?;
        let durability = durability(opening.durability)?;
        let store_samples = opening.store_samples.then_some(durability);
        LiveStream::open(
            &self.app,
            &camera,
            &opening.client_name,
            self.context.client(),
            opening.resume_after_seq,
            store_samples,
        )
        .await
    }

    /// Reads and answers items. Whatever may end the stream is looked at before each batch, so a client
    /// whose backlog never ends cannot keep it open.
    async fn answer_items(&mut self, stream: &mut LiveStream, idle_limit: Duration) -> Result<StopReason> {
        let now = Instant::now();
        let mut clock = StreamClock { opened_at: now, last_item_at: now, reconnect_sent_at: None };
        let mut tick = tokio::time::interval(TICK);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut change_notices = stream.change_notices();
        let mut acknowledged = None;
        loop {
            tokio::select! {
                biased;
                error = stream.ended() => return Err(error),
                () = self.shutdown.draining(), if clock.reconnect_sent_at.is_none() => {
                    self.outbox.reconnect(SERVER_IS_ENDING);
                    clock.reconnect_sent_at = Some(Instant::now());
                }
                _ = tick.tick() => {
                    if let Some(stop) = self.check_time(&mut clock, idle_limit)? {
                        return Ok(stop);
                    }
                }
                moved = change_notices.next() => self.outbox.moved((*moved).clone().into()),
                () = stream.acknowledgement_changed() => self.acknowledge(stream, &mut acknowledged)?,
                message = self.requests.message() => {
                    let Some(answered) = self.answer_batch(stream, message).await? else {
                        return Ok(StopReason::HalfClosed);
                    };
                    clock.last_item_at = Instant::now();
                    self.acknowledge(stream, &mut acknowledged)?;
                    if answered == BATCH {
                        // Other tasks on this thread get their turn.
                        tokio::task::yield_now().await;
                    }
                }
            }
        }
    }

    /// Ends the stream of a reader that is gone, of a client that did not half-close or of one that is
    /// silent; asks the client of an old stream to reconnect.
    fn check_time(&self, clock: &mut StreamClock, idle_limit: Duration) -> Result<Option<StopReason>> {
        if self.outbox.reader_is_gone() {
            return Ok(Some(StopReason::ReaderGone));
        }
        let greatest_age = Duration::from_secs(self.app.limits.live_age_s);
        if clock.reconnect_sent_at.is_none() && clock.opened_at.elapsed() >= greatest_age {
            self.outbox.reconnect("the stream has reached its greatest age");
            clock.reconnect_sent_at = Some(Instant::now());
        }
        if clock.reconnect_sent_at.is_some_and(|since| since.elapsed() >= HALF_CLOSE_GRACE) {
            return Ok(Some(StopReason::Reconnect));
        }
        if clock.last_item_at.elapsed() >= idle_limit {
            let message = format!("no item came for {} s", idle_limit.as_secs());
            return Err(Error::refused(ErrorKind::Timeout, message));
        }
        Ok(None)
    }

    /// Answers a message and those after it that are there already; how many, or `None` at the end.
    async fn answer_batch(
        &mut self,
        stream: &mut LiveStream,
        first: Result<Option<proto::StreamRequest>, Status>,
    ) -> Result<Option<u32>> {
        let mut next = Some(first);
        let mut answered = 0;
        while let Some(message) = next {
            let Some(message) = message.map_err(|status| broken(&status))? else {
                self.outbox.flush();
                return Ok(None);
            };
            self.answer(stream, message).await?;
            answered += 1;
            next = if answered < BATCH { self.requests.message().now_or_never() } else { None };
        }
        self.outbox.flush();
        Ok(Some(answered))
    }

    fn acknowledge(&self, stream: &LiveStream, sent: &mut Option<Acknowledgement>) -> Result<()> {
        let current = stream.acknowledgement()?;
        if current != *sent {
            sent.clone_from(&current);
            if let Some(acknowledgement) = current {
                self.outbox.acknowledge(acknowledgement.into());
            }
        }
        Ok(())
    }

    async fn answer(&self, stream: &mut LiveStream, message: proto::StreamRequest) -> Result<()> {
        let answer = match message.kind {
            Some(Kind::Item(item)) => self.answer_item(stream, item).await?,
            Some(Kind::Opening(_)) => refused(
                0,
                &Error::invalid("opening", "the stream is open already; open another for another camera"),
            ),
            None => refused(0, &Error::invalid("item", "the message is empty")),
        };
        self.app.metrics.item_answered(!matches!(answer.outcome, Some(Outcome::Error(_))));
        if self.outbox.answer(Box::new(answer)) {
            self.app.metrics.answer_lost();
        }
        Ok(())
    }

    async fn answer_item(
        &self,
        stream: &mut LiveStream,
        item: proto::StreamItem,
    ) -> Result<proto::StreamAnswer> {
        let seq = item.seq;
        if let Err(error) = stream.check_seq(seq) {
            return Ok(refused(seq, &error));
        }
        let camera = stream.current_camera()?;
        let now = self.app.clock.now();
        // The receiver's clock offset is not applied yet, so only a wrong date is refused here.
        let answered = match live_item(item, &camera.row_rules(now)) {
            Ok(item) => stream.take(&camera, seq, item, now).await,
            Err(error) => Err(error),
        };
        match answered {
            Ok(item) => Ok(answer_of(seq, item)),
            Err(Error::Refused(refusal)) if !ends_stream(refusal.kind) => {
                // Items recorded before the refusal are acknowledged with their commit.
                stream.acknowledgement()?;
                stream.ack_refused(seq);
                Ok(refused(seq, &Error::Refused(refusal)))
            }
            Err(error) => Err(error),
        }
    }
}

/// True if a refusal is of the whole stream, not of an item.
const fn ends_stream(kind: ErrorKind) -> bool {
    matches!(kind, ErrorKind::CameraNotFound | ErrorKind::CameraOnOtherNode | ErrorKind::CameraBetweenNodes)
}

fn ending() -> Error {
    Error::refused(
        ErrorKind::ShuttingDown,
        "the server is ending; open the stream again after the last acknowledged seq",
    )
}

fn answer_of(seq: u64, item: ItemResult) -> proto::StreamAnswer {
    let flags = match &item.fused {
        Some(_) => Vec::new(),
        None => vec![proto::Flag::from(Flag::NoModel).into()],
    };
    proto::StreamAnswer {
        seq,
        outcome: item.fused.map(|fused| Outcome::Fused(fused.into())),
        track: item.track.map(|point| point.as_ref().into()),
        flags,
        lost_answers: 0,
        world_track_id: item.world_track.map(|id| id.to_string()),
        receiver_match: item.receiver_match.as_ref().map(Into::into),
    }
}

fn refused(seq: u64, error: &Error) -> proto::StreamAnswer {
    let status = status::of(error.kind());
    let (field, message) = match error {
        Error::Refused(refusal) => match refusal.violations.first() {
            Some(violation) => (violation.field.clone(), violation.message.clone()),
            None => (String::new(), refusal.message.clone()),
        },
        Error::Fault(_) => (String::new(), status.title.to_owned()),
    };
    let error = proto::StreamItemError { reason: status.slug.to_owned(), field, message };
    proto::StreamAnswer { seq, outcome: Some(Outcome::Error(error)), ..proto::StreamAnswer::default() }
}

impl From<Acknowledgement> for proto::StreamAcknowledgement {
    fn from(acknowledgement: Acknowledgement) -> Self {
        let Acknowledgement { seq, stored, not_stored } = acknowledgement;
        Self { seq, stored, not_stored: not_stored.into_iter().map(Into::into).collect() }
    }
}

impl From<NotStored> for proto::NotStored {
    fn from(not_stored: NotStored) -> Self {
        use proto::not_stored::Reason;
        let reason = match not_stored.reason {
            NotStoredReason::NoTarget => Reason::NoTarget,
            NotStoredReason::Refused => Reason::Refused,
            NotStoredReason::Unpaired => Reason::Unpaired,
            NotStoredReason::TooLate => Reason::TooLate,
            NotStoredReason::Duplicate => Reason::Duplicate,
            NotStoredReason::Unmatched => Reason::Unmatched,
        };
        Self { reason: reason.into(), count: not_stored.count, last_seq: not_stored.last_seq }
    }
}

impl From<&TrackPoint> for proto::TrackPoint {
    fn from(point: &TrackPoint) -> Self {
        let state = &point.state;
        Self {
            target_id: point.target_id.as_str().to_owned(),
            time: Some(timestamp(state.time)),
            position: Some(point.position.into()),
            velocity_east_m_s: state.velocity.east_m_s,
            velocity_north_m_s: state.velocity.north_m_s,
            r95_m: state.r95_m,
            covariance: Some(state.normal_covariance().into()),
            motion: Some(state.motion().into()),
            nis: state.nis,
            rejections: state.rejected.iter().map(Into::into).collect(),
            restarted: state.restarted,
            sources_disagree: state.sources_disagree,
            receiver_match: point.receiver_match.as_ref().map(Into::into),
        }
    }
}

impl From<&ReceiverMatch> for proto::ReceiverMatch {
    fn from(own: &ReceiverMatch) -> Self {
        Self { receiver_id: own.receiver_id.as_str().to_owned(), probability: own.probability }
    }
}

impl From<&Rejection> for proto::TrackRejection {
    fn from(rejection: &Rejection) -> Self {
        use proto::track_rejection as wire;
        let source = match rejection.source {
            MeasurementSource::Regressed => wire::Source::Regressed,
            MeasurementSource::Fix => wire::Source::Fix,
        };
        let reason = match rejection.reason {
            RejectionReason::OutsideGate => wire::Reason::OutsideGate,
            RejectionReason::TooLate => wire::Reason::TooLate,
            RejectionReason::Duplicate => wire::Reason::Duplicate,
            RejectionReason::UnusableVariance => wire::Reason::UnusableVariance,
            RejectionReason::OutOfRange => wire::Reason::OutOfRange,
            RejectionReason::Frozen => wire::Reason::Frozen,
            RejectionReason::Implausible => wire::Reason::Implausible,
        };
        Self { source: source.into(), reason: reason.into(), nis: rejection.nis }
    }
}

impl From<CameraMoved> for proto::CameraMoved {
    fn from(moved: CameraMoved) -> Self {
        Self {
            model_version: moved.model_version,
            onset_at: Some(timestamp(moved.onset_at)),
            raised_at: Some(timestamp(moved.raised_at)),
            shift_east_m: moved.shift_east_m,
            shift_north_m: moved.shift_north_m,
            statistic: moved.statistic,
            targets: moved.targets,
        }
    }
}
