//! `CameraService`.

use super::convert::{camera_id, of_field, position, recipe, required, site_id, timestamp};
use super::history::history_settings;
use super::mask::named_fields;
use super::pages;
use super::proto;
use super::proto::camera_service_server::CameraService;
use super::statuses::{Reply, answer};
use crate::app::{App, Learning, LearningState};
use crate::domain::{
    Camera, CameraChange, CameraId, ClockOffset, Error, GnssBiasSigma, GnssError, ImageSize, KnownPoint,
    NewCamera, Receiver, ReceiverId, Receivers, Result, Revision, SigmaM, SiteId, SnapshotSource,
    TargetClass, TargetId,
};

pub(super) struct Cameras {
    app: App,
}

impl Cameras {
    pub(super) fn new(app: &App) -> Self {
        Self { app: app.clone() }
    }
}

#[tonic::async_trait]
impl CameraService for Cameras {
    async fn create_camera(
        &self,
        request: tonic::Request<proto::CreateCameraRequest>,
    ) -> Reply<proto::CreateCameraResponse> {
        answer(&self.app, request, |app, asked| async move {
            let id = CameraId::new(&asked.id)?;
            let profile = new_camera(id, asked.profile.unwrap_or_default())
                .and_then(NewCamera::check)
                .map_err(|error| error.under("profile"))?;
            let camera = app.cameras().create(profile).await.map_err(|error| of_field(error, "profile"))?;
            Ok(proto::CreateCameraResponse { camera: Some(proto::Camera::of(&app, camera)) })
        })
        .await
    }

    async fn get_camera(
        &self,
        request: tonic::Request<proto::GetCameraRequest>,
    ) -> Reply<proto::GetCameraResponse> {
        answer(&self.app, request, |app, asked| async move {
            let camera = app.cameras().get(&camera_id(&asked.camera_id)?).await?;
            Ok(proto::GetCameraResponse { camera: Some(proto::Camera::of(&app, camera)) })
        })
        .await
    }

    async fn list_cameras(
        &self,
        request: tonic::Request<proto::ListCamerasRequest>,
    ) -> Reply<proto::ListCamerasResponse> {
        answer(&self.app, request, |app, asked| async move {
            let size = pages::size(asked.page_size, &app.limits)?;
            let after = pages::cursor::<CameraId>(&asked.page_token)?;
            let site = Some(&asked.site_id).filter(|id| !id.is_empty()).map(|id| site_id(id)).transpose()?;
            let page = app.cameras().list(site.as_ref(), after.as_ref(), size).await?;
            Ok(proto::ListCamerasResponse {
                next_page_token: pages::token(page.next.as_ref()),
                cameras: page.items.into_iter().map(|camera| proto::Camera::of(&app, camera)).collect(),
            })
        })
        .await
    }

    async fn update_camera(
        &self,
        request: tonic::Request<proto::UpdateCameraRequest>,
    ) -> Reply<proto::UpdateCameraResponse> {
        answer(&self.app, request, |app, asked| async move {
            let id = camera_id(&asked.camera_id)?;
            let expected = asked.expected_revision.map(|revision| Revision(revision).into());
            let change = camera_change(&id, required(asked.profile, "profile")?, asked.update_mask)?;
            let changed = app.cameras().change(&id, change, expected).await;
            let camera = changed.map_err(|error| of_field(error, "profile"))?;
            Ok(proto::UpdateCameraResponse { camera: Some(proto::Camera::of(&app, camera)) })
        })
        .await
    }

    async fn delete_camera(
        &self,
        request: tonic::Request<proto::DeleteCameraRequest>,
    ) -> Reply<proto::DeleteCameraResponse> {
        answer(&self.app, request, |app, asked| async move {
            let id = camera_id(&asked.camera_id)?;
            app.cameras()
                .delete(&id, asked.expected_revision.map(|revision| Revision(revision).into()))
                .await?;
            Ok(proto::DeleteCameraResponse {})
        })
        .await
    }

    async fn get_learning(
        &self,
        request: tonic::Request<proto::GetLearningRequest>,
    ) -> Reply<proto::GetLearningResponse> {
        answer(&self.app, request, |app, asked| async move {
            let learning = app.recordings().learning(&camera_id(&asked.camera_id)?).await?;
            Ok(proto::GetLearningResponse { learning: Some(learning.into()) })
        })
        .await
    }
}

