//! The cameras of a site trained together: cross-validation over whole receivers, the joint fit, and a model per camera.
//!
//! A held-out receiver is left out of the fit of every camera, with its boxes that hold cameras to each other, so that
//! what is said of a joint fit is said of people whom no camera had seen.

use std::ops::ControlFlow;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::held_out::HeldOutResiduals;
use super::observed_scene::put_scene;
use super::pipeline::{MAX_ROWS, receiver_variance};
use super::report::{coverage_of_fixes, held_out_error};
use super::track_noise::estimate_track_noise;
use super::widening::held_out_widening;
use crate::artifact::{Artifact, FORMAT, ModelParts};
use crate::domain::{
    CandidateFinding, CandidateReport, Error, ErrorKind, FeatureScale, GaussMarkovNoise, GnssError,
    GnssErrorSource, HeldOutError, HeldOutSampleError, ImageSize, JointTraining, KnownPoint, ModelMetadata,
    OriginDeg, Recipe, RunProgress, Sample, TrainingReport,
};
use crate::encoder::features::features_of;
use crate::geo::{EastNorth, LocalPlane};
use crate::progress::{FitError, FitEvent, FitRun, Phase};
use crate::recipes::gaussian_process::{
    EPOCHS, KNOWN_POINTS, SHARED_BIAS_SHARE, UprightStarts, target_height_m, widen_map,
};
use crate::regressor::Regressor;
use crate::samples::rows::{HELD_OUT_BLOCKS, TrainingRow, TrainingRows, sha256_of};
use crate::samples::target_groups::groups_of_targets;
use crate::site::rows::SiteRows;
use crate::site::{
    RECEIVER_CORRELATION, SiteFitError, SiteFitInput, SiteFix, SiteKnownPoint, SiteMaps, SitePair,
    fit_site_observed,
};
use crate::statistics::median;
use crate::uncertainty::calibration::calibrate_reconstruction;
use crate::uncertainty::coverage::Coverage;
use crate::uncertainty::error_model::{set_image_size, set_uncalibrated};

/// Names of the candidates in a model's report.
const TOGETHER: &str = "site/together";
const APART: &str = "site/apart";
/// A squared residual counts at most this many times their median.
const LARGEST_SQUARE_RATIO: f64 = 10.0;

/// One camera of a site to be trained.
#[derive(Debug, Clone, Copy)]
pub struct SiteCamera<'a> {
    /// The camera's id, for messages.
    pub id: &'a str,
    /// Boxes with the fix of the same instant. Samples of one target in several cameras are of one receiver.
    pub samples: &'a [Sample],
    /// Size of the camera's image, if known.
    pub image_size: Option<ImageSize>,
    /// The receivers' error, if known.
    pub gnss_error: GnssError,
    /// Standard deviation per axis, m, of the bias that all fixes have in common, if known.
    pub gnss_bias_sigma_m: Option<f64>,
    /// Points of the ground whose place is known.
    pub known_points: &'a [KnownPoint],
}

/// A camera's model of a joint fit.
#[derive(Debug, Clone)]
pub struct SiteCameraModel {
    /// The model.
    pub artifact: Artifact,
    /// Its error on each sample of receivers that the fit had not seen.
    pub held_out: Vec<HeldOutSampleError>,
    /// Error of a map of the same form that was trained on this camera alone, if it could be.
    pub apart: Option<HeldOutError>,
}

/// The models of all cameras of a site, and what training them together gained.
#[derive(Debug, Clone)]
pub struct SiteModels {
    /// In the order of the input.
    pub cameras: Vec<SiteCameraModel>,
    /// Number of receivers.
    pub receivers: u32,
    /// Pairs of boxes that held cameras to each other.
    pub pairs: u32,
    /// Mean distance of the positions of held-out pairs, m: by maps that were trained together, and by maps that were
    /// trained one by one.
    pub disagreement_m: [Option<f64>; 2],
}

