//! Model versions: list, activate, roll back, download, import; the receiver's error.

use bytes::Bytes;
use jiff::Timestamp;

use super::active_cameras::ActiveCameras;
use super::registry::{ModelFault, Registry, unusable};
use super::{App, Page, page_of};
use crate::clock::Clock;
use crate::domain::{Camera, CameraId, Error, ErrorKind, ModelFormat, ModelVersion, Result};
use crate::exchange::{RowError, TimedFix};
use crate::geo::{EastNorth, LocalPlane, Position};
use crate::model::Artifact;
use crate::store::Store;

/// Fewest fixes from which the error is estimated.
const FEWEST_FIXES: u64 = 10;

/// The receiver's error from many fixes at one fixed point.
#[derive(Debug, Clone, PartialEq)]
pub struct GnssErrorEstimate {
    /// Fixes that were read.
    pub fixes: u64,
    /// Rows that were no fix.
    pub rejected: u64,
    /// The first of them, with their reasons.
    pub rejected_rows: Vec<RowError>,
    /// Their mean position.
    pub mean: Position,
    /// Variance of the east component, m2.
    pub east_variance_m2: f64,
    /// Variance of the north component, m2.
    pub north_variance_m2: f64,
    /// e_gnss of (6): the mean of the two, m2 per axis.
    pub e_gnss_m2: f64,
    /// Its square root, for the camera's profile.
    pub sigma_m: f64,
    /// Mean distance from the mean position, m.
    pub mean_distance_m: f64,
}

impl GnssErrorEstimate {
    /// Estimates from fixes taken while the receiver stood still. Memory does not grow with them.
    ///
    /// # Errors
    /// `InvalidArgument` naming `fixes` if there are fewer than ten, all are the same, or their times show that the
    /// receiver moved; a file that
    /// cannot be read.
    pub fn from_rows(
        rows: impl Iterator<Item = Result<std::result::Result<TimedFix, RowError>>>,
        reported_rows: usize,
    ) -> Result<Self> {
        let (mut moments, mut movement) = (PlaneMoments::default(), Movement::default());
        let (mut rejected, mut rejected_rows) = (0, Vec::new());
        for row in rows {
            match row? {
                Ok(row) => {
                    let point = moments.add(row.fix.position);
                    movement.extend(row.time.map(|time| (time, point)));
                }
                Err(row) => {
                    rejected += 1;
                    if rejected_rows.len() < reported_rows {
                        rejected_rows.push(row);
                    }
                }
            }
        }
        let Some(mean) = moments.mean_position().filter(|_| moments.count >= FEWEST_FIXES) else {
            let first = rejected_rows.first().map_or_else(String::new, |row: &RowError| {
                format!("; {rejected} were rejected, first line {}: {}: {}", row.line, row.field, row.reason)
            });
            let count = moments.count;
            return Err(Error::invalid(
                "fixes",
                format!("are {count}, at least {FEWEST_FIXES} from one fixed point are needed{first}"),
            ));
        };
        if movement.is_walking() {
            let message =
                "were taken while the receiver moved; its error shows while it stands at one fixed point";
            return Err(Error::invalid("fixes", message));
        }
        let [east_variance_m2, north_variance_m2] = moments.variances_m2();
        let e_gnss_m2 = 0.5 * (east_variance_m2 + north_variance_m2);
        if e_gnss_m2 <= 0.0 {
            return Err(Error::invalid("fixes", "are all the same, so they do not show the error"));
        }
        Ok(Self {
            fixes: moments.count,
            rejected,
            rejected_rows,
            mean,
            east_variance_m2,
            north_variance_m2,
            e_gnss_m2,
            sigma_m: e_gnss_m2.sqrt(),
            // Rayleigh: the mean length of an isotropic normal vector.
            mean_distance_m: (std::f64::consts::FRAC_PI_2 * e_gnss_m2).sqrt(),
        })
    }
}

/// Mean and scatter of positions in the plane of the first of them, in one pass (Welford 1962).
#[derive(Default)]
struct PlaneMoments {
    plane: Option<LocalPlane>,
    count: u64,
    /// East and north, m.
    mean_m: [f64; 2],
    /// Sums of squared deviations from the mean, m2.
    squares_m2: [f64; 2],
}

impl PlaneMoments {
    /// Adds a position; returns where it is in the plane.
    fn add(&mut self, position: Position) -> EastNorth {
        let point = self.plane.get_or_insert_with(|| LocalPlane::new(position)).to_plane(position);
        self.count += 1;
        for (axis, value_m) in [point.east_m, point.north_m].into_iter().enumerate() {
            let before_m = value_m - self.mean_m[axis];
            self.mean_m[axis] += before_m / self.count as f64;
            self.squares_m2[axis] += before_m * (value_m - self.mean_m[axis]);
        }
        point
    }

