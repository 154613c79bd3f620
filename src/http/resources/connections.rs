//! `/v1/connections`: other systems that give detections and fixes, or take positions.

use std::collections::BTreeMap;
use std::time::Duration;

use axum::extract::{FromRequest, Request};
use bytes::Bytes;
use hyper::{HeaderMap, StatusCode, Uri};
use jiff::Timestamp;
use serde::Serialize;
use utoipa::{IntoResponses, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::app::{App, ConnectionRequest, ConnectionState, connection_settings};
use crate::connect::try_connection;
use crate::domain::{self, Error, Result};
use crate::exchange::wire::parse_json;
use crate::exchange::{ConnectionDraft, SinkSettings, SourceSettings, write_cursor};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::body;
use crate::http::plumbing::etag::{self, unless_known, with_etag};
use crate::http::plumbing::extract::{ConnectionPath, JsonBody, Params};
use crate::http::plumbing::merge_patch::{self, JsonObject};
use crate::http::plumbing::problem::{ApiError, ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{created, empty, json, json_text};

/// Seconds that a trial waits for a message, and the most that a client may ask for.
const TRIAL_S: u64 = 5;
const MAX_TRIAL_S: u64 = 60;
/// Fields of a connection that a patch may change.
const PATCHED: [&str; 4] = ["display_name", "paused", "source", "sink"];

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new()
        .routes(routes!(create_connection, list_connections))
        .routes(routes!(get_connection, change_connection, delete_connection))
        .routes(routes!(test_connection))
        .routes(routes!(push_message, push_query))
        .routes(routes!(push_message_with_key, push_query_with_key))
        .routes(routes!(list_dead_letters, delete_dead_letters))
        .routes(routes!(retry_dead_letters))
}

/// Changes to a connection (a merge patch, RFC 7396): what is left out stays, objects are merged.
#[derive(ToSchema)]
#[expect(dead_code, reason = "the shape of a patch, for the description alone")]
struct ConnectionChange {
    /// New name; null is the id.
    #[schema(max_length = 200)]
    display_name: Option<String>,
    /// True if the connection stays paused.
    paused: Option<bool>,
    /// Changes to the source.
    source: Option<SourceSettings>,
    /// Changes to the sink.
    sink: Option<SinkSettings>,
    /// Secrets to be set; one that is null is removed. Others stay, unless the address gets another scheme, host or port:
    /// then they are removed.
    secrets: Option<BTreeMap<String, Option<String>>>,
}

/// State of a connection.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
enum State {
    /// At rest, as the operator wants it.
    Paused,
    /// Tries to reach its peer.
    Connecting,
    /// Takes or gives messages.
    Running,
    /// Failed; tries again after a pause.
    Waiting,
}

impl From<ConnectionState> for State {
    fn from(state: ConnectionState) -> Self {
        match state {
            ConnectionState::Paused => Self::Paused,
            ConnectionState::Connecting => Self::Connecting,
            ConnectionState::Running => Self::Running,
            ConnectionState::Waiting => Self::Waiting,
        }
    }
}

/// A message, and what was read from it.
#[derive(Serialize, ToSchema)]
struct LastMessage {
    /// When it came or went.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// Its topic, or the address of its sender.
    subject: String,
    /// Its first 4 KiB.
    text: String,
    /// Its items, what was skipped and why, or why it cannot be read.
    reading: Vec<String>,
}

impl From<crate::app::LastMessage> for LastMessage {
    fn from(message: crate::app::LastMessage) -> Self {
        let crate::app::LastMessage { time, subject, text, reading } = message;
        Self { time, subject, text, reading }
    }
}

/// Why messages, or parts of them, were not taken.
#[derive(Serialize, ToSchema)]
struct CountedReason {
    /// The reason, of the latest of them.
    reason: String,
    /// Number of messages or parts; reasons that differ in numbers alone are one.
    count: u64,
    /// The latest of them: an item in words, or the beginning of a message.
    example: String,
    /// When that came.
    #[schema(value_type = String, format = DateTime)]
    last_at: Timestamp,
}

impl From<crate::app::CountedReason> for CountedReason {
    fn from(counted: crate::app::CountedReason) -> Self {
        let crate::app::CountedReason { reason, count, example, last_at } = counted;
        Self { reason, count, example, last_at }
    }
}

/// The latest error of a connection.
#[derive(Serialize, ToSchema)]
struct LastError {
    /// The time of the error.
    #[schema(value_type = String, format = DateTime)]
    time: Timestamp,
    /// The error's text.
    message: String,
}

/// The node that runs a connection.
#[derive(Serialize, ToSchema)]
struct ConnectionNode {
    /// Its id, as in `/v1/nodes`.
    id: String,
    /// Where clients reach it.
    #[serde(skip_serializing_if = "Option::is_none")]
    url: Option<String>,
}

/// The status of a connection since the server was started; counts are those of all nodes.
#[derive(Serialize, ToSchema)]
struct ConnectionStatus {
    /// State of the connection.
    state: State,
    /// The node that runs it, where several share a database; missing while none does.
    #[serde(skip_serializing_if = "Option::is_none")]
    node: Option<ConnectionNode>,
    /// The time of the latest change of the state.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime)]
    since: Option<Timestamp>,
    /// The latest error.
    #[serde(skip_serializing_if = "Option::is_none")]
    last_error: Option<LastError>,
    /// The last message.
    #[serde(skip_serializing_if = "Option::is_none")]
    last_message: Option<LastMessage>,
    /// Messages that came, or were delivered.
    messages: u64,
    /// Detections and fixes that were taken, or positions that were queued.
    items: u64,
    /// Detections and fixes that could not be taken, and parts of messages without any.
    skipped: u64,
    /// Messages that could not be read, or that the receiver refused.
    rejected: u64,
    /// Positions that were dropped since the outbox was full; one for each server that was killed and may have lost some.
    dropped: u64,
    /// Messages that were acknowledged to the peer.
    acknowledged: u64,
    /// Times that the peer was reached.
    connects: u64,
    /// Messages of a source that were dropped unread: too long, or sent without a promise (MQTT's QoS 0) faster than they
    /// are taken.
    lost: u64,
    /// Clients that are connected to a source `tcp-listen:` now.
    clients: u64,
    /// Clients that were refused or closed because there were too many; `last_error` says which.
    refused_clients: u64,
    /// Messages of a sink that wait.
    queued: u64,
    /// Messages of a sink that are not tried any more.
    dead_letters: u64,
    /// Boxes and fixes of a source, and messages without any, that wait until what is to be stored is stored. The peer gets
    /// no acknowledgement of their messages before; positions do not wait.
    unsettled: u64,
    /// Why messages, or parts of them, were not taken: at most 17 reasons.
    reasons: Vec<CountedReason>,
    /// Age of the last item when it came, s; of the oldest waiting message of a sink.
    #[serde(skip_serializing_if = "Option::is_none")]
    lag_s: Option<f64>,
}

/// A connection, without its secrets.
#[derive(Serialize, ToSchema)]
struct Connection {
    /// The slug that the operator chose.
    #[schema(example = "frigate")]
    id: String,
    /// The name for people.
    display_name: String,
    /// True if the connection stays paused.
    paused: bool,
    /// Takes detections or fixes in.
    #[serde(skip_serializing_if = "Option::is_none")]
    source: Option<SourceSettings>,
    /// Gives positions out.
    #[serde(skip_serializing_if = "Option::is_none")]
    sink: Option<SinkSettings>,
    /// Names of the secrets that are set.
    secret_names: Vec<String>,
    /// Counts its changes, from 1.
    revision: u64,
    /// When it was created.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// When it was changed last.
    #[schema(value_type = String, format = DateTime)]
    updated_at: Timestamp,
    /// The status of the connection; not part of the entity tag's revision.
    #[serde(skip_serializing_if = "Option::is_none")]
    status: Option<ConnectionStatus>,
}

impl Connection {
    /// The description alone.
    fn of(connection: domain::Connection) -> Result<Self> {
        let (settings, secrets) = connection_settings(&connection)?;
        Ok(Self {
            id: connection.id().as_str().to_owned(),
            display_name: connection.profile.display_name,
            paused: connection.profile.paused,
            source: settings.source,
            sink: settings.sink,
            secret_names: secrets.names().map(str::to_owned).collect(),
            revision: connection.revision.0,
            created_at: connection.created_at,
            updated_at: connection.updated_at,
            status: None,
        })
    }

    /// With what it does now.
    async fn with_status(app: &App, connection: domain::Connection) -> Result<Self> {
        let (status, node, outbox) = app.connections().status(&connection).await?;
        let status = ConnectionStatus {
            state: status.state.into(),
            node: node.map(|node| ConnectionNode { id: node.id.to_string(), url: node.url }),
            since: status.since,
            last_error: status.last_error.map(|(time, message)| LastError { time, message }),
            last_message: status.last_message.map(Into::into),
            messages: status.messages,
            items: status.items,
            skipped: status.skipped,
            rejected: status.rejected,
            dropped: status.dropped,
            acknowledged: status.acknowledged,
            connects: status.connects,
            lost: status.lost,
            clients: status.clients,
            refused_clients: status.refused_clients,
            queued: outbox.queued,
            dead_letters: outbox.dead,
            unsettled: status.unsettled,
            reasons: status.reasons.into_iter().map(Into::into).collect(),
            lag_s: status.lag_s,
        };
        Ok(Self { status: Some(status), ..Self::of(connection)? })
    }
}

/// A page of connections, by id.
#[derive(Serialize, ToSchema)]
struct ConnectionPage {
    /// A page of connections.
    items: Vec<Connection>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// The outcome of a trial of a connection.
#[derive(Serialize, ToSchema)]
struct Trial {
    /// The message with its reading; missing if none came, or nothing could be sent.
    #[serde(skip_serializing_if = "Option::is_none")]
    message: Option<LastMessage>,
    /// The error that ended the trial.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// A message that is not tried any more.
#[derive(Serialize, ToSchema)]
struct DeadLetter {
    /// Number of the dead letter.
    number: i64,
    /// Its id, as the receiver saw it.
    id: String,
    /// Where it was to go at the receiver.
    subject: String,
    /// Content of the message.
    text: String,
    /// When it was made.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// Why it is not tried any more.
    reason: String,
}

/// A page of dead letters, oldest first.
#[derive(Serialize, ToSchema)]
struct DeadLetterPage {
    /// A page of dead letters.
    items: Vec<DeadLetter>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Number of dead letters that were changed.
#[derive(Serialize, ToSchema)]
struct DeadLetterCount {
    /// Number of dead letters.
    dead_letters: u64,
}

/// Connect another system
///
/// It starts at once unless it is paused; its status says whether its peer can be reached. The server itself
/// opens a connection to the address, so only operators may do this.
#[utoipa::path(
    post, path = "/v1/connections", tag = "connections", request_body = ConnectionDraft,
    responses(
        (status = 201, description = "The stored connection", body = Connection,
            headers(("location" = String, description = "Its path"), ("etag" = String, description = "Names this state of it"))),
        (status = 409, description = "A connection of that id exists", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn create_connection(CallerApp(app): CallerApp, body: JsonBody) -> ApiResult {
    let connection = app.connections().create(body.read::<ConnectionDraft>()?.try_into()?).await?;
    let (location, version) = (format!("/v1/connections/{}", connection.id()), connection.version());
    let shown = Connection::of(connection)?;
    Ok(with_etag(created(StatusCode::CREATED, &location, &shown)?, version).await?)
}

/// List connections by id
#[utoipa::path(
    get, path = "/v1/connections", tag = "connections",
    params(
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses((status = 200, description = "A page of connections", body = ConnectionPage))
)]
async fn list_connections(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let limit = params.limit(app.limits.page_items)?;
    let after = params.cursor()?;
    params.end()?;
    let page = app.connections().list(after.as_ref(), limit).await?;
    let mut items = Vec::with_capacity(page.items.len());
    for connection in page.items {
        items.push(Connection::with_status(&app, connection).await?);
    }
    Ok(json(&ConnectionPage { items, next_cursor: page.next.map(|id| write_cursor(&id)) })?)
}

/// Read a connection, with what it does now
#[utoipa::path(
    get, path = "/v1/connections/{connection}", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("if-none-match" = Option<String>, Header, description = "An `etag` that was read; the answer is 304 while it is current"),
    ),
    responses(
        (status = 200, description = "The connection", body = Connection, headers(("etag" = String, description = "Names this state of it"))),
        (status = 304, description = "As the client knows it"),
    )
)]
async fn get_connection(
    CallerApp(app): CallerApp,
    ConnectionPath(id): ConnectionPath,
    headers: HeaderMap,
) -> ApiResult {
    let connection = app.connections().get(&id).await?;
    let version = connection.version();
    let shown = Connection::with_status(&app, connection).await?;
    Ok(unless_known(&headers, with_etag(json(&shown)?, version).await?))
}

/// Change, pause or resume a connection
///
/// A merge patch (RFC 7396): what is left out stays. The connection is closed and opened again. An address with another
/// scheme, host or port removes all secrets that the same patch does not set; `secret_names` shows what is left. The change is based on
/// a revision, named by the header `if-match` with the `etag` that was read; `if-match: *` changes whatever is there.
#[utoipa::path(
    patch, path = "/v1/connections/{connection}", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("if-match" = String, Header, description = "The `etag` that was read, or `*`"),
    ),
    request_body(content((ConnectionChange = "application/merge-patch+json"), (ConnectionChange = "application/json"))),
    responses(
        (status = 200, description = "The changed connection", body = Connection, headers(("etag" = String, description = "Names its new state"))),
        (status = 412, description = "The connection has another revision", body = Problem, content_type = "application/problem+json"),
        (status = 428, description = "`if-match` is missing", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn change_connection(
    CallerApp(app): CallerApp,
    ConnectionPath(id): ConnectionPath,
    headers: HeaderMap,
    body: JsonBody,
) -> ApiResult {
    let expected = etag::required(&headers)?;
    let mut patch = body.read::<JsonObject>()?;
    let secrets = secrets_of(patch.remove("secrets"))?;
    let change = || async {
        let connection = app.connections().get(&id).await?;
        let version = expected.unwrap_or(connection.version());
        let document = merge_patch::merged(&Connection::of(connection)?, &patch, &PATCHED)?;
        let mut request = ConnectionRequest::try_from(parse_json::<ConnectionDraft>(&document)?)?;
        request.secrets.clone_from(&secrets);
        app.connections().change(request, version).await
    };
    let changed = merge_patch::retried(expected.is_some(), change).await?;
    let version = changed.version();
    Ok(with_etag(json(&Connection::of(changed)?)?, version).await?)
}

/// The secrets of a patch.
fn secrets_of(patch: Option<serde_json::Value>) -> Result<BTreeMap<String, Option<String>>> {
    let Some(patch) = patch else { return Ok(BTreeMap::new()) };
    serde_json::from_value(patch)
        .map_err(|_| Error::invalid("secrets", "must be an object of texts; null removes a secret"))
}

/// Delete a connection with its outbox
#[utoipa::path(
    delete, path = "/v1/connections/{connection}", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("if-match" = Option<String>, Header, description = "Delete only at this revision"),
    ),
    responses(
        (status = 204, description = "It is gone"),
        (status = 412, description = "The connection has another revision", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn delete_connection(
    CallerApp(app): CallerApp,
    ConnectionPath(id): ConnectionPath,
    headers: HeaderMap,
) -> ApiResult {
    app.connections().delete(&id, etag::optional(&headers)?).await?;
    Ok(empty())
}

/// Try a connection
///
/// A source that runs shows its last message, or the next if none has come yet. A paused source is opened for a moment:
/// its next message is read and shown, and neither used nor acknowledged. A sink sends a position of the target
/// `sightfix-test` at longitude 0 and latitude 0.
#[utoipa::path(
    post, path = "/v1/connections/{connection}/test", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("wait_s" = Option<u64>, Query, description = "Seconds to wait for a message, 5 if left out, at most 60"),
    ),
    responses((status = 200, description = "The message and its reading, or what failed", body = Trial))
)]
async fn test_connection(
    CallerApp(app): CallerApp,
    ConnectionPath(id): ConnectionPath,
    uri: Uri,
) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let wait_s = params.take("wait_s", |text| {
        let seconds = text.parse().ok().filter(|seconds| (1..=MAX_TRIAL_S).contains(seconds));
        seconds.ok_or_else(|| Error::invalid("wait_s", format!("must be from 1 to {MAX_TRIAL_S}")))
    })?;
    params.end()?;
    let connection = app.connections().get(&id).await?;
    let tried = try_connection(&app, &connection, Duration::from_secs(wait_s.unwrap_or(TRIAL_S))).await?;
    Ok(json(&Trial { message: tried.message.map(Into::into), error: tried.error })?)
}

