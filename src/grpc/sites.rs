//! `SiteService`: sites, and the requests for their tracks.

use prost::Message as _;

use super::convert::{instant, of_field, position, required, run_id, site_id, timestamp};
use super::history::history_settings;
use super::idempotency::idempotent;
use super::mask::named_fields;
use super::pages;
use super::proto;
use super::proto::site_service_server::SiteService;
use super::statuses::{Reply, answer, context};
use super::world_tracks::{Events, events, live_id};
use crate::app::{App, SiteRunRequest};
use crate::domain::{NewSite, Result, Revision, RunId, Site, SiteChange, SiteId};
use crate::shutdown::Shutdown;

pub(super) struct Sites {
    app: App,
    shutdown: Shutdown,
}

impl Sites {
    pub(super) fn new(app: &App, shutdown: &Shutdown) -> Self {
        Self { app: app.clone(), shutdown: shutdown.clone() }
    }
}

#[tonic::async_trait]
impl SiteService for Sites {
    async fn create_site(
        &self,
        request: tonic::Request<proto::CreateSiteRequest>,
    ) -> Reply<proto::CreateSiteResponse> {
        answer(&self.app, request, |app, asked| async move {
            let profile = new_site(SiteId::new(&asked.id)?, asked.profile.unwrap_or_default())
                .and_then(NewSite::check)
                .map_err(|error| error.under("profile"))?;
            Ok(proto::CreateSiteResponse { site: Some(app.sites().create(profile).await?.into()) })
        })
        .await
    }

    async fn get_site(
        &self,
        request: tonic::Request<proto::GetSiteRequest>,
    ) -> Reply<proto::GetSiteResponse> {
        answer(&self.app, request, |app, asked| async move {
            let site = app.sites().get(&site_id(&asked.site_id)?).await?;
            Ok(proto::GetSiteResponse { site: Some(site.into()) })
        })
        .await
    }

    async fn list_sites(
        &self,
        request: tonic::Request<proto::ListSitesRequest>,
    ) -> Reply<proto::ListSitesResponse> {
        answer(&self.app, request, |app, asked| async move {
            let size = pages::size(asked.page_size, &app.limits)?;
            let after = pages::cursor::<SiteId>(&asked.page_token)?;
            let page = app.sites().list(after.as_ref(), size).await?;
            Ok(proto::ListSitesResponse {
                next_page_token: pages::token(page.next.as_ref()),
                sites: page.items.into_iter().map(Into::into).collect(),
            })
        })
        .await
    }

    async fn update_site(
        &self,
        request: tonic::Request<proto::UpdateSiteRequest>,
    ) -> Reply<proto::UpdateSiteResponse> {
        answer(&self.app, request, |app, asked| async move {
            let id = site_id(&asked.site_id)?;
            let expected = asked.expected_revision.map(|revision| Revision(revision).into());
            let change = site_change(&id, required(asked.profile, "profile")?, asked.update_mask)?;
            let changed = app.sites().change(&id, change, expected).await;
            let site = changed.map_err(|error| of_field(error, "profile"))?;
            Ok(proto::UpdateSiteResponse { site: Some(site.into()) })
        })
        .await
    }

    async fn delete_site(
        &self,
        request: tonic::Request<proto::DeleteSiteRequest>,
    ) -> Reply<proto::DeleteSiteResponse> {
        answer(&self.app, request, |app, asked| async move {
            let id = site_id(&asked.site_id)?;
            app.sites()
                .delete(&id, asked.expected_revision.map(|revision| Revision(revision).into()))
                .await?;
            Ok(proto::DeleteSiteResponse {})
        })
        .await
    }

    async fn list_world_tracks(
        &self,
        request: tonic::Request<proto::ListWorldTracksRequest>,
    ) -> Reply<proto::ListWorldTracksResponse> {
        answer(&self.app, request, |app, asked| async move {
            let tracks = app.world_tracks().latest(&site_id(&asked.site_id)?).await?;
            Ok(proto::ListWorldTracksResponse {
                tracks: tracks.points.iter().map(|point| point.as_ref().into()).collect(),
                last_event_id: tracks.last_event.to_string(),
                clocks: tracks.clocks.cameras.iter().map(Into::into).collect(),
                receiver_clocks: tracks.clocks.receivers.by_receiver.iter().map(Into::into).collect(),
                common_receiver_clock: tracks.clocks.receivers.common.map(Into::into),
            })
        })
        .await
    }

    async fn get_world_track(
        &self,
        request: tonic::Request<proto::GetWorldTrackRequest>,
    ) -> Reply<proto::GetWorldTrackResponse> {
        answer(&self.app, request, |app, asked| async move {
            let site = site_id(&asked.site_id)?;
            let history = app.world_tracks().history(&site, live_id::of_track(&asked.track_id)?).await?;
            let points = history.iter().map(|point| point.as_ref().into()).collect();
            Ok(proto::GetWorldTrackResponse { points })
        })
        .await
    }