    fn mean_position(&self) -> Option<Position> {
        let [east_m, north_m] = self.mean_m;
        self.plane.as_ref().map(|plane| plane.to_position(EastNorth { east_m, north_m }))
    }

    /// Sample variances of east and north; for two positions or more.
    fn variances_m2(&self) -> [f64; 2] {
        self.squares_m2.map(|sum_m2| sum_m2 / (self.count - 1) as f64)
    }
}

/// The movement of a receiver, by the mean positions of successive intervals. The noise of fixes averages out over an
/// interval, and the slow error of a receiver that stands drifts by far less than somebody walks.
#[derive(Default)]
struct Movement {
    current: Option<Interval>,
    /// Mean position of the interval before, and its middle.
    previous: Option<(Timestamp, [f64; 2])>,
    slow_steps: u64,
    fast_steps: u64,
}

struct Interval {
    began_at: Timestamp,
    count: f64,
    mean_m: [f64; 2],
}

impl Movement {
    const INTERVAL_S: f64 = 10.0;
    /// Half of a slow walk.
    const WALKING_M_S: f64 = 0.4;

    fn extend(&mut self, fix: Option<(Timestamp, EastNorth)>) {
        let Some((time, EastNorth { east_m, north_m })) = fix else { return };
        let is_next = |interval: &Interval| seconds(interval.began_at, time).abs() >= Self::INTERVAL_S;
        if self.current.as_ref().is_some_and(is_next) {
            self.close_interval();
        }
        let interval = self.current.get_or_insert(Interval { began_at: time, count: 0.0, mean_m: [0.0; 2] });
        interval.count += 1.0;
        for (mean_m, value_m) in interval.mean_m.iter_mut().zip([east_m, north_m]) {
            *mean_m += (value_m - *mean_m) / interval.count;
        }
    }

    fn close_interval(&mut self) {
        let Some(Interval { began_at, mean_m: [east_m, north_m], .. }) = self.current.take() else { return };
        if let Some((before, [before_east_m, before_north_m])) = self.previous {
            let distance_m = (east_m - before_east_m).hypot(north_m - before_north_m);
            let is_fast = distance_m > Self::WALKING_M_S * seconds(before, began_at).abs();
            *(if is_fast { &mut self.fast_steps } else { &mut self.slow_steps }) += 1;
        }
        self.previous = Some((began_at, [east_m, north_m]));
    }

    /// True if most steps between intervals were fast.
    const fn is_walking(&self) -> bool {
        self.fast_steps > self.slow_steps
    }
}

fn seconds(from: Timestamp, to: Timestamp) -> f64 {
    to.duration_since(from).as_secs_f64()
}

/// The use cases of model versions.
#[derive(Clone, Copy)]
pub struct Models<'a> {
    store: &'a Store,
    registry: &'a Registry,
    clock: &'a Clock,
    cameras: ActiveCameras<'a>,
}

impl App {
    /// The use cases of model versions.
    #[must_use]
    pub fn models(&self) -> Models<'_> {
        Models {
            store: &self.store,
            registry: &self.registry,
            cameras: self.active_cameras(),
            clock: &self.clock,
        }
    }
}

