//! Shapes that several resources share.

use std::collections::BTreeMap;
use std::fmt;

use axum::body::Body;
use axum::response::Response;
use hyper::StatusCode;
use hyper::header::{CONTENT_TYPE, IntoHeaderName, LOCATION};
use hyper::http::HeaderValue;
use jiff::Timestamp;
use serde::de::{MapAccess, Visitor};
use serde::{Deserializer, Serialize};
use utoipa::ToSchema;

use crate::domain::{self, Error, MAX_LABELS, Result, parse_time};

/// Reads labels. More than there may be are not kept while they are read.
pub(in crate::http) fn labels<'de, D: Deserializer<'de>>(
    source: D,
) -> std::result::Result<BTreeMap<String, String>, D::Error> {
    source.deserialize_map(LabelsVisitor)
}

struct LabelsVisitor;

impl<'de> Visitor<'de> for LabelsVisitor {
    type Value = BTreeMap<String, String>;

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("a map")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut items: A) -> std::result::Result<Self::Value, A::Error> {
        let mut labels = BTreeMap::new();
        while let Some((name, value)) = items.next_entry()? {
            labels.insert(name, value);
            if labels.len() > MAX_LABELS {
                return Err(serde::de::Error::custom(format!("must be at most {MAX_LABELS}")));
            }
        }
        Ok(labels)
    }
}

/// The rule for a sample that is stored already.
#[derive(ToSchema)]
#[schema(rename_all = "snake_case")]
#[expect(dead_code, reason = "the values of a parameter, for the description alone")]
pub(in crate::http) enum OnConflict {
    /// It is counted as a duplicate; but a sample with a fix replaces one without.
    Keep,
    /// The new one takes its place.
    Replace,
}

/// When stored samples are acknowledged.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(in crate::http) enum Durability {
    /// After they have been flushed to the disk; they survive a power cut.
    Synced,
    /// After their commit; they survive a crash of the server, a power cut may undo the latest.
    Relaxed,
}

impl From<domain::Durability> for Durability {
    fn from(durability: domain::Durability) -> Self {
        match durability {
            domain::Durability::Synced => Self::Synced,
            domain::Durability::Relaxed => Self::Relaxed,
        }
    }
}

/// State of a job. Queued, running and cancelling jobs are live; the others have ended.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(in crate::http) enum JobState {
    /// Waits for a worker.
    Queued,
    /// A worker carries it out.
    Running,
    /// A worker carries it out and will end it soon: its cancellation was requested.
    Cancelling,
    /// Yielded what it was asked for.
    Succeeded,
    /// Ended by an error.
    Failed,
    /// Ended by the operator.
    Cancelled,
}

impl From<domain::JobState> for JobState {
    fn from(state: domain::JobState) -> Self {
        match state {
            domain::JobState::Queued => Self::Queued,
            domain::JobState::Running => Self::Running,
            domain::JobState::Cancelling => Self::Cancelling,
            domain::JobState::Succeeded => Self::Succeeded,
            domain::JobState::Failed => Self::Failed,
            domain::JobState::Cancelled => Self::Cancelled,
        }
    }
}

/// An instant of a body (RFC 3339); its refusal names the field.
pub(in crate::http) fn instant(field: &str, text: Option<&str>) -> Result<Option<Timestamp>> {
    let Some(text) = text else { return Ok(None) };
    parse_time(text).map(Some).map_err(|error| error.at(field))
}

/// A 200 of JSON.
pub(in crate::http) fn json(value: &impl Serialize) -> Result<Response> {
    json_of_about(value, 128)
}

/// A 200 of JSON whose length is about known, so that the buffer need not grow step by step.
pub(in crate::http) fn json_of_about(value: &impl Serialize, bytes: usize) -> Result<Response> {
    let mut json = Vec::with_capacity(bytes);
    serde_json::to_writer(&mut json, value).map_err(Error::fault)?;
    let mut response = Response::new(Body::from(json));
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/json"));
    Ok(response)
}

/// The media type of GeoJSON (RFC 7946).
pub(in crate::http) const GEOJSON: &str = "application/geo+json";

/// A 200 of GeoJSON.
pub(in crate::http) fn geojson(value: &impl Serialize) -> Result<Response> {
    let mut response = json(value)?;
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(GEOJSON));
    Ok(response)
}

/// A 201 or 202 of JSON, with the path of what was created.
pub(in crate::http) fn created(
    status: StatusCode,
    location: &str,
    value: &impl Serialize,
) -> Result<Response> {
    let mut response = json(value)?;
    *response.status_mut() = status;
    insert(&mut response, LOCATION, location)?;
    Ok(response)
}

fn insert(response: &mut Response, name: impl IntoHeaderName, value: &str) -> Result<()> {
    let value = HeaderValue::from_str(value).map_err(Error::fault)?;
    response.headers_mut().insert(name, value);
    Ok(())
}

/// An answer of JSON that is written already.
pub(in crate::http) fn json_text(text: &'static str) -> Response {
    let mut response = Response::new(Body::from(text));
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/json"));
    response
}

/// An answer without a body.
pub(in crate::http) fn empty() -> Response {
    let mut response = Response::new(Body::empty());
    *response.status_mut() = StatusCode::NO_CONTENT;
    response
}