/// A profile of which everything may be left out.
fn new_camera(id: CameraId, profile: proto::CameraProfile) -> Result<NewCamera> {
    let named = NewCamera::named(id);
    let location = profile.location.map(position).transpose();
    let classes = profile.target_classes.iter().enumerate().map(|(index, class)| {
        TargetClass::new(class).map_err(|error| renamed(error, format!("target_classes[{index}]")))
    });
    Ok(NewCamera {
        display_name: Some(profile.display_name)
            .filter(|name| !name.is_empty())
            .unwrap_or(named.display_name),
        image_size: profile.image_size.map(image_size).transpose()?,
        gnss_error: gnss_error(profile.gnss_error)?,
        location: location.map_err(|error| error.under("location"))?,
        gnss_bias_sigma: profile.gnss_bias_sigma_m.map(GnssBiasSigma::new).transpose()?,
        recipe: recipe(profile.recipe)?.unwrap_or_default(),
        target_classes: classes.collect::<Result<_>>()?,
        labels: profile.labels.into_iter().collect(),
        receivers: receivers(&profile.receivers)?,
        retrain_when_moved: profile.retrain_when_moved.unwrap_or(named.retrain_when_moved),
        learn_automatically: profile.learn_automatically.unwrap_or(named.learn_automatically),
        site: profile.site.as_deref().map(SiteId::new).transpose().map_err(|error| error.at("site"))?,
        snapshot: profile
            .snapshot
            .map(|it| SnapshotSource::new(&it.url, it.username, it.password))
            .transpose()?,
        history: profile.history.map(history_settings).transpose()?,
        known_points: known_points(&profile.known_points)?,
        id: named.id,
    })
}

/// The same refusal of another field.
fn renamed(mut error: Error, field: String) -> Error {
    if let Error::Refused(refusal) = &mut error
        && let Some(first) = refusal.violations.first_mut()
    {
        first.field = field;
    }
    error
}

/// The list as a value; the path of a field at fault begins at `receivers`.
fn receivers(given: &[proto::Receiver]) -> Result<Receivers> {
    let receiver = |(index, given): (usize, &proto::Receiver)| {
        receiver(given).map_err(|error| error.under(&format!("receivers[{index}]")))
    };
    Receivers::new(given.iter().enumerate().map(receiver).collect::<Result<Vec<_>>>()?)
}

fn receiver(given: &proto::Receiver) -> Result<Receiver> {
    let named = Receiver::named(ReceiverId::new(&given.receiver_id)?);
    let target_id = Some(given.target_id.as_str()).filter(|id| !id.is_empty());
    Ok(Receiver {
        target_id: target_id.map_or(Ok(named.target_id), TargetId::new)?,
        clock_offset: ClockOffset::from_seconds(given.clock_offset_s)?,
        sigma: given.sigma_m.map(SigmaM::new).transpose()?,
        receiver_id: named.receiver_id,
    })
}

fn known_points(given: &[proto::KnownPoint]) -> Result<Vec<KnownPoint>> {
    let point = |(index, given): (usize, &proto::KnownPoint)| {
        known_point(given).map_err(|error| error.under(&format!("known_points[{index}]")))
    };
    given.iter().enumerate().map(point).collect()
}

fn known_point(given: &proto::KnownPoint) -> Result<KnownPoint> {
    let at = given.position.unwrap_or_default();
    Ok(KnownPoint {
        image_px: [given.x_px, given.y_px],
        position: position(at).map_err(|error| error.under("position"))?,
        sigma_m: SigmaM::new(given.sigma_m.unwrap_or(KnownPoint::DEFAULT_SIGMA_M))?,
    })
}

fn image_size(size: proto::ImageSize) -> Result<ImageSize> {
    ImageSize::new(size.width_px, size.height_px).map_err(|error| error.under("image_size"))
}

fn gnss_error(error: Option<proto::GnssError>) -> Result<GnssError> {
    match error.and_then(|error| error.sigma_m) {
        None => Ok(GnssError::Unknown),
        Some(sigma_m) => {
            SigmaM::new(sigma_m).map(GnssError::Known).map_err(|error| error.under("gnss_error"))
        }
    }
}

/// The fields that the mask names, or those that the profile has.
fn camera_change(
    id: &CameraId,
    profile: proto::CameraProfile,
    mask: Option<prost_types::FieldMask>,
) -> Result<CameraChange> {
    let is_named = named_fields(mask, &CameraChange::FIELDS, present(&profile))?;
    let profile = new_camera(id.clone(), profile).map_err(|error| error.under("profile"))?;
    Ok(CameraChange::of_fields(profile, is_named))
}

/// Names of the fields that a profile has.
fn present(profile: &proto::CameraProfile) -> Vec<&'static str> {
    let has = [
        ("display_name", !profile.display_name.is_empty()),
        ("image_size", profile.image_size.is_some()),
        ("gnss_error", profile.gnss_error.is_some()),
        ("location", profile.location.is_some()),
        ("gnss_bias_sigma_m", profile.gnss_bias_sigma_m.is_some()),
        ("recipe", profile.recipe != proto::Recipe::Unspecified as i32),
        ("target_classes", !profile.target_classes.is_empty()),
        ("labels", !profile.labels.is_empty()),
        ("receivers", !profile.receivers.is_empty()),
        ("retrain_when_moved", profile.retrain_when_moved.is_some()),
        ("learn_automatically", profile.learn_automatically.is_some()),
        ("site", profile.site.is_some()),
        ("snapshot", profile.snapshot.is_some()),
        ("history", profile.history.is_some()),
        ("known_points", !profile.known_points.is_empty()),
    ];
    has.into_iter().filter_map(|(field, has)| has.then_some(field)).collect()
}

