//! Trying a connection: the next message of a source and what it says, or a test message of a sink.

use std::time::Duration;

use super::credentials::PeerError;
use super::intake::describe;
use super::kinds;
use super::publish::payload;
use super::sink::Outcomes;
use super::source::{Settled, SourceIdentity};
use crate::app::{App, ConnectionState, LastMessage, connection_settings};
use crate::domain::{CameraId, Connection, OutboxMessage, Result, TargetId};
use crate::exchange::kinds::SinkContent;
use crate::exchange::{
    MessageContext, OutgoingPosition, Secrets, SinkSettings, SourceSettings, source_decoder,
};
use crate::geo::{PlaneCovariance, Position};
use crate::places::settings::EventKind;

/// How often the status of a running source is looked at.
const WATCH_EVERY: Duration = Duration::from_millis(100);
/// The target of test messages.
const TEST_TARGET: &str = "sightfix-test";

/// The outcome of a trial of a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trial {
    /// The message, with what was read from it; `None` if none came in time.
    pub message: Option<LastMessage>,
    /// The error that ended the trial.
    pub error: Option<String>,
}

/// Tries a connection for at most `wait`. A source that runs shows its last message, or the next if none has come; a
/// paused one is opened for a moment, and nothing of its message is used or acknowledged. A sink sends a position of
/// the target `sightfix-test` at longitude 0, latitude 0.
///
/// # Errors
/// The stored settings cannot be read.
pub async fn try_connection(app: &App, connection: &Connection, wait: Duration) -> Result<Trial> {
    let (settings, secrets) = connection_settings(connection)?;
    let tried = match (&settings.source, &settings.sink) {
        (Some(source), _) if connection.profile.paused => {
            tokio::time::timeout(wait, try_source(app, connection, source, &secrets)).await
        }
        (Some(_), _) => Ok(watch(app, connection, wait).await),
        (None, Some(sink)) => tokio::time::timeout(wait, try_sink(app, connection, sink, &secrets)).await,
        (None, None) => return Err(crate::domain::Error::fault("a connection without source and sink")),
    };
    Ok(match tried {
        Ok(Ok(message)) => Trial { message, error: None },
        Ok(Err(error)) => Trial { message: None, error: Some(error.to_string()) },
        Err(_) => {
            let error = format!("nothing came within {} s", wait.as_secs());
            Trial { message: None, error: Some(error) }
        }
    })
}

/// The last message of a source that runs.
async fn watch(app: &App, connection: &Connection, wait: Duration) -> Result<Option<LastMessage>, PeerError> {
    let until = app.clock.monotonic() + wait;
    loop {
        // Another node may run it.
        let (status, ..) = app.connections().status(connection).await?;
        let is_last = app.clock.monotonic() >= until;
        match (status.last_message, status.last_error) {
            (Some(message), _) => return Ok(Some(message)),
            (None, Some((_, error))) if is_last || status.state == ConnectionState::Waiting => {
                return Err(PeerError(error));
            }
            _ if is_last => return Err(PeerError(format!("nothing came within {} s", wait.as_secs()))),
            _ => tokio::time::sleep(WATCH_EVERY).await,
        }
    }
}

async fn try_source(
    app: &App,
    connection: &Connection,
    settings: &SourceSettings,
    secrets: &Secrets,
) -> Result<Option<LastMessage>, PeerError> {
    let random = app.randomness.uuid_v7(app.clock.now()).simple();
    let identity = SourceIdentity {
        client_id: format!("sightfix-{}-test-{random}", connection.id()),
        is_lasting: false,
    };
    let live = app.connections().live(connection);
    let mut source = kinds::source(app, connection, settings, secrets, &identity, &live).await?;
    let message = source.next().await?;
    let now = app.clock.now();
    let time_bounds = app.limits.live_time_bounds(now);
    let context = MessageContext { subject: &message.subject, received_at: now, time_bounds };
    let content = message.content(app.limits.connection_message_bytes);
    let reading = match content.and_then(|content| source_decoder(settings).decode(content, &context)) {
        Ok(read) => {
            let skipped = read.skipped.iter().map(|reason| format!("skipped: {reason}"));
            read.items.iter().map(describe).chain(skipped).take(32).collect()
        }
        Err(reason) => vec![format!("rejected: {reason}")],
    };
    let outcome = Err("the connection is only tried".to_owned());
    source.settle(vec![Settled { receipt: message.receipt, outcome }]).await?;
    Ok(Some(LastMessage::new(now, message.subject, &message.payload, reading)))
}

async fn try_sink(
    app: &App,
    connection: &Connection,
    settings: &SinkSettings,
    secrets: &Secrets,
) -> Result<Option<LastMessage>, PeerError> {
    let now = app.clock.now();
    let random = app.randomness.uuid_v7(now);
    let client_id = format!("sightfix-{}-test-{}", connection.id(), random.simple());
    let mut sink = kinds::sink(app, connection.id(), settings, secrets, (&client_id, false)).await?;
    let cameras = settings.cameras()?;
    // A sink of events may name sites alone.
    let camera = &cameras.first().cloned().map_or_else(|| CameraId::new(TEST_TARGET), Ok)?;
    let target = TargetId::new(TEST_TARGET)?;
    let message_id = random.to_string();
    let position = OutgoingPosition {
        message_id: &message_id,
        camera_id: camera,
        target_id: &target,
        receiver_match: None,
        time: now,
        position: Position::new(0.0, 0.0).map_err(|error| PeerError(error.to_string()))?,
        covariance: PlaneCovariance::isotropic(1.0),
        r95_m: PlaneCovariance::isotropic(1.0).r95_m(),
        velocity_m_s: [0.0; 2],
    };
    let message = OutboxMessage {
        number: 0,
        subject: match settings.content {
            SinkContent::Positions => settings.topic()?.of(camera, &target),
            SinkContent::PlaceEvents => settings.topic()?.of_event(TEST_TARGET, EventKind::Enter.as_str()),
        },
        payload: payload(settings, &position),
        created_at: now,
        message_id,
    };
    let mut outcomes = Outcomes::new();
    sink.deliver(std::slice::from_ref(&message), &mut outcomes).await?;
    let outcome = outcomes.pop().map_or(Ok(()), |(_, outcome)| outcome);
    let reading = outcome.map_or_else(|reason| reason, |()| "delivered".to_owned());
    Ok(Some(LastMessage::new(now, message.subject, &message.payload, vec![reading])))
}
