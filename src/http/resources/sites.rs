//! `/v1/sites`: cameras whose targets are tracked together.

use std::collections::BTreeMap;

use hyper::{HeaderMap, StatusCode, Uri};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::history::HistorySettings;
use crate::domain::{self, NewSite, Result, SiteId};
use crate::exchange::wire::{Position, parse_json};
use crate::exchange::write_cursor;
use crate::http::plumbing::access::CallerApp;
use crate::http::plumbing::etag::{self, unless_known, with_etag};
use crate::http::plumbing::extract::{JsonBody, Params, SitePath};
use crate::http::plumbing::merge_patch::{self, JsonObject};
use crate::http::plumbing::problem::{ApiResult, Problem};
use crate::http::plumbing::state::Rest;
use crate::http::plumbing::wire::{created, empty, json};

pub(super) fn routes() -> OpenApiRouter<Rest> {
    OpenApiRouter::new().routes(routes!(create_site, list_sites)).routes(routes!(
        get_site,
        change_site,
        delete_site
    ))
}

/// A site to be stored. Cameras name it in their profiles.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct SiteDraft {
    /// A slug: 1 to 63 of `a-z`, `0-9` and `-`.
    #[schema(pattern = "^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", example = "harbour")]
    id: String,
    /// The name for people; the id if left out.
    #[schema(max_length = 200, example = "Harbour")]
    display_name: Option<String>,
    /// Free-form labels.
    #[serde(default, deserialize_with = "crate::http::plumbing::wire::labels")]
    labels: BTreeMap<String, String>,
    /// Origin of the plane in which targets are tracked; that of the first camera's model if left out. Targets
    /// farther than 20 km from it are not tracked.
    origin: Option<Position>,
    /// How finished world tracks are kept; none are if left out.
    history: Option<HistorySettings>,
}

impl SiteDraft {
    fn into_domain(self) -> Result<NewSite> {
        let named = NewSite::named(SiteId::new(&self.id)?);
        let origin = self.origin.map(Position::to_domain).transpose();
        Ok(NewSite {
            display_name: self.display_name.unwrap_or(named.display_name),
            labels: self.labels,
            origin: origin.map_err(|error| error.under("origin"))?,
            history: self.history.map(HistorySettings::to_domain).transpose()?,
            id: named.id,
        })
    }
}

/// Changes to a site (a merge patch, RFC 7396): what is left out stays, null restores the default, and objects
/// are merged.
#[derive(ToSchema)]
#[expect(dead_code, reason = "the shape of a patch, for the description alone")]
struct SiteChange {
    /// New name; null is the id.
    #[schema(max_length = 200)]
    display_name: Option<String>,
    /// Labels to be set; a label that is null is removed, null removes all.
    labels: Option<BTreeMap<String, Option<String>>>,
    /// New origin; null is that of the first camera's model. Tracks start again in the new plane.
    origin: Option<Position>,
    /// New settings of the history; null keeps no more tracks. What is kept already stays until it is deleted or too old.
    history: Option<HistorySettings>,
}

/// The change that a merge patch makes of a stored site.
fn patched(site: domain::Site, patch: &JsonObject) -> Result<domain::SiteChange> {
    let document = merge_patch::merged(&Site::from(site), patch, &domain::SiteChange::FIELDS)?;
    let profile = parse_json::<SiteDraft>(&document)?.into_domain()?;
    Ok(domain::SiteChange::of_fields(profile, |field| patch.contains_key(field)))
}

/// A stored site.
#[derive(Serialize, ToSchema)]
struct Site {
    /// The slug that the operator chose.
    #[schema(example = "harbour")]
    id: String,
    /// The name for people.
    display_name: String,
    /// Free-form labels.
    labels: BTreeMap<String, String>,
    /// Origin of the plane in which targets are tracked, if stated.
    #[serde(skip_serializing_if = "Option::is_none")]
    origin: Option<Position>,
    /// How finished world tracks are kept; missing if none are.
    #[serde(skip_serializing_if = "Option::is_none")]
    history: Option<HistorySettings>,
    /// Number of cameras whose profile names the site; `GET /v1/cameras?site=` lists them.
    cameras: u32,
    /// Counts the changes of the site, from 1.
    revision: u64,
    /// When it was created.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// When it was changed last.
    #[schema(value_type = String, format = DateTime)]
    updated_at: Timestamp,
}

impl From<domain::Site> for Site {
    fn from(site: domain::Site) -> Self {
        let domain::Site { profile, revision, created_at, updated_at, cameras, key: _ } = site;
        Self {
            id: profile.id.as_str().to_owned(),
            display_name: profile.display_name,
            labels: profile.labels,
            origin: profile.origin.map(Into::into),
            history: profile.history.map(Into::into),
            cameras,
            revision: revision.0,
            created_at,
            updated_at,
        }
    }
}