impl proto::Camera {
    fn of(app: &App, camera: Camera) -> Self {
        Self {
            moved: app.cameras().moved(camera.id()).map(|moved| (*moved).clone().into()),
            model_fault: app.models().fault(camera.id()).map(|fault| fault.reason),
            id: camera.id().as_str().to_owned(),
            warnings: app.cameras().warnings(&camera),
            profile: Some(camera.profile.into()),
            revision: camera.revision.0,
            created_at: Some(timestamp(camera.created_at)),
            updated_at: Some(timestamp(camera.updated_at)),
            active_model: camera.active_model,
            samples: camera.samples.all,
            samples_without_fix: camera.samples.without_fix,
        }
    }
}

impl From<NewCamera> for proto::CameraProfile {
    fn from(profile: NewCamera) -> Self {
        let sigma_m = match profile.gnss_error {
            GnssError::Known(sigma) => Some(sigma.metres()),
            GnssError::Unknown => None,
        };
        Self {
            display_name: profile.display_name,
            image_size: profile
                .image_size
                .map(|size| proto::ImageSize { width_px: size.width_px(), height_px: size.height_px() }),
            gnss_error: Some(proto::GnssError { sigma_m }),
            recipe: proto::Recipe::from(profile.recipe).into(),
            target_classes: profile.target_classes.iter().map(|class| class.as_str().to_owned()).collect(),
            labels: profile.labels.into_iter().collect(),
            receivers: profile.receivers.iter().map(Into::into).collect(),
            retrain_when_moved: Some(profile.retrain_when_moved),
            learn_automatically: Some(profile.learn_automatically),
            location: profile.location.map(Into::into),
            gnss_bias_sigma_m: profile.gnss_bias_sigma.map(GnssBiasSigma::metres),
            site: profile.site.map(|site| site.as_str().to_owned()),
            snapshot: profile.snapshot.map(|source| proto::SnapshotSource {
                url: source.url().to_owned(),
                username: source.username().map(str::to_owned),
                password: None,
            }),
            history: profile.history.map(Into::into),
            known_points: profile.known_points.into_iter().map(Into::into).collect(),
        }
    }
}

impl From<KnownPoint> for proto::KnownPoint {
    fn from(point: KnownPoint) -> Self {
        let [x_px, y_px] = point.image_px;
        Self { x_px, y_px, position: Some(point.position.into()), sigma_m: Some(point.sigma_m.metres()) }
    }
}

impl From<Learning> for proto::Learning {
    fn from(learning: Learning) -> Self {
        let state = match learning.state {
            LearningState::Off => proto::LearningState::Off,
            LearningState::Recording => proto::LearningState::Recording,
            LearningState::Matching => proto::LearningState::Matching,
            LearningState::Training => proto::LearningState::Training,
            LearningState::Learned => proto::LearningState::Learned,
        };
        let (attempted_at, attempt_outcome) = learning.last_attempt.unzip();
        Self {
            state: state.into(),
            message: learning.message,
            recorded_s: learning.recorded_s,
            needed_s: learning.needed_s,
            boxes: learning.boxes,
            fixes: learning.fixes,
            receivers: learning.receivers,
            attempted_at: attempted_at.map(timestamp),
            attempt_outcome,
            training_run: learning.training_run.map(|run| run.to_string()),
        }
    }
}

impl From<&Receiver> for proto::Receiver {
    fn from(receiver: &Receiver) -> Self {
        Self {
            receiver_id: receiver.receiver_id.as_str().to_owned(),
            target_id: receiver.target_id.as_str().to_owned(),
            clock_offset_s: receiver.clock_offset.seconds(),
            sigma_m: receiver.sigma.map(SigmaM::metres),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(profile: proto::CameraProfile, paths: Option<&[&str]>) -> Result<CameraChange> {
        let id = CameraId::new("yard").expect("a slug");
        let paths = paths.map(|paths| paths.iter().map(|&path| path.to_owned()).collect());
        camera_change(&id, profile, paths.map(|paths| prost_types::FieldMask { paths }))
    }

    #[test]
    fn without_a_mask_what_is_there_is_changed() {
        let profile = proto::CameraProfile { display_name: "Yard".to_owned(), ..Default::default() };
        let expected = CameraChange { display_name: Some("Yard".to_owned()), ..Default::default() };
        assert_eq!(change(profile, None).expect("good"), expected);
    }

    #[test]
    fn a_field_that_is_named_and_left_out_is_forgotten() {
        let profile = proto::CameraProfile { display_name: "Yard".to_owned(), ..Default::default() };
        let expected = CameraChange {
            image_size: Some(None),
            gnss_error: Some(GnssError::Unknown),
            ..CameraChange::default()
        };
        assert_eq!(change(profile, Some(&["image_size", "gnss_error"])).expect("good"), expected);
    }

    #[test]
    fn an_unknown_field_is_refused_by_its_place() {
        let refused = change(proto::CameraProfile::default(), Some(&["labels", "id"]));
        assert!(refused.expect_err("unknown").to_string().starts_with("update_mask.paths[1]"));
    }
}