/// Trains the cameras of a site together, on the calling thread. The same input gives the same models bit for bit on one
/// machine.
///
/// # Errors
/// [`FitError::Cancelled`] when the observer breaks, [`FitError::Unusable`] where the samples of a camera, which
/// is named, cannot support a fit.
pub fn fit_site_models(
    cameras: &[SiteCamera<'_>],
    joint_training: &JointTraining,
    seed: u64,
    observer: &mut dyn FnMut(FitEvent<'_>) -> ControlFlow<()>,
) -> Result<SiteModels, FitError> {
    let rows = cameras.iter().map(training_rows).collect::<Result<Vec<_>, _>>()?;
    let samples: Vec<&[Sample]> = cameras.iter().map(|camera| camera.samples).collect();
    let plane = rows.first().map(|own| own.plane).ok_or_else(|| unusable("there is no camera".to_owned()))?;
    let site = SiteRows::new(&samples, &plane);
    let classes = samples.iter().flat_map(|own| own.iter().map(|sample| sample.class.as_ref()));
    let target_height_m = target_height_m(classes);
    let upright = cameras.iter().zip(&rows).map(|(camera, own)| upright_starts(camera, own, target_height_m));
    let upright = upright.collect();
    let groups = Groups::new(&site);
    let known_points = known_points(cameras, &plane);
    let fit =
        SiteFit { known_points, cameras, rows: &rows, plane, groups, site, joint_training, upright, seed };
    let mut run = FitRun { observer, progress: RunProgress::default() };
    run.progress.epochs = 2 * fit.groups.count + 1 + EPOCHS * cameras.len() as u32;
    let (form, validation) = fit.select(&mut run)?;
    fit.begin(&mut run, "final fit".to_owned())?;
    let maps = fit.fit(form, &fit.site.fixes, &fit.pairs(|_| true), &mut run)?;
    let cameras = (0..cameras.len())
        .map(|camera| fit.model(camera, &maps, &validation, &mut run))
        .collect::<Result<_, FitError>>()?;
    Ok(SiteModels {
        cameras,
        receivers: fit.site.receivers.len() as u32,
        pairs: fit.site.pairs.len() as u32,
        disagreement_m: validation.disagreement.map(|mean| mean.value()),
    })
}

fn known_points(cameras: &[SiteCamera<'_>], plane: &LocalPlane) -> Vec<SiteKnownPoint> {
    let of_camera = |(camera, own): (usize, &SiteCamera<'_>)| {
        let point = |point: &KnownPoint| SiteKnownPoint {
            camera,
            image_px: point.image_px,
            position: plane.to_plane(point.position),
            variance_m2: point.sigma_m.variance_m2(),
        };
        own.known_points.iter().map(point).collect::<Vec<_>>()
    };
    cameras.iter().enumerate().flat_map(of_camera).collect()
}

fn training_rows(camera: &SiteCamera<'_>) -> Result<TrainingRows, FitError> {
    let rows = TrainingRows::new(camera.samples);
    Ok(rows.map_err(|error| unusable(format!("of camera {}: {error}", camera.id)))?.thinned(MAX_ROWS))
}

/// The heights of boxes need no fix, so that boxes of held-out receivers are among them.
fn upright_starts(
    camera: &SiteCamera<'_>,
    rows: &TrainingRows,
    target_height_m: (f64, f64),
) -> Option<UprightStarts> {
    let boxes: Vec<_> = rows.rows.iter().map(|row| (row.target, features_of(&row.bounding_box))).collect();
    UprightStarts::new(&boxes, camera.image_size?, target_height_m)
}

fn unusable(message: String) -> FitError {
    FitError::Unusable(Error::field(ErrorKind::UnusableSamples, "samples", message))
}

/// The groups that are held out together: whole receivers; blocks of time where one receiver has nearly all fixes.
struct Groups {
    count: u32,
    /// Group of each row if whole receivers are held out.
    of_receiver: Option<Vec<usize>>,
    /// Times at which blocks after the first begin, s.
    cuts_s: Vec<f64>,
}

impl Groups {
    fn new(site: &SiteRows<'_>) -> Self {
        let mut rows = vec![0; site.receivers.len()];
        site.fixes.iter().for_each(|fix| rows[fix.receiver as usize] += 1);
        if let Some((groups, count)) = groups_of_targets(&rows, HELD_OUT_BLOCKS as usize) {
            return Self { count: count as u32, of_receiver: Some(groups), cuts_s: Vec::new() };
        }
        let mut times_s: Vec<f64> = site.fixes.iter().map(|fix| fix.time_s).collect();
        times_s.sort_by(f64::total_cmp);
        let block = times_s.len() / HELD_OUT_BLOCKS as usize;
        let cuts_s = (1..HELD_OUT_BLOCKS as usize).map(|cut| times_s[cut * block]).collect();
        Self { count: HELD_OUT_BLOCKS, of_receiver: None, cuts_s }
    }

    fn of(&self, receiver: u32, time_s: f64) -> u32 {
        match &self.of_receiver {
            Some(groups) => groups[receiver as usize] as u32,
            None => self.cuts_s.iter().filter(|cut_s| time_s >= **cut_s).count() as u32,
        }
    }
}

/// A mean under way.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1.0;
    }

    fn value(self) -> Option<f64> {
        (self.count > 0.0).then(|| self.sum / self.count)
    }
}

/// Held-out predictions of a camera's rows.
struct CameraValidation {
    groups: Vec<u32>,
    together: HeldOutResiduals,
    /// `None` where the camera alone could not be trained.
    apart: Option<HeldOutResiduals>,
}

/// Held-out predictions of all rows, and the disagreement between cameras trained together and apart.
struct Validation {
    cameras: Vec<CameraValidation>,
    disagreement: [Mean; 2],
}

/// The observations that the maps are fitted to besides the feet of boxes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MapForm {
    /// No other observations.
    Foot,
    /// The heights of boxes: cameras are upright, and targets of one kind are about equally tall.
    Upright,
}