    async fn start_site_training_run(
        &self,
        request: tonic::Request<proto::StartSiteTrainingRunRequest>,
    ) -> Reply<proto::StartSiteTrainingRunResponse> {
        let idempotent = idempotent(&request, "StartSiteTrainingRun");
        answer(&self.app, request, |app, asked| async move {
            let idempotent = idempotent?;
            if let Some(request) = &idempotent {
                request.hasher.update(&asked.encode_to_vec());
            }
            let options = SiteRunRequest {
                seed: asked.seed,
                from: instant(asked.from, "from")?,
                until: instant(asked.until, "until")?,
            };
            let run = app.training().start(&site_id(&asked.site_id)?, options, idempotent).await?;
            Ok(proto::StartSiteTrainingRunResponse { run: Some(run.into()) })
        })
        .await
    }

    async fn get_site_training_run(
        &self,
        request: tonic::Request<proto::GetSiteTrainingRunRequest>,
    ) -> Reply<proto::GetSiteTrainingRunResponse> {
        answer(&self.app, request, |app, asked| async move {
            let run = app.training().get(&site_id(&asked.site_id)?, run_id(&asked.run_id)?).await?;
            Ok(proto::GetSiteTrainingRunResponse { run: Some(run.into()) })
        })
        .await
    }

    async fn list_site_training_runs(
        &self,
        request: tonic::Request<proto::ListSiteTrainingRunsRequest>,
    ) -> Reply<proto::ListSiteTrainingRunsResponse> {
        answer(&self.app, request, |app, asked| async move {
            let site = site_id(&asked.site_id)?;
            let size = pages::size(asked.page_size, &app.limits)?;
            let page = app.training().list(&site, pages::cursor::<RunId>(&asked.page_token)?, size).await?;
            Ok(proto::ListSiteTrainingRunsResponse {
                next_page_token: pages::token(page.next.as_ref()),
                runs: page.items.into_iter().map(Into::into).collect(),
            })
        })
        .await
    }

    async fn cancel_site_training_run(
        &self,
        request: tonic::Request<proto::CancelSiteTrainingRunRequest>,
    ) -> Reply<proto::CancelSiteTrainingRunResponse> {
        answer(&self.app, request, |app, asked| async move {
            let run = app.training().cancel(&site_id(&asked.site_id)?, run_id(&asked.run_id)?).await?;
            Ok(proto::CancelSiteTrainingRunResponse { run: Some(run.into()) })
        })
        .await
    }

    type WatchTracksStream = Events;

    async fn watch_tracks(&self, request: tonic::Request<proto::WatchTracksRequest>) -> Reply<Events> {
        let context = context(request.extensions())?;
        let (id, client) = (context.id().clone(), context.client());
        answer(&self.app, request, |app, asked| async move {
            let lease = app.quotas.event_streams.try_acquire(client, 1)?;
            let site = site_id(&asked.site_id)?;
            let after = live_id::to_resume_after(&asked.resume_after)?;
            let source = app.world_tracks().events(&site, after).await?;
            Ok(events(source, site, lease, self.shutdown.clone(), id))
        })
        .await
    }
}

/// A profile of which everything may be left out.
fn new_site(id: SiteId, profile: proto::SiteProfile) -> Result<NewSite> {
    let named = NewSite::named(id);
    let origin = profile.origin.map(|origin| position(origin).map_err(|error| error.under("origin")));
    Ok(NewSite {
        display_name: Some(profile.display_name)
            .filter(|name| !name.is_empty())
            .unwrap_or(named.display_name),
        labels: profile.labels.into_iter().collect(),
        origin: origin.transpose()?,
        history: profile.history.map(history_settings).transpose()?,
        id: named.id,
    })
}

/// The fields that the mask names, or those that the profile has.
fn site_change(
    id: &SiteId,
    profile: proto::SiteProfile,
    mask: Option<prost_types::FieldMask>,
) -> Result<SiteChange> {
    let has = [
        ("display_name", !profile.display_name.is_empty()),
        ("labels", !profile.labels.is_empty()),
        ("origin", profile.origin.is_some()),
        ("history", profile.history.is_some()),
    ];
    let present = has.into_iter().filter_map(|(field, has)| has.then_some(field)).collect();
    let is_named = named_fields(mask, &SiteChange::FIELDS, present)?;
    let profile = new_site(id.clone(), profile).map_err(|error| error.under("profile"))?;
    Ok(SiteChange::of_fields(profile, is_named))
}

impl From<Site> for proto::Site {
    fn from(site: Site) -> Self {
        Self {
            id: site.id().as_str().to_owned(),
            revision: site.revision.0,
            created_at: Some(timestamp(site.created_at)),
            updated_at: Some(timestamp(site.updated_at)),
            cameras: site.cameras,
            profile: Some(proto::SiteProfile {
                display_name: site.profile.display_name,
                labels: site.profile.labels.into_iter().collect(),
                origin: site.profile.origin.map(Into::into),
                history: site.profile.history.map(Into::into),
            }),
        }
    }
}
