//! `FusionService`.

use tonic::Streaming;

use super::convert::{camera_id, observation, timestamp};
use super::outbox::Responses;
use super::proto;
use super::proto::fusion_service_server::FusionService;
use super::statuses::{Reply, answer, context};
use super::stream;
use crate::app::App;
use crate::domain::{Flag, FusedFix, TargetId, convert_all};
use crate::shutdown::Shutdown;

pub(super) struct Fusion {
    app: App,
    shutdown: Shutdown,
}

impl Fusion {
    pub(super) fn new(app: &App, shutdown: &Shutdown) -> Self {
        Self { app: app.clone(), shutdown: shutdown.clone() }
    }
}

#[tonic::async_trait]
impl FusionService for Fusion {
    type StreamStream = Responses;

    async fn stream(
        &self,
        request: tonic::Request<Streaming<proto::StreamRequest>>,
    ) -> Reply<Self::StreamStream> {
        let context = context(request.extensions())?.clone();
        let app = self.app.on_behalf_of(context.caller().clone());
        let responses = stream::serve(app, &self.shutdown, context, request.into_inner());
        Ok(tonic::Response::new(responses))
    }

    async fn fuse(&self, request: tonic::Request<proto::FuseRequest>) -> Reply<proto::FuseResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            app.limits.check_batch(asked.observations.len())?;
            let camera = app.active_camera(&camera).await?;
            let rules = camera.row_rules(app.clock.now());
            let convert = |message| observation(message, &rules);
            let observations = convert_all("observations", asked.observations, convert)?;
            let fused = app.fusion().fuse(camera, &observations).await?;
            Ok(proto::FuseResponse { fusions: fused.into_iter().map(Into::into).collect() })
        })
        .await
    }
}

impl From<FusedFix> for proto::FusedFix {
    fn from(fused: FusedFix) -> Self {
        Self {
            time: Some(timestamp(fused.time)),
            target_id: fused.target_id.as_ref().map(TargetId::as_str).map(str::to_owned),
            fused: Some(fused.fused.into()),
            regressed: fused.regressed.map(Into::into),
            gnss: fused.gnss.map(Into::into),
            confidence_regression: fused.confidences.regression,
            confidence_gnss: fused.confidences.gnss,
            e_regression_m2: fused.e_regression_m2,
            e_gnss_m2: fused.e_gnss_m2,
            r95_m: fused.r95_m,
            covariance: Some(fused.covariance.into()),
            regressed_covariance: fused.regressed_covariance.map(Into::into),
            reconstruction_error: fused.reconstruction_error,
            model_version: fused.model_version,
            flags: fused.flags.into_iter().map(|flag| proto::Flag::from(flag).into()).collect(),
        }
    }
}

impl From<Flag> for proto::Flag {
    fn from(flag: Flag) -> Self {
        match flag {
            Flag::GnssDenied => Self::GnssDenied,
            Flag::BoxMissing => Self::BoxMissing,
            Flag::BoxAtBorder => Self::BoxAtBorder,
            Flag::OutsideTraining => Self::OutsideTraining,
            Flag::NoModel => Self::NoModel,
            Flag::CameraMoved => Self::CameraMoved,
            Flag::SourcesDisagree => Self::SourcesDisagree,
            Flag::FixRejected => Self::FixRejected,
            Flag::BoxRejected => Self::BoxRejected,
            Flag::FixOutOfRange => Self::FixOutOfRange,
            Flag::BoxFrozen => Self::BoxFrozen,
            Flag::FootHidden => Self::FootHidden,
        }
    }
}