/// A message of any type, up to the limit of messages: the body, or the query of a request without one.
struct PushedBody(Bytes);

impl FromRequest<Rest> for PushedBody {
    type Rejection = ApiError;

    async fn from_request(request: Request, rest: &Rest) -> ApiResult<Self> {
        let (parts, content) = request.into_parts();
        let limit = rest.app.limits.connection_message_bytes;
        let content = body::whole(&parts.headers, content, limit).await?;
        Ok(Self(match parts.uri.query() {
            Some(query) if content.is_empty() => Bytes::copy_from_slice(query.as_bytes()),
            _ => content,
        }))
    }
}

/// The answers to a message that is handed in.
#[derive(IntoResponses)]
#[expect(dead_code, reason = "for the description alone")]
enum PushAnswers {
    /// It was taken; the answer that its application expects
    #[response(status = 200, content_type = "application/json")]
    Answered(String),
    /// It was taken
    #[response(status = 204)]
    Taken,
    /// Another node runs the source; `location` is the same at that node
    #[response(status = 307, content_type = "application/problem+json")]
    AtOtherNode(Problem<'static>),
    /// The connection is paused, or takes no messages by HTTP
    #[response(status = 409, content_type = "application/problem+json")]
    NotTaken(Problem<'static>),
}

/// Hands a message in, and answers as its application expects.
async fn taken(
    CallerApp(app): CallerApp,
    ConnectionPath(id): ConnectionPath,
    PushedBody(message): PushedBody,
) -> ApiResult {
    let answer = app.connections().push(&id, message).await?;
    Ok(answer.map_or_else(empty, json_text))
}

/// Hand a message to a source
///
/// For a source whose address is `push:`, such as the target of Traccar's forwarder or of a phone. The body is one message of the
/// source's format, whatever its content type; the answer comes when what was to be stored of it is stored. A key of
/// the role `edge` must be for all cameras that the connection names.
#[utoipa::path(
    post, path = "/v1/connections/{connection}/messages", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("parameters" = HashMap<String, String>, Query, style = Form, explode, nullable,
            description = "The message itself, of any names, where there is no body"),
    ),
    request_body(content = String, description = "A message of the source's format", content_type = "*/*"),
    responses(PushAnswers)
)]
async fn push_message(app: CallerApp, id: ConnectionPath, message: PushedBody) -> ApiResult {
    taken(app, id, message).await
}