/// A page of sites, by id.
#[derive(Serialize, ToSchema)]
struct SitePage {
    /// A page of sites.
    items: Vec<Site>,
    /// Asks for the next page; missing on the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_cursor: Option<String>,
}

/// Store a new site
#[utoipa::path(
    post, path = "/v1/sites", tag = "sites", request_body = SiteDraft,
    responses(
        (status = 201, description = "The stored site", body = Site,
            headers(("location" = String, description = "Its path"), ("etag" = String, description = "Names this state of this site"))),
        (status = 409, description = "A site of that id exists", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn create_site(CallerApp(app): CallerApp, body: JsonBody) -> ApiResult {
    let site = app.sites().create(body.read::<SiteDraft>()?.into_domain()?).await?;
    let (location, version) = (format!("/v1/sites/{}", site.id()), site.version());
    Ok(with_etag(created(StatusCode::CREATED, &location, &Site::from(site))?, version).await?)
}

/// List sites by id
#[utoipa::path(
    get, path = "/v1/sites", tag = "sites",
    params(
        ("limit" = Option<u32>, Query, description = "Items on a page, 100 if left out"),
        ("cursor" = Option<String>, Query, description = "`next_cursor` of the page before"),
    ),
    responses((status = 200, description = "A page of sites", body = SitePage))
)]
async fn list_sites(CallerApp(app): CallerApp, uri: Uri) -> ApiResult {
    let mut params = Params::of(&uri)?;
    let limit = params.limit(app.limits.page_items)?;
    let after = params.cursor()?;
    params.end()?;
    let page = app.sites().list(after.as_ref(), limit).await?;
    Ok(json(&SitePage {
        items: page.items.into_iter().map(Site::from).collect(),
        next_cursor: page.next.map(|id| write_cursor(&id)),
    })?)
}

/// Read a site
#[utoipa::path(
    get, path = "/v1/sites/{site}", tag = "sites",
    params(
        ("site" = String, Path, description = "The site's id"),
        ("if-none-match" = Option<String>, Header, description = "An `etag` that was read; the answer is 304 while it is current"),
    ),
    responses(
        (status = 200, description = "The site", body = Site, headers(("etag" = String, description = "Names this state of this site"))),
        (status = 304, description = "As the client knows it"),
    )
)]
async fn get_site(CallerApp(app): CallerApp, SitePath(id): SitePath, headers: HeaderMap) -> ApiResult {
    let site = app.sites().get(&id).await?;
    let version = site.version();
    Ok(unless_known(&headers, with_etag(json(&Site::from(site))?, version).await?))
}

/// Change a site
///
/// A merge patch (RFC 7396): what is left out stays, null restores the default, objects such as labels are merged.
/// The change is based on a revision, named by the header `if-match` with the `etag` that was read;
/// `if-match: *` changes whatever is there.
#[utoipa::path(
    patch, path = "/v1/sites/{site}", tag = "sites",
    params(
        ("site" = String, Path, description = "The site's id"),
        ("if-match" = String, Header, description = "The `etag` that was read, or `*`"),
    ),
    request_body(content((SiteChange = "application/merge-patch+json"), (SiteChange = "application/json"))),
    responses(
        (status = 200, description = "The changed site", body = Site, headers(("etag" = String, description = "Names its new state"))),
        (status = 412, description = "The site has another revision", body = Problem, content_type = "application/problem+json"),
        (status = 428, description = "`if-match` is missing", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn change_site(
    CallerApp(app): CallerApp,
    SitePath(id): SitePath,
    headers: HeaderMap,
    body: JsonBody,
) -> ApiResult {
    let expected = etag::required(&headers)?;
    let patch = body.read::<JsonObject>()?;
    let change = || async {
        let site = app.sites().get(&id).await?;
        let version = expected.unwrap_or(site.version());
        app.sites().change(&id, patched(site, &patch)?, Some(version)).await
    };
    let changed = merge_patch::retried(expected.is_some(), change).await?;
    let version = changed.version();
    Ok(with_etag(json(&Site::from(changed))?, version).await?)
}

/// Delete a site with its tracks
///
/// A site that cameras name is not deleted: give them another site, or none, first.
#[utoipa::path(
    delete, path = "/v1/sites/{site}", tag = "sites",
    params(
        ("site" = String, Path, description = "The site's id"),
        ("if-match" = Option<String>, Header, description = "Delete only at this revision"),
    ),
    responses(
        (status = 204, description = "It is gone"),
        (status = 409, description = "Cameras belong to it", body = Problem, content_type = "application/problem+json"),
        (status = 412, description = "The site has another revision", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn delete_site(CallerApp(app): CallerApp, SitePath(id): SitePath, headers: HeaderMap) -> ApiResult {
    app.sites().delete(&id, etag::optional(&headers)?).await?;
    Ok(empty())
}
