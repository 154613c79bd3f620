//! `/v1/place-events`: what happened at places, as pages and as a stream.

use std::convert::Infallible;
use std::time::Duration;

use axum::extract::State;
use axum::response::IntoResponse as _;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::{StreamExt as _, stream};
use hyper::{HeaderMap, Uri};
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::tracks::{KEEP_ALIVE, event_of};
use crate::app::{StoredEvent, event_kind};
use crate::domain::{Error, PlaceEventFilter, PlaceId, Result};
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::extract::{Client, Params, scope_of};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::json;
use crate::places::event::PlaceEvent;
use crate::places::settings::EventKind;

/// How long a browser waits before it connects again.
const RECONNECT_AFTER: Duration = Duration::from_secs(2);

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(list_place_events)).routes(routes!(watch_place_events))
}

/// A page of events, in the order in which they were stored.
#[derive(Serialize, ToSchema)]
struct PlaceEventPage {
    /// A page of events.
    items: Vec<PlaceEvent>,
    /// The event to continue after, here and in the stream; missing if no event was ever read.
    #[serde(skip_serializing_if = "Option::is_none")]
    last_event_id: Option<String>,
    /// True if there are more events now.
    has_more: bool,
}

/// The filter that the parameters state.
fn filter_of(params: &mut Params) -> Result<PlaceEventFilter> {
    Ok(PlaceEventFilter {
        scope: scope_of(params)?,
        place: params.take("place", |id| PlaceId::new(id).map_err(|error| error.at("place")))?,
        kind: params.take("kind", event_kind)?,
    })
}

fn event_number(field: &'static str, text: &str) -> Result<i64> {
    let number = text.parse().ok().filter(|number| *number >= 0);
    number.ok_or_else(|| Error::invalid(field, "must be a last_event_id as this server gave it"))
}

/// List the events of places
///
/// In the order in which they were stored. An event is delivered once or more often; its `id` is the same each time.
#[utoipa::path(
    get, path = "/v1/place-events", tag = "places",
    params(
        ("site" = Option<String>, Query, description = "Only events of places of this site"),
        ("camera" = Option<String>, Query, description = "Only events of places of this camera"),
        ("place" = Option<String>, Query, description = "Only events of this place"),
        ("kind" = inline(Option<EventKind>), Query, description = "Only events of this kind"),
        ("after" = Option<String>, Query, description = "`last_event_id` of the page before; from the oldest event if left out"),
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
    ),
    responses(
        (status = 200, description = "A page of events", body = PlaceEventPage),
        (status = 404, description = "No such place, camera or site", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn list_place_events(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let filter = filter_of(&mut params)?;
    let after = params.take("after", |text| event_number("after", text))?;
    let limit = params.limit(app.limits.page_items)?;
    params.end()?;
    let page = app.places().events(&filter, after, limit).await?;
    let last = page.items.last().map(|event| event.number).or(after);
    Ok(json(&PlaceEventPage {
        last_event_id: last.map(|number| number.to_string()),
        has_more: page.next.is_some(),
        items: page.items.into_iter().map(|stored| stored.event).collect(),
    })?)
}

/// Watch the events of places
///
/// Server-sent events named `place_event`, from now on or after an event; each has an id, and a client that connects again
/// with `last-event-id`, as browsers do by themselves, misses none that is still stored.
#[utoipa::path(
    get, path = "/v1/place-events/stream", tag = "places",
    params(
        ("site" = Option<String>, Query, description = "Only events of places of this site"),
        ("camera" = Option<String>, Query, description = "Only events of places of this camera"),
        ("place" = Option<String>, Query, description = "Only events of this place"),
        ("kind" = inline(Option<EventKind>), Query, description = "Only events of this kind"),
        ("last-event-id" = Option<String>, Header, description = "The event to continue after; from now on if left out"),
        ("last_event_id" = Option<String>, Query, description = "The same for a first request, which a browser cannot give headers"),
    ),
    responses(
        (status = 200, description = "Events", body = PlaceEvent, content_type = "text/event-stream"),
        (status = 404, description = "No such camera or site", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn watch_place_events(
    State(rest): State<Rest>,
    CallerApp(app): CallerApp,
    Client(client): Client,
    headers: HeaderMap,
    uri: Uri,
) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let filter = filter_of(&mut params)?;
    let given = params.take("last_event_id", |text| event_number("last_event_id", text))?;
    params.end()?;
    let header = headers.get("last-event-id").map(|value| value.to_str().unwrap_or_default());
    let header = header.map(|text| event_number("last-event-id", text)).transpose()?;
    let lease = app.quotas.event_streams.try_acquire(client, 1)?;
    let events = app.places().watch(filter, header.or(given)).await?;
    let shutdown = rest.shutdown.clone();
    let sent = stream::unfold(Some(events), |events| async move {
        let mut events = events?;
        match events.next().await {
            Ok(stored) => Some((place_event(&stored), Some(events))),
            Err(error) => {
                tracing::error!(%error, "events of places cannot be read; their reader connects again");
                None
            }
        }
    });
    let sent = sent.take_until(async move { shutdown.draining().await }).map(move |event| {
        let _held = &lease; // until the stream is dropped
        Ok::<_, Infallible>(event)
    });
    Ok(Sse::new(sent).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)).into_response())
}

fn place_event(stored: &StoredEvent) -> Event {
    event_of("place_event", &stored.event).id(stored.number.to_string()).retry(RECONNECT_AFTER)
}