/// Hand the message of a query to a source
///
/// For applications that can do nothing but fetch an address: the query is the message, such as `lat=30.6&lon=103.9`.
#[utoipa::path(
    get, path = "/v1/connections/{connection}/messages", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("parameters" = HashMap<String, String>, Query, style = Form, explode, nullable,
            description = "The message itself, of any names, such as `lat` and `lon`"),
    ),
    responses(PushAnswers)
)]
async fn push_query(app: CallerApp, id: ConnectionPath, message: PushedBody) -> ApiResult {
    taken(app, id, message).await
}

/// Hand a message to a source, with the key in the path
///
/// For applications that cannot set headers. The log and the metrics of the server do not show the key; those of a proxy may.
#[utoipa::path(
    post, path = "/v1/connections/{connection}/messages/{key}", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("key" = String, Path, description = "The secret of a key"),
        ("parameters" = HashMap<String, String>, Query, style = Form, explode, nullable,
            description = "The message itself, of any names, where there is no body"),
    ),
    request_body(content = String, description = "A message of the source's format", content_type = "*/*"),
    responses(PushAnswers)
)]
async fn push_message_with_key(app: CallerApp, id: ConnectionPath, message: PushedBody) -> ApiResult {
    taken(app, id, message).await
}

/// Hand the message of a query to a source, with the key in the path
///
/// For applications that can do nothing but fetch an address.
#[utoipa::path(
    get, path = "/v1/connections/{connection}/messages/{key}", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("key" = String, Path, description = "The secret of a key"),
        ("parameters" = HashMap<String, String>, Query, style = Form, explode, nullable,
            description = "The message itself, of any names, such as `lat` and `lon`"),
    ),
    responses(PushAnswers)
)]
async fn push_query_with_key(app: CallerApp, id: ConnectionPath, message: PushedBody) -> ApiResult {
    taken(app, id, message).await
}

