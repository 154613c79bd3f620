//! `FusionService.Stream`: reads items, answers each, tells what is settled, ends in order.

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
use crate::app::{App, LiveStream, TrackPoint};
use crate::domain::{CameraId, CameraMoved, Error, ErrorKind, Flag, Result};
use crate::fusion::track::{MeasurementSource, Rejection, RejectionReason};
use crate::shutdown::Shutdown;
use crate::status;
use crate::telemetry::RequestId;

/// How often age and silence are looked at.
const TICK: Duration = Duration::from_secs(1);
/// Time that a client gets to half-close after it was asked to reconnect.
const FAREWELL: Duration = Duration::from_secs(5);
/// Items that are answered together, if they are there.
const BATCH: u32 = 32;

/// Begins to answer a stream; all errors come as its end.
pub(super) fn serve(
    app: &App,
    shutdown: &Shutdown,
    id: RequestId,
    requests: Streaming<proto::StreamRequest>,
) -> Responses {
    let (outbox, responses) = outbox(app.limits.live_answers);
    let conversation = Conversation { app: app.clone(), shutdown: shutdown.clone(), requests, outbox };
    shutdown.spawn(async move {
        let mut conversation = conversation;
        let ended = conversation.hold().await;
        let status = ended.err().map(|error| to_status(&error, &id));
        conversation.outbox.end(status);
    });
    responses
}

struct Conversation {
    app: App,
    shutdown: Shutdown,
    requests: Streaming<proto::StreamRequest>,
    outbox: Outbox,
}

/// Why items are read no more.
enum Stop {
    /// The client has sent its last.
    HalfClosed,
    /// The client was asked to come again.
    Reconnect,
    /// Nobody listens.
    Gone,
}

impl Conversation {
    async fn hold(&mut self) -> Result<()> {
        let (camera, mut stream) = self.open().await?;
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
        let stop = self.answer_items(&camera, &mut stream, idle_limit).await?;
        if matches!(stop, Stop::Gone) {
            return Ok(());
        }
        // A server that ends has no more time than this.
        let settled = tokio::select! {
            settled = stream.settle() => settled,
            () = self.shutdown.overdue() => Err(ending()),
        };
        // What is acknowledged is so even where the rest could not be.
        if let Ok(Some(seq)) = stream.acknowledged() {
            self.outbox.acknowledge(seq);
        }
        settled?;
        if self.shutdown.has_begun() { Err(ending()) } else { Ok(()) }
    }

    /// The first message.
    async fn open(&mut self) -> Result<(CameraId, LiveStream)> {
        let patience = self.app.limits.header_time();
        let first = tokio::select! {
            first = tokio::time::timeout(patience, self.requests.message()) => first,
            () = self.shutdown.begun() => return Err(ending()),
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
        let stream = self
            .app
            .open_stream(&camera, &opening.client_name, opening.resume_after_seq, store_samples)
            .await?;
        Ok((camera, stream))
    }

    async fn answer_items(
        &mut self,
        camera: &CameraId,
        stream: &mut LiveStream,
        idle_limit: Duration,
    ) -> Result<Stop> {
        let opened_at = Instant::now();
        let oldest = Duration::from_secs(self.app.limits.live_age_s);
        let mut heard_at = opened_at;
        let mut told_to_go: Option<Instant> = None;
        let mut tick = tokio::time::interval(TICK);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut moves = stream.moves();
        let mut acknowledged = None;
        loop {
            tokio::select! {
                biased;
                message = self.requests.message() => {
                    let whole_batch = match self.answer_batch(camera, stream, message).await? {
                        Some(answered) => answered == BATCH,
                        None => return Ok(Stop::HalfClosed),
                    };
                    heard_at = Instant::now();
                    self.acknowledge(stream, &mut acknowledged)?;
                    if whole_batch {
                        // Others on this thread, and the branches below, get their turn.
                        tokio::task::yield_now().await;
                    }
                }
                () = stream.acknowledgement_changed() => self.acknowledge(stream, &mut acknowledged)?,
                moved = moves.next() => self.outbox.moved((*moved).clone().into()),
                () = self.shutdown.begun(), if told_to_go.is_none() => {
                    self.outbox.reconnect("the server is ending; its successor will take up the stream");
                    told_to_go = Some(Instant::now());
                }
                _ = tick.tick() => {
                    if self.outbox.reader_is_gone() {
                        return Ok(Stop::Gone);
                    }
                    if told_to_go.is_none() && opened_at.elapsed() >= oldest {
                        self.outbox.reconnect("the stream has reached its greatest age");
                        told_to_go = Some(Instant::now());
                    }
                    if told_to_go.is_some_and(|since| since.elapsed() >= FAREWELL) {
                        return Ok(Stop::Reconnect);
                    }
                    if heard_at.elapsed() >= idle_limit {
                        let message = format!("no item came for {} s", idle_limit.as_secs());
                        return Err(Error::refused(ErrorKind::Timeout, message));
                    }
                }
            }
        }
    }

    /// Answers a message and those behind it that are there already; how many, or `None` at the end.
    async fn answer_batch(
        &mut self,
        camera: &CameraId,
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
            self.answer(camera, stream, message).await?;
            answered += 1;
            next = if answered < BATCH { self.requests.message().now_or_never() } else { None };
        }
        self.outbox.flush();
        Ok(Some(answered))
    }

