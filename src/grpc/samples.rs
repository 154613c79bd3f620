//! `SampleService`.

use futures_util::{Stream, StreamExt as _, TryStreamExt as _, stream};
use prost::Message as _;
use tonic::Streaming;

use super::convert::{camera_id, durability, on_conflict, sample, sample_filter};
use super::idempotency::idempotent;
use super::pages;
use super::pairings::{Pieces, pair};
use super::proto;
use super::proto::sample_service_server::SampleService;
use super::statuses::{Reply, answer, broken, context};
use crate::app::{App, ImportOptions, ImportReport, RejectedRow};
use crate::domain::{Durability, Error, ErrorKind, RequestHasher, Result, SampleCount, StoredSample};
use crate::exchange::RowRules;
use crate::request::RequestContext;
use crate::shutdown::Shutdown;
use crate::store::{SampleFilter, SampleKey};

pub(super) struct Samples {
    app: App,
    shutdown: Shutdown,
}

impl Samples {
    pub(super) fn new(app: &App, shutdown: &Shutdown) -> Self {
        Self { app: app.clone(), shutdown: shutdown.clone() }
    }
}

#[tonic::async_trait]
impl SampleService for Samples {
    async fn import_samples(
        &self,
        request: tonic::Request<Streaming<proto::ImportSamplesRequest>>,
    ) -> Reply<proto::ImportSamplesResponse> {
        let context = context(request.extensions())?.clone();
        let idempotent = idempotent(&request, "ImportSamples");
        answer(&self.app, request, |app, messages| async move {
            let shutdown = self.shutdown.clone();
            let mut batches = Batches { messages, context, shutdown, camera: String::new() };
            let Some(first) = batches.next().await? else {
                return Err(Error::invalid("camera_id", "is required in the first message"));
            };
            let camera = camera_id(&first.camera_id)?;
            let durability = durability(first.durability)?;
            let on_conflict = on_conflict(first.on_conflict)?;
            let idempotent = idempotent?;
            if let Some(request) = &idempotent {
                request.hasher.update(first.camera_id.as_bytes());
                request.hasher.update(durability.to_string().as_bytes());
                request.hasher.update(on_conflict.to_string().as_bytes());
            }
            batches.camera = first.camera_id;
            let rules = app.samples().row_rules(&camera).await?;
            let hasher = idempotent.as_ref().map(|request| request.hasher.clone());
            let rows = rows(first.samples, batches, rules, hasher);
            let options = ImportOptions { durability, on_conflict, idempotent };
            let report = app.samples().import_rows(&camera, rows, options).await?;
            Ok(imported(report, durability))
        })
        .await
    }

    async fn pair_samples(
        &self,
        request: tonic::Request<Streaming<proto::PairSamplesRequest>>,
    ) -> Reply<proto::PairSamplesResponse> {
        let context = context(request.extensions())?.clone();
        let idempotent = idempotent(&request, "PairSamples");
        answer(&self.app, request, |app, messages| async move {
            let pieces = Pieces { messages, context, shutdown: self.shutdown.clone() };
            pair(&app, pieces, idempotent?).await
        })
        .await
    }

    async fn list_samples(
        &self,
        request: tonic::Request<proto::ListSamplesRequest>,
    ) -> Reply<proto::ListSamplesResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            let filter = sample_filter(asked.filter)?;
            let size = pages::size(asked.page_size, &app.limits)?;
            let after = pages::cursor::<SampleKey>(&asked.page_token)?;
            let page = app.samples().list(&camera, &filter, after, size).await?;
            Ok(proto::ListSamplesResponse {
                next_page_token: pages::token(page.next.as_ref()),
                samples: page.items.into_iter().map(Into::into).collect(),
            })
        })
        .await
    }

    async fn count_samples(
        &self,
        request: tonic::Request<proto::CountSamplesRequest>,
    ) -> Reply<proto::CountSamplesResponse> {
        answer(&self.app, request, |app, asked| async move {
            let filter = sample_filter(asked.filter)?;
            let count = app.samples().count(&camera_id(&asked.camera_id)?, &filter).await?;
            let SampleCount { all, without_fix } = count;
            Ok(proto::CountSamplesResponse { count: all, without_fix })
        })
        .await
    }

    async fn delete_samples(
        &self,
        request: tonic::Request<proto::DeleteSamplesRequest>,
    ) -> Reply<proto::DeleteSamplesResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            let filter = sample_filter(asked.filter)?;
            if filter == SampleFilter::default() {
                return Err(Error::invalid(
                    "filter",
                    "must have from, until, target_id or has_fix, so that not all samples go by an oversight",
                ));
            }
            let deleted = app.samples().delete(&camera, &filter).await?;
            Ok(proto::DeleteSamplesResponse { deleted })
        })
        .await
    }
}

/// The messages of an import, one at a time.
struct Batches {
    messages: Streaming<proto::ImportSamplesRequest>,
    context: RequestContext,
    shutdown: Shutdown,
    /// As the first message names it.
    camera: String,
}

impl Batches {
    async fn next(&mut self) -> Result<Option<proto::ImportSamplesRequest>> {
        tokio::select! {
            // First, so that a client whose backlog never ends cannot hold the server up.
            biased;
            () = self.shutdown.draining() => Err(Error::refused(
                ErrorKind::ShuttingDown,
                "the server is ending; send the samples again, those that are stored count as duplicates",
            )),
            message = self.messages.message() => {
                message.map_err(|status| self.context.body_refusal().unwrap_or_else(|| broken(&status)))
            }
        }
    }

    /// The samples of the next message.
    async fn samples(&mut self) -> Result<Option<Vec<proto::Sample>>> {
        let Some(message) = self.next().await? else { return Ok(None) };
        if !message.camera_id.is_empty() && message.camera_id != self.camera {
            return Err(Error::invalid("camera_id", "must be that of the first message, or empty"));
        }
        Ok(Some(message.samples))
    }
}

/// The samples of a whole stream one by one, each with its ordinal if it is at fault. No more than one
/// message is held at a time.
fn rows(
    first: Vec<proto::Sample>,
    batches: Batches,
    rules: RowRules,
    hasher: Option<RequestHasher>,
) -> impl Stream<Item = Result<Result<StoredSample, RejectedRow>>> + Send {
    let later = stream::try_unfold(batches, |mut batches| async move {
        Ok(batches.samples().await?.map(|samples| (samples, batches)))
    });
    let all = stream::once(async { Ok(first) }).chain(later);
    let mut line = 0;
    all.map_ok(|samples| stream::iter(samples.into_iter().map(Ok::<_, Error>))).try_flatten().map(
        move |message| {
            line += 1;
            let message = message?;
            if let Some(hasher) = &hasher {
                hasher.update(&message.encode_to_vec());
            }
            match sample(message, &rules) {
                Ok(sample) => Ok(Ok(sample)),
                Err(error) => RejectedRow::of(line, error).map(Err),
            }
        },
    )
}

fn imported(report: ImportReport, durability: Durability) -> proto::ImportSamplesResponse {
    proto::ImportSamplesResponse {
        accepted: report.accepted,
        accepted_without_fix: report.without_fix,
        duplicate: report.duplicate,
        replaced: report.replaced,
        rejected: report.rejected,
        rejected_rows: report.rejected_rows.into_iter().map(Into::into).collect(),
        durability: proto::Durability::from(durability).into(),
        warnings: report.warnings,
    }
}