impl MapForm {
    const fn as_str(self) -> &'static str {
        match self {
            Self::Foot => "feet alone",
            Self::Upright => "upright cameras",
        }
    }
}

/// A site under training.
struct SiteFit<'a> {
    cameras: &'a [SiteCamera<'a>],
    rows: &'a [TrainingRows],
    /// The plane of the joint fit.
    plane: LocalPlane,
    groups: Groups,
    site: SiteRows<'a>,
    known_points: Vec<SiteKnownPoint>,
    joint_training: &'a JointTraining,
    /// The cameras that the heights of boxes allow, where these are known.
    upright: Vec<Option<UprightStarts>>,
    seed: u64,
}

impl SiteFit<'_> {
    /// Begins a step of the run.
    fn begin(&self, run: &mut FitRun<'_>, phase: String) -> Result<(), FitError> {
        run.progress.phase = phase;
        let progress = run.progress.clone();
        run.notify(FitEvent::Progress(&progress))?;
        run.progress.epoch += 1;
        Ok(())
    }

    fn pairs(&self, keep: impl Fn(&SitePair) -> bool) -> Vec<SitePair> {
        self.site.pairs.iter().filter(|pair| keep(pair)).copied().collect()
    }

    /// The form of the maps whose held-out residuals are the smaller, by their mean squares over all cameras with every
    /// square bounded.
    fn select(&self, run: &mut FitRun<'_>) -> Result<(MapForm, Validation), FitError> {
        let foot = self.cross_validate(MapForm::Foot, run)?;
        if self.upright.iter().all(Option::is_none) {
            return Ok((MapForm::Foot, foot));
        }
        let upright = match self.cross_validate(MapForm::Upright, run) {
            Err(FitError::Unusable(_)) => return Ok((MapForm::Foot, foot)),
            upright => upright?,
        };
        let squares = |validation: &Validation| -> Vec<f64> {
            let residuals = validation.cameras.iter().flat_map(|own| &own.together.residuals);
            residuals.map(|[east, north]| east * east + north * north).collect()
        };
        let (of_foot, of_upright) = (squares(&foot), squares(&upright));
        let bound_m2 = LARGEST_SQUARE_RATIO * median(of_foot.clone());
        let score = |squares: Vec<f64>| squares.into_iter().map(|square| square.min(bound_m2)).sum::<f64>();
        let is_upright = score(of_upright) < score(of_foot);
        Ok(if is_upright { (MapForm::Upright, upright) } else { (MapForm::Foot, foot) })
    }

    /// Fits the maps of all cameras.
    fn fit(
        &self,
        form: MapForm,
        fixes: &[SiteFix],
        pairs: &[SitePair],
        run: &mut FitRun<'_>,
    ) -> Result<SiteMaps, FitError> {
        let image_sizes: Vec<_> = self.cameras.iter().map(|camera| camera.image_size).collect();
        let input = SiteFitInput {
            image_sizes: &image_sizes,
            fixes,
            pairs,
            known_points: &self.known_points,
            correlation: RECEIVER_CORRELATION,
        };
        self.observed(self.upright_of(form), &input, run).map_err(|error| match error {
            SiteFitError::Cancelled => FitError::Cancelled,
            SiteFitError::TooFewRows { camera } => unusable(format!(
                "of camera {} are too few, or of too few receivers: without a quarter of the receivers, which is held \
                 out in turn, the camera has fewer than 12 fixes and targets in common with other cameras; import more, \
                 of several receivers",
                self.cameras[camera].id
            )),
            SiteFitError::NoSolution => unusable(error.to_string()),
        })
    }

    /// Returns the evidence of the heights of boxes, if the form uses it.
    fn upright_of(&self, form: MapForm) -> &[Option<UprightStarts>] {
        match form {
            MapForm::Foot => &[],
            MapForm::Upright => &self.upright,
        }
    }

    fn observed(
        &self,
        upright: &[Option<UprightStarts>],
        input: &SiteFitInput<'_>,
        run: &mut FitRun<'_>,
    ) -> Result<SiteMaps, SiteFitError> {
        fit_site_observed(input, upright, &mut || (run.observer)(FitEvent::Progress(&run.progress)))
    }

    /// Each camera on the fixes of the receivers that it sees; `None` where these are too few.
    fn fit_apart(
        &self,
        form: MapForm,
        fixes: &[SiteFix],
        run: &mut FitRun<'_>,
    ) -> Result<Vec<Option<SiteMaps>>, FitError> {
        let of_camera = |(index, camera): (usize, &SiteCamera<'_>)| {
            let own: Vec<SiteFix> = fixes.iter().filter_map(|fix| fix.seen_by(index)).collect();
            let upright = self.upright_of(form).get(index).map_or(&[][..], std::slice::from_ref);
            let known: Vec<SiteKnownPoint> = self
                .known_points
                .iter()
                .filter(|point| point.camera == index)
                .map(|point| SiteKnownPoint { camera: 0, ..*point })
                .collect();
            let image_sizes = [camera.image_size];
            let input = SiteFitInput {
                image_sizes: &image_sizes,
                fixes: &own,
                pairs: &[],
                known_points: &known,
                correlation: RECEIVER_CORRELATION,
            };
            match self.observed(upright, &input, run) {
                Ok(maps) => Ok(Some(maps)),
                Err(SiteFitError::Cancelled) => Err(FitError::Cancelled),
                Err(_) => Ok(None),
            }
        };
        self.cameras.iter().enumerate().map(of_camera).collect()
    }

    /// Leaves out each group in turn.
    fn cross_validate(&self, form: MapForm, run: &mut FitRun<'_>) -> Result<Validation, FitError> {
        let empty = |rows: &TrainingRows| HeldOutResiduals {
            residuals: vec![[0.0; 2]; rows.rows.len()],
            predicted_m2: vec![0.0; rows.rows.len()],
        };
        let camera_validation = |(camera, rows): (usize, &TrainingRows)| CameraValidation {
            groups: rows.rows.iter().map(|row| self.group_of(camera, row)).collect(),
            together: empty(rows),
            apart: Some(empty(rows)),
        };
        let cameras = self.rows.iter().enumerate().map(camera_validation).collect();
        let mut validation = Validation { cameras, disagreement: [Mean::default(); 2] };
        for group in 0..self.groups.count {
            let phase = format!("{}: held-out group {} of {}", form.as_str(), group + 1, self.groups.count);
            self.begin(run, phase)?;
            let is_kept = |receiver, time_s| self.groups.of(receiver, time_s) != group;
            let kept = self.site.fixes.iter().filter(|fix| is_kept(fix.receiver, fix.time_s));
            let fixes: Vec<SiteFix> = kept.cloned().collect();
            let pairs = self.pairs(|pair| is_kept(pair.target, pair.time_s));
            let together = self.fit(form, &fixes, &pairs, run)?;
            let apart = self.fit_apart(form, &fixes, run)?;
            for (camera, own) in validation.cameras.iter_mut().enumerate() {
                self.predict(camera, group, (&together, camera), &own.groups, &mut own.together);
                own.apart = own.apart.take().zip(apart[camera].as_ref()).map(|(mut residuals, maps)| {
                    self.predict(camera, group, (maps, 0), &own.groups, &mut residuals);
                    residuals
                });
            }
            let left_out = self.site.pairs.iter().filter(|pair| !is_kept(pair.target, pair.time_s));
            for pair in left_out {
                let [one, other] =
                    [0, 1].map(|at| together.locate(pair.cameras[at], &pair.boxes[at]).position);
                validation.disagreement[0].add(one.distance_m(other));
                if let [Some(one), Some(other)] = pair.cameras.map(|camera| apart[camera].as_ref()) {
                    let [one, other] = [one.locate(0, &pair.boxes[0]), other.locate(0, &pair.boxes[1])];
                    validation.disagreement[1].add(one.position.distance_m(other.position));
                }
            }
        }
        Ok(validation)
    }

    fn group_of(&self, camera: usize, row: &TrainingRow) -> u32 {
        let sample = &self.cameras[camera].samples[row.sample as usize];
        self.groups.of(self.site.receivers[&sample.target_id], self.site.seconds(sample.time))
    }

    /// Predicts a camera's rows of a group by one of these maps.
    fn predict(
        &self,
        camera: usize,
        group: u32,
        (maps, index): (&SiteMaps, usize),
        groups: &[u32],
        residuals: &mut HeldOutResiduals,
    ) {
        for (at, row) in self.rows[camera].rows.iter().enumerate().filter(|(at, _)| groups[*at] == group) {
            let located = maps.locate(index, &row.bounding_box);
            let fix = self.plane.to_plane(row.position);
            let EastNorth { east_m, north_m } = located.position;
            residuals.residuals[at] = [east_m - fix.east_m, north_m - fix.north_m];
            residuals.predicted_m2[at] = located.covariance_m2().per_axis_m2();
        }
    }

    /// A camera's model from the joint fit.
    fn model(
        &self,
        camera: usize,
        maps: &SiteMaps,
        validation: &Validation,
        run: &mut FitRun<'_>,
    ) -> Result<SiteCameraModel, FitError> {
        let own = &validation.cameras[camera];
        let SiteCamera { id, samples, gnss_error, .. } = self.cameras[camera];
        let rows = &self.rows[camera];
        let noise = maps.receiver_noise();
        let (e_gnss_m2, e_gnss_source) = receiver_variance(rows, gnss_error, &noise);
        let mut parts = self.parts(camera, maps, e_gnss_m2, run)?;
        let factor = held_out_widening(&parts, rows, &own.groups, &own.together.residuals, &noise)?;
        widen_map(&mut parts, factor).map_err(FitError::fault)?;
        parts.set("held_out_widening", factor);
        let regressor = Regressor::build(parts.clone()).map_err(FitError::fault)?;
        estimate_track_noise(samples, &regressor, &parts).put(&mut parts);
        put_scene(samples, &regressor, &mut parts);
        let error_of = |residuals: &HeldOutResiduals| held_out_error(residuals, self.groups.count, e_gnss_m2);
        let apart = own.apart.as_ref().map(error_of);
        let mut together = error_of(&own.together);
        together.coverage95_of_fixes = coverage_of_fixes(&parts, rows, &own.together.residuals)?;
        let artifact = self.artifact(camera, parts, e_gnss_source, &together, apart.as_ref())?;
        artifact.load().map_err(|error| unusable(format!("of camera {id} give no usable model: {error}")))?;
        let held_out = |(row, [east, north]): (&TrainingRow, &[f64; 2])| {
            let Sample { time, target_id, .. } = &samples[row.sample as usize];
            HeldOutSampleError { time: *time, target_id: target_id.clone(), distance_m: east.hypot(*north) }
        };
        let held_out = rows.rows.iter().zip(&own.together.residuals).map(held_out).collect();
        Ok(SiteCameraModel { artifact, held_out, apart })
    }

    /// The parts of a camera's model, whose error is not calibrated.
    fn parts(
        &self,
        camera: usize,
        maps: &SiteMaps,
        e_gnss_m2: f64,
        run: &mut FitRun<'_>,
    ) -> Result<ModelParts, FitError> {
        let rows = &self.rows[camera];
        let GaussMarkovNoise { variance_m2, correlation } = maps.receiver_noise();
        let stated_m2 = self.cameras[camera].gnss_bias_sigma_m.map(|sigma_m| sigma_m * sigma_m);
        let coloured_m2 = (1.0 - correlation.white_share) * variance_m2;
        let shared_bias_m2 = if self.known_points.is_empty() {
            stated_m2.unwrap_or(SHARED_BIAS_SHARE.powi(2) * coloured_m2)
        } else {
            // The known points show it, and the error of the maps has what they leave of it.
            0.0
        };
        // The variance of the fixes is estimated from two axes of each receiver.
        let freedom = 2.0 * self.site.receivers.len() as f64;
        let foot_map = maps.foot_map(camera, shared_bias_m2, freedom).in_plane(&self.plane, &rows.plane);
        let name = format!("camera {}", self.cameras[camera].id);
        let rng = ChaCha8Rng::seed_from_u64(self.seed);
        let mut phase = Phase { run, name, rng, is_final: false, loss_weights: None };
        let mut parts = foot_map.into_parts(rows, e_gnss_m2, EPOCHS, &mut phase)?;
        maps.put(camera, &mut parts);
        parts.joint_training = Some(self.joint_training.clone());
        set_uncalibrated(&mut parts, &Coverage::new(rows.rows.iter().map(|row| row.bounding_box)));
        set_image_size(&mut parts, self.cameras[camera].image_size);
        calibrate_reconstruction(&mut parts, &rows.rows)?;
        let known_points = self.cameras[camera].known_points.len();
        if known_points > 0 {
            parts.set(KNOWN_POINTS, known_points as f64);
        }
        parts.set("fix_scatter_m2", variance_m2);
        parts.set("fix_white_share", correlation.white_share);
        parts.set("fix_time_constant_s", correlation.time_constant_s);
        Ok(parts)
    }

    fn artifact(
        &self,
        camera: usize,
        parts: ModelParts,
        e_gnss_source: GnssErrorSource,
        together: &HeldOutError,
        apart: Option<&HeldOutError>,
    ) -> Result<Artifact, FitError> {
        let rows = &self.rows[camera];
        let weights = parts.tensors.to_bytes().map_err(FitError::fault)?;
        let origin = parts.plane.origin();
        let features: Vec<FeatureScale> = parts.features;
        let candidate = |(name, held_out): (&str, &HeldOutError)| CandidateReport {
            candidate: name.to_owned(),
            held_out: held_out.clone(),
        };
        let candidates = [(TOGETHER, together)].into_iter().chain(apart.map(|apart| (APART, apart)));
        Ok(Artifact {
            metadata: ModelMetadata {
                format: FORMAT,
                requested_recipe: Recipe::GaussianProcess.as_str().to_owned(),
                recipe: Recipe::GaussianProcess.as_str().to_owned(),
                features,
                origin: OriginDeg {
                    longitude_deg: origin.longitude_deg(),
                    latitude_deg: origin.latitude_deg(),
                },
                seed: self.seed,
                epochs: EPOCHS,
                training_rows_sha256: sha256_of(
                    self.cameras[camera].samples,
                    &[],
                    self.cameras[camera].known_points,
                ),
                samples: rows.rows.len() as u32,
                targets: rows.targets,
                passes: rows.traverses,
                error_scale: parts.error_scale,
                e_gnss_m2: parts.e_gnss_m2,
                e_gnss_source,
                held_out: Some(together.clone()),
                candidates: candidates.clone().map(candidate).collect(),
                report: Some(report(candidates, self.cameras.len())),
                joint_training: parts.joint_training,
                parameters: parts.parameters,
            },
            weights,
        })
    }
}

fn report<'a>(
    candidates: impl Iterator<Item = (&'a str, &'a HeldOutError)>,
    cameras: usize,
) -> TrainingReport {
    let finding = |(name, held_out): (&str, &HeldOutError)| {
        let is_kept = name == TOGETHER;
        CandidateFinding {
            candidate: name.to_owned(),
            weight: if is_kept { 1.0 } else { 0.0 },
            held_out_miss_m: held_out.mean_to_fix_m,
            coverage95_of_fixes: held_out.coverage95_of_fixes,
            summary: if is_kept {
                format!("kept: the map of this camera from the joint fit of {cameras} cameras")
            } else {
                "for comparison: the same form of map trained on this camera alone".to_owned()
            },
        }
    };
    let advice = "the report of the site's training run says what the cameras gain from each other";
    TrainingReport { candidates: candidates.map(finding).collect(), advice: vec![advice.to_owned()] }
}