    fn acknowledge(&self, stream: &LiveStream, acknowledged: &mut Option<u64>) -> Result<()> {
        let now = stream.acknowledged()?;
        if let Some(seq) = now
            && *acknowledged != now
        {
            *acknowledged = now;
            self.outbox.acknowledge(seq);
        }
        Ok(())
    }

    async fn answer(
        &self,
        camera: &CameraId,
        stream: &mut LiveStream,
        message: proto::StreamRequest,
    ) -> Result<()> {
        let answer = match message.kind {
            Some(Kind::Item(item)) => self.answer_item(camera, stream, item).await?,
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
        camera: &CameraId,
        stream: &mut LiveStream,
        item: proto::StreamItem,
    ) -> Result<proto::StreamAnswer> {
        let seq = item.seq;
        if let Err(error) = stream.number(seq) {
            return Ok(refused(seq, &error));
        }
        let rules = self.app.row_rules(camera).await?;
        let item = match live_item(item, &rules) {
            Ok(item) => item,
            Err(error) => {
                stream.pass(seq);
                return Ok(refused(seq, &error));
            }
        };
        match stream.take(seq, item).await {
            Ok(followed) => Ok(answered(seq, followed)),
            Err(Error::Refused(refusal)) if refusal.kind != ErrorKind::CameraNotFound => {
                // What was taken before the refusal has its own receipt.
                stream.acknowledged()?;
                stream.pass(seq);
                Ok(refused(seq, &Error::Refused(refusal)))
            }
            Err(error) => Err(error),
        }
    }
}

fn ending() -> Error {
    Error::refused(
        ErrorKind::ShuttingDown,
        "the server is ending; open the stream again behind the last acknowledged seq",
    )
}

fn answered(seq: u64, followed: crate::app::Followed) -> proto::StreamAnswer {
    let flags = match &followed.fused {
        Some(_) => Vec::new(),
        None => vec![proto::Flag::from(Flag::NoModel).into()],
    };
    proto::StreamAnswer {
        seq,
        outcome: followed.fused.map(|fused| Outcome::Fused(fused.into())),
        track: followed.track.map(|point| point.as_ref().into()),
        flags,
        lost_answers: 0,
    }
}

fn refused(seq: u64, error: &Error) -> proto::StreamAnswer {
    let told = status::of(error.kind());
    let (field, message) = match error {
        Error::Refused(refusal) => match refusal.violations.first() {
            Some(violation) => (violation.field.clone(), violation.message.clone()),
            None => (String::new(), refusal.message.clone()),
        },
        Error::Fault(_) => (String::new(), told.title.to_owned()),
    };
    let error = proto::StreamItemError { reason: told.slug.to_owned(), field, message };
    proto::StreamAnswer { seq, outcome: Some(Outcome::Error(error)), ..proto::StreamAnswer::default() }
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
            still: state.stationary_probability,
            nis: state.nis,
            rejections: state.rejected.iter().map(Into::into).collect(),
            restarted: state.reinitialized,
        }
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
        };
        Self { source: source.into(), reason: reason.into(), nis: rejection.nis }
    }
}

impl From<CameraMoved> for proto::CameraMoved {
    fn from(moved: CameraMoved) -> Self {
        Self {
            model_version: moved.model_version,
            began_at: Some(timestamp(moved.began_at)),
            raised_at: Some(timestamp(moved.raised_at)),
            shift_east_m: moved.shift_east_m,
            shift_north_m: moved.shift_north_m,
            statistic: moved.statistic,
            targets: moved.targets,
        }
    }
}