/// List the messages of a sink that are not tried any more
#[utoipa::path(
    get, path = "/v1/connections/{connection}/dead-letters", tag = "connections",
    params(
        ("connection" = String, Path, description = "The connection's id"),
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses((status = 200, description = "A page of dead letters, oldest first", body = DeadLetterPage))
)]
async fn list_dead_letters(
    CallerApp(app): CallerApp,
    ConnectionPath(id): ConnectionPath,
    uri: Uri,
) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let limit = params.limit(app.limits.page_items)?;
    let after = params.take("cursor", |text| {
        text.parse().map_err(|_| Error::invalid("cursor", "must be the `next_cursor` of the page before"))
    })?;
    params.end()?;
    let page = app.connections().dead_letters(&id, after.unwrap_or(0), limit).await?;
    let shown = |letter: domain::DeadLetter| DeadLetter {
        number: letter.message.number,
        id: letter.message.message_id,
        subject: letter.message.subject,
        text: String::from_utf8_lossy(&letter.message.payload).into_owned(),
        created_at: letter.message.created_at,
        reason: letter.reason,
    };
    Ok(json(&DeadLetterPage {
        items: page.items.into_iter().map(shown).collect(),
        next_cursor: page.next.map(|number| number.to_string()),
    })?)
}

/// Delete the messages of a sink that are not tried any more
#[utoipa::path(
    delete, path = "/v1/connections/{connection}/dead-letters", tag = "connections",
    params(("connection" = String, Path, description = "The connection's id")),
    responses((status = 200, description = "How many there were", body = DeadLetterCount))
)]
async fn delete_dead_letters(CallerApp(app): CallerApp, ConnectionPath(id): ConnectionPath) -> ApiResult {
    Ok(json(&DeadLetterCount { dead_letters: app.connections().delete_dead_letters(&id).await? })?)
}

/// Try the dead letters of a sink again
#[utoipa::path(
    post, path = "/v1/connections/{connection}/dead-letters/retry", tag = "connections",
    params(("connection" = String, Path, description = "The connection's id")),
    responses((status = 200, description = "How many there were", body = DeadLetterCount))
)]
async fn retry_dead_letters(CallerApp(app): CallerApp, ConnectionPath(id): ConnectionPath) -> ApiResult {
    Ok(json(&DeadLetterCount { dead_letters: app.connections().retry_dead_letters(&id).await? })?)
}
