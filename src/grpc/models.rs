//! `ModelService`.

use super::convert::{camera_id, fix, timestamp};
use super::pages;
use super::proto;
use super::proto::model_service_server::ModelService;
use super::statuses::{Reply, answer};
use crate::app::{App, GnssErrorEstimate};
use crate::domain::{Error, HeldOutError, ModelFormat, ModelVersion, Result, RunId};
use crate::exchange::{RowError, TimedFix};

pub(super) struct Models {
    app: App,
}

impl Models {
    pub(super) fn new(app: &App) -> Self {
        Self { app: app.clone() }
    }
}

#[tonic::async_trait]
impl ModelService for Models {
    async fn get_model(
        &self,
        request: tonic::Request<proto::GetModelRequest>,
    ) -> Reply<proto::GetModelResponse> {
        answer(&self.app, request, |app, asked| async move {
            let version = app.models().get(&camera_id(&asked.camera_id)?, asked.number).await?;
            Ok(proto::GetModelResponse { model: Some(model(version)?) })
        })
        .await
    }

    async fn list_models(
        &self,
        request: tonic::Request<proto::ListModelsRequest>,
    ) -> Reply<proto::ListModelsResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            let size = pages::size(asked.page_size, &app.limits)?;
            let page = app.models().list(&camera, pages::cursor::<u32>(&asked.page_token)?, size).await?;
            Ok(proto::ListModelsResponse {
                next_page_token: pages::token(page.next.as_ref()),
                models: page.items.into_iter().map(model).collect::<Result<_>>()?,
            })
        })
        .await
    }

    async fn activate_model(
        &self,
        request: tonic::Request<proto::ActivateModelRequest>,
    ) -> Reply<proto::ActivateModelResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            app.models().activate(&camera, asked.number).await?;
            let version = app.models().get(&camera, asked.number).await?;
            Ok(proto::ActivateModelResponse { model: Some(model(version)?) })
        })
        .await
    }

    async fn roll_back_model(
        &self,
        request: tonic::Request<proto::RollBackModelRequest>,
    ) -> Reply<proto::RollBackModelResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            app.models().roll_back(&camera).await?;
            let version = app.models().active(&camera).await?;
            Ok(proto::RollBackModelResponse { model: Some(model(version)?) })
        })
        .await
    }

    async fn download_model(
        &self,
        request: tonic::Request<proto::DownloadModelRequest>,
    ) -> Reply<proto::DownloadModelResponse> {
        answer(&self.app, request, |app, asked| async move {
            let format = model_format(asked.format)?;
            let file = app.models().download(&camera_id(&asked.camera_id)?, asked.number, format).await?;
            Ok(match format {
                ModelFormat::Safetensors => {
                    proto::DownloadModelResponse { safetensors: file, ..Default::default() }
                }
                ModelFormat::Onnx => proto::DownloadModelResponse { onnx: file, ..Default::default() },
            })
        })
        .await
    }

    async fn import_model(
        &self,
        request: tonic::Request<proto::ImportModelRequest>,
    ) -> Reply<proto::ImportModelResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = camera_id(&asked.camera_id)?;
            if asked.safetensors.is_empty() {
                return Err(Error::invalid("safetensors", "is required"));
            }
            let version = app.models().import(&camera, &asked.safetensors).await?;
            Ok(proto::ImportModelResponse { model: Some(model(version)?) })
        })
        .await
    }

    async fn delete_model(
        &self,
        request: tonic::Request<proto::DeleteModelRequest>,
    ) -> Reply<proto::DeleteModelResponse> {
        answer(&self.app, request, |app, asked| async move {
            app.models().delete(&camera_id(&asked.camera_id)?, asked.number).await?;
            Ok(proto::DeleteModelResponse {})
        })
        .await
    }

    async fn estimate_gnss_error(
        &self,
        request: tonic::Request<proto::EstimateGnssErrorRequest>,
    ) -> Reply<proto::EstimateGnssErrorResponse> {
        answer(&self.app, request, |app, asked| async move {
            app.cameras().get(&camera_id(&asked.camera_id)?).await?;
            let rows = (1..).zip(asked.fixes).map(|(line, message)| match fix(message) {
                Ok(fix) => Ok(Ok(TimedFix { time: None, fix })),
                Err(error) => RowError::of(line, error).map(Err),
            });
            Ok(GnssErrorEstimate::from_rows(rows, app.limits.rejected_rows)?.into())
        })
        .await
    }
}

fn model(version: ModelVersion) -> Result<proto::ModelVersion> {
    let metadata_json = serde_json::to_string(&version.metadata).map_err(Error::fault)?;
    Ok(proto::ModelVersion {
        camera_id: version.camera_id.as_str().to_owned(),
        number: version.number,
        run_id: version.run_id.map(|RunId(id)| id.to_string()),
        created_at: Some(timestamp(version.created_at)),
        weights_bytes: version.weights_bytes,
        recipe: version.metadata.recipe,
        samples: version.metadata.samples,
        error_scale: version.metadata.error_scale,
        e_gnss_m2: version.metadata.e_gnss_m2,
        held_out: version.metadata.held_out.map(Into::into),
        metadata_json,
    })
}

impl From<HeldOutError> for proto::HeldOutError {
    fn from(error: HeldOutError) -> Self {
        Self {
            blocks: error.blocks,
            samples: error.samples,
            mean_to_fix_m: error.mean_to_fix_m,
            error_to_fix_m2: error.error_to_fix_m2,
            e_regression_m2: error.e_regression_m2,
            coverage95_of_fixes: error.coverage95_of_fixes,
        }
    }
}

impl From<GnssErrorEstimate> for proto::EstimateGnssErrorResponse {
    fn from(estimate: GnssErrorEstimate) -> Self {
        Self {
            fixes: estimate.fixes,
            mean: Some(estimate.mean.into()),
            east_variance_m2: estimate.east_variance_m2,
            north_variance_m2: estimate.north_variance_m2,
            e_gnss_m2: estimate.e_gnss_m2,
            sigma_m: estimate.sigma_m,
            mean_distance_m: estimate.mean_distance_m,
            rejected: estimate.rejected,
            rejected_rows: estimate.rejected_rows.into_iter().map(Into::into).collect(),
        }
    }
}

/// # Errors
/// Names `format`.
fn model_format(format: i32) -> Result<ModelFormat> {
    match proto::ModelFormat::try_from(format) {
        Ok(proto::ModelFormat::Unspecified | proto::ModelFormat::Safetensors) => Ok(ModelFormat::Safetensors),
        Ok(proto::ModelFormat::Onnx) => Ok(ModelFormat::Onnx),
        Err(_) => Err(Error::invalid("format", "must be MODEL_FORMAT_SAFETENSORS or MODEL_FORMAT_ONNX")),
    }
}