impl Models<'_> {
    /// One version, without its weights.
    ///
    /// # Errors
    /// `CameraNotFound`, `ModelNotFound`.
    pub async fn get(&self, id: &CameraId, number: u32) -> Result<ModelVersion> {
        self.store.model(id, number).await
    }

    /// A camera's versions, newest first, after a cursor.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn list(
        &self,
        id: &CameraId,
        before: Option<u32>,
        limit: u32,
    ) -> Result<Page<ModelVersion, u32>> {
        let models = self.store.models(id, before, limit + 1).await?;
        Ok(page_of(models, limit, |model| model.number))
    }

    /// One version as a file of that format.
    ///
    /// # Errors
    /// `CameraNotFound`, `ModelNotFound`, `ModelUnusable`.
    pub async fn download(&self, id: &CameraId, number: u32, format: ModelFormat) -> Result<Bytes> {
        let (metadata, weights) = self.store.model_content(id, number).await?;
        let artifact = Artifact { metadata, weights: weights.into() };
        match format {
            ModelFormat::Safetensors => artifact.to_file().map_err(Error::fault),
            ModelFormat::Onnx => artifact.to_onnx().map_err(|error| unusable(id, number, error)),
        }
    }

    /// Stores a version from a file that [`Models::download`] gave, here or on another server.
    /// It does not become active by itself.
    ///
    /// # Errors
    /// `CameraNotFound`; `InvalidArgument` naming what in the file cannot be used, or the check that its
    /// answers do not pass.
    pub async fn import(&self, id: &CameraId, file: &[u8]) -> Result<ModelVersion> {
        self.cameras.get(id).await?;
        let artifact = Artifact::from_file(file)?;
        artifact.load()?;
        self.store.insert_model(id, &artifact.metadata, &artifact.weights, self.clock.now()).await
    }

    /// Deletes a version that is not the active one. Its number is never assigned again.
    ///
    /// # Errors
    /// `CameraNotFound`, `ModelNotFound`, `ModelActive`.
    pub async fn delete(&self, id: &CameraId, number: u32) -> Result<()> {
        self.store.delete_model(id, number, self.clock.now()).await
    }

    /// Makes a version the active one, which answers from now on.
    ///
    /// # Errors
    /// `CameraNotFound`, `ModelNotFound`; `ModelUnusable` if the stored version cannot be loaded.
    pub async fn activate(&self, id: &CameraId, number: u32) -> Result<Camera> {
        let (metadata, weights) = self.store.model_content(id, number).await?;
        let artifact = Artifact { metadata, weights: weights.into() };
        artifact.load().map_err(|error| unusable(id, number, error))?;
        let camera = self.store.activate_model(id, number, self.clock.now()).await?;
        self.registry.refresh_camera(self.store, id).await?;
        Ok(camera)
    }

    /// Makes the version active that was before the active one.
    ///
    /// # Errors
    /// `CameraNotFound`; `NoModel` if none is active, `NoEarlierModel` if none was before it.
    pub async fn roll_back(&self, id: &CameraId) -> Result<Camera> {
        let camera = self.store.roll_back(id, self.clock.now()).await?;
        self.registry.refresh_camera(self.store, id).await?;
        Ok(camera)
    }

    /// Why the camera's active version cannot be used, if so; it then answers by its fixes alone.
    #[must_use]
    pub fn fault(&self, id: &CameraId) -> Option<ModelFault> {
        self.registry.get(id)?.model_fault.clone()
    }

    /// The active version.
    ///
    /// # Errors
    /// `CameraNotFound`; `NoModel`.
    pub async fn active(&self, id: &CameraId) -> Result<ModelVersion> {
        let number =
            self.store.camera(id).await?.active_model.ok_or_else(|| {
                Error::refused(ErrorKind::NoModel, format!("camera {id} has no active model"))
            })?;
        self.store.model(id, number).await
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Fix;
    use crate::simulation::standard_normal;
    use rand::SeedableRng;

    #[test]
    fn the_estimate_finds_the_spread() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let plane = LocalPlane::new(Position::new(103.9, 30.6).expect("valid"));
        let mut normal = || standard_normal(&mut random);
        let fixes: Vec<_> = (0..4_000)
            .map(|_| {
                let point = EastNorth { east_m: 2.0 * normal(), north_m: 3.0 * normal() };
                at(plane.to_position(point))
            })
            .collect();
        let estimate =
            GnssErrorEstimate::from_rows(fixes.into_iter().map(|row| Ok(Ok(row))), 0).expect("enough");
        // Standard error of a variance from 4,000 is 2.2 %: five of them.
        assert!((estimate.east_variance_m2 / 4.0 - 1.0).abs() < 0.11, "{estimate:?}");
        assert!((estimate.north_variance_m2 / 9.0 - 1.0).abs() < 0.11, "{estimate:?}");
    }

    /// Fixes of 2 m noise once a second from a receiver that moves east.
    fn moving(speed_m_s: f64) -> Result<GnssErrorEstimate> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(2);
        let plane = LocalPlane::new(Position::new(103.9, 30.6).expect("valid"));
        let fixes: Vec<_> = (0..300_i32)
            .map(|second| {
                let east_m = speed_m_s * f64::from(second) + 2.0 * standard_normal(&mut random);
                let point = EastNorth { east_m, north_m: 2.0 * standard_normal(&mut random) };
                let time = Timestamp::from_second(1_700_000_000 + i64::from(second)).ok();
                TimedFix { time, ..at(plane.to_position(point)) }
            })
            .collect();
        GnssErrorEstimate::from_rows(fixes.into_iter().map(|row| Ok(Ok(row))), 0)
    }

    #[test]
    fn a_receiver_that_walks_is_refused_and_one_that_drifts_is_not() {
        let refused = moving(1.0).expect_err("a walk").to_string();
        assert!(refused.contains("while the receiver moved"), "{refused}");
        assert!(moving(0.0).is_ok());
        // The slow error of a receiver that stands: metres in minutes.
        assert!(moving(0.05).is_ok());
    }

    fn at(position: Position) -> TimedFix {
        TimedFix { time: None, fix: Fix { position, sigma_m: None } }
    }

    #[test]
    fn few_or_equal_fixes_are_refused() {
        let fix = at(Position::new(1.0, 2.0).expect("valid"));
        for count in [9, 50] {
            let rows = std::iter::repeat_n(fix, count).map(|row| Ok(Ok(row)));
            assert!(GnssErrorEstimate::from_rows(rows, 0).is_err());
        }
    }
}
