//! The recipe `gaussian_process`: from training samples to the parts of a model.

use std::sync::Arc;

use super::box_plausibility::RecentBoxes;
use super::companion;
use super::fit::{FitReport, FitSettings, fit as fit_map};
use super::hidden_foot::HiddenFoot;
use super::known_rows::{KNOWN_POINTS, KnownFoot};
use super::map_rows::MapRows;
use super::noise::Epoch;
use super::onnx;
use super::predictor::{MapPrediction, Predictor};
use super::upright_camera::UprightCamera;
use crate::artifact::{LEAST_GNSS_WHITE_SHARE, ModelParts};
use crate::domain::{
    BoundingBox, Error, ErrorKind, KnownPoint, NoiseCorrelation, Recipe, Result, SessionBias, TargetClass,
};
use crate::encoder::auto_encoder::AutoEncoder;
use crate::encoder::features::{Encoded, features_of, reconstruction_error};
use crate::encoder::{Encoder, ErrorContext, Estimate, FittedEncoder};
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance};
use crate::onnx::answer::{Answer, GraphContext};
use crate::progress::{FitError, Phase};
use crate::recipes::{Candidate, Definition, ErrorSource, Estimator, FitContext};
use crate::samples::rows::TrainingRows;

/// Median height of a target in m, and the standard deviation of its logarithm, by class in either case; the last is for
/// all other classes, whose heights only have to agree with each other. ONVIF and Axis say `Human`, DeepStream `Person`.
const TARGET_HEIGHTS: [(&[&str], (f64, f64)); 3] =
    [(&["person", "pedestrian", "human"], (1.70, 0.05)), (&["car"], (1.50, 0.10)), (&[], (1.70, 1.0))];

/// A known point that is so many standard deviations per axis away from the map is probably wrong.
const CONTRADICTED_SIGMAS: f64 = 4.0;

/// The recipe.
pub(crate) static DEFINITION: Definition = Definition {
    candidates: &[Candidate { name: "gaussian_process", estimator: &GaussianProcess, is_smoothed: false }],
    load: |parts| Ok(Arc::new(GaussianProcessEncoder::build(parts)?)),
    error_source: ErrorSource::LeftOutTargets,
};

/// The fit of the recipe; the final one also trains the auto-encoder.
#[derive(Debug)]
struct GaussianProcess;

impl Estimator for GaussianProcess {
    fn epochs(&self) -> u32 {
        companion::EPOCHS
    }

    fn networks(&self, is_final: bool) -> u32 {
        u32::from(is_final)
    }

    fn map_epochs(&self) -> u32 {
        150
    }

    fn fit(
        &self,
        rows: &TrainingRows,
        context: &FitContext<'_>,
        epochs: u32,
        phase: &mut Phase<'_, '_>,
    ) -> Result<FittedEncoder, FitError> {
        let map_rows = map_rows(rows);
        let unpaired = context.unpaired.iter().map(|own| (own.target, features_of(&own.bounding_box)));
        let paired = rows.rows.iter().zip(&map_rows.boxes).map(|(row, sides)| (row.target, *sides));
        let mut boxes: Vec<(u32, [f64; 4])> = paired.chain(unpaired).collect();
        boxes.sort_by_key(|(target, _)| *target);
        let upright = context.image_size.and_then(|size| {
            let size_px = (f64::from(size.width_px()), f64::from(size.height_px()));
            UprightCamera::new(&boxes, size_px, context.target_height_m)
        });
        let bias_sigma_m = context.gnss_bias_sigma_m;
        let map_settings = FitSettings {
            bias_sigma_m,
            white_share: context.noise.correlation.white_share,
            receiver_m2: (!context.e_gnss_is_estimated).then_some(context.e_gnss_m2),
            seed: context.seed,
            upright,
            known: context.known_points.iter().map(|point| known_foot(point, &rows.plane)).collect(),
        };
        let mut fitted = fit_map(&map_rows, &map_settings);
        if fitted.is_none() && !map_settings.known.is_empty() {
            fitted = fit_map(&map_rows, &FitSettings { known: Vec::new(), ..map_settings });
            if phase.is_final {
                phase.run.note(
                    "the known points contradict each other or the fixes, and are left out; check them",
                )?;
            }
        }
        let Some((predictor, report)) = fitted else {
            return Err(FitError::Unusable(Error::field(
                ErrorKind::UnusableSamples,
                "samples",
                "they determine no map from boxes to positions; let the target walk through the whole picture",
            )));
        };
        if phase.is_final {
            note(&report, phase)?;
        }
        let receiver_m2 = report.receiver.variance_m2();
        let e_gnss_m2 = if context.e_gnss_is_estimated { receiver_m2 } else { context.e_gnss_m2 };
        let mut parts = ModelParts::new(Recipe::GaussianProcess, rows.plane, predictor.features(), e_gnss_m2);
        predictor.put(&mut parts);
        put_report(&report, &mut parts);
        parts.set("boxes_without_fix", context.unpaired.len() as f64);
        parts.set("unrest_share", white_share(&predictor, &map_rows));
        if phase.is_final {
            companion::fit(rows, epochs, &mut parts, phase)?;
        }
        Ok(FittedEncoder { parts, covariance: None })
    }
}

fn known_foot(point: &KnownPoint, plane: &LocalPlane) -> KnownFoot {
    let EastNorth { east_m, north_m } = plane.to_plane(point.position);
    KnownFoot {
        image_px: point.image_px,
        position_m: [east_m, north_m],
        variance_m2: point.sigma_m.variance_m2(),
    }
}

/// Height of the targets that most samples show.
pub(crate) fn target_height_m<'a>(classes: impl Iterator<Item = Option<&'a TargetClass>>) -> (f64, f64) {
    let [person, car, other] = TARGET_HEIGHTS;
    let (mut counts, mut all) = ([0_usize; 2], 0);
    for class in classes {
        all += 1;
        let Some(class) = class else { continue };
        for (count, (names, _)) in counts.iter_mut().zip([person, car]) {
            *count += usize::from(names.iter().any(|name| name.eq_ignore_ascii_case(class.as_str())));
        }
    }
    match counts {
        [persons, _] if 2 * persons > all => person.1,
        [_, cars] if 2 * cars > all => car.1,
        _ => other.1,
    }
}

/// How the receiver's error is correlated beside its bias of the session, and the latter; `None` in the parts of
/// another recipe.
pub(crate) fn receiver_correlation(parts: &ModelParts) -> Option<(NoiseCorrelation, SessionBias)> {
    let of = |name: &str| parts.parameters.get(name).copied();
    let (white_m2, short_m2) = (of("receiver_white_m2")?, of("receiver_short_m2")?);
    let (session_m2, short_time_s) = (of("receiver_session_m2")?, of("receiver_short_time_s")?);
    let within_m2 = white_m2 + short_m2;
    let white_share = (white_m2 / within_m2).clamp(LEAST_GNSS_WHITE_SHARE, 1.0);
    let correlation = NoiseCorrelation { white_share, time_constant_s: short_time_s };
    let session = SessionBias {
        share: session_m2 / (within_m2 + session_m2),
        time_constant_s: of("receiver_session_time_s")?,
    };
    Some((correlation, session))
}

/// Training rows as a map is fitted to them.
pub(super) fn map_rows(rows: &TrainingRows) -> MapRows {
    MapRows {
        epochs: rows.rows.iter().map(|row| Epoch { time_s: row.time_s, sequence: row.target }).collect(),
        boxes: rows.rows.iter().map(|row| features_of(&row.bounding_box)).collect(),
        labels_m: rows.rows.iter().map(|row| [row.label.east_m, row.label.north_m]).collect(),
    }
}

/// White share of the error variance: what the detector's noise makes of it, over the training boxes.
pub(super) fn white_share(predictor: &Predictor, rows: &MapRows) -> f64 {
    let (mut white_m2, mut all_m2) = (0.0, 0.0);
    for sides in rows.boxes.iter().step_by(rows.boxes.len().div_ceil(500)) {
        let prediction = predictor.predict(sides, None);
        white_m2 += 0.5 * (prediction.box_noise_m2[0] + prediction.box_noise_m2[2]);
        all_m2 += prediction.variance_m2();
    }
    (white_m2 / all_m2).clamp(0.0, 1.0)
}

/// Scalars of the metadata document: the noise of the receivers, the candidates, the calibration.
fn put_report(report: &FitReport, parts: &mut ModelParts) {
    let noise = &report.receiver;
    for (name, value) in [
        ("receiver_white_m2", noise.white_m2),
        ("receiver_short_m2", noise.short_m2),
        ("receiver_short_time_s", noise.short_time_s),
        ("receiver_session_m2", noise.session_m2),
        ("receiver_session_time_s", noise.session_time_s),
        ("residual_m", report.parameters.residual_m),
        ("residual_length_place", report.parameters.lengths.place),
        ("residual_length_size", report.parameters.lengths.size),
        ("gross_errors", report.gross_errors as f64),
        ("held_out_groups", report.groups as f64),
        ("held_out_coverage", report.held_out_coverage),
        ("own_m2", report.own_m2),
        ("held_out_m2", report.held_out_m2),
        ("radius_degrees_of_freedom", report.freedom),
    ] {
        parts.set(name, value);
    }
    for ((name, weight, miss_m2), jackknife_share) in report.candidates.iter().zip(&report.jackknife_shares) {
        parts.set(&format!("weight.{name}"), *weight);
        parts.set(&format!("held_out_m2.{name}"), *miss_m2);
        parts.set(&format!("jackknife_share.{name}"), *jackknife_share);
    }
    if !report.known_m.is_empty() {
        parts.set(KNOWN_POINTS, report.known_m.len() as f64);
    }
    if let Some(sessions) = report.sessions {
        parts.set("sessions", sessions.count as f64);
        parts.set("between_sessions_m2", sessions.between_m2);
    }
}

/// Log lines of the final fit.
fn note(report: &FitReport, phase: &mut Phase<'_, '_>) -> Result<(), FitError> {
    let noise = &report.receiver;
    phase.run.note(&format!(
        "receivers: {:.2} m white, {:.2} m over {:.0} s, {:.2} m over {:.0} min; {} rows left out as gross errors",
        noise.white_m2.sqrt(),
        noise.short_m2.sqrt(),
        noise.short_time_s,
        noise.session_m2.sqrt(),
        noise.session_time_s / 60.0,
        report.gross_errors
    ))?;
    for (name, weight, miss_m2) in &report.candidates {
        phase.run.note(&format!(
            "map {name}: weight {weight:.2}; root mean square to the fixes of left-out groups {:.3} m per axis",
            miss_m2.sqrt()
        ))?;
    }
    for (number, (apart_m, sigma_m)) in (1..).zip(&report.known_m) {
        let advice = if *apart_m > CONTRADICTED_SIGMAS * sigma_m {
            ": the map contradicts it; check where it is in the image and on the earth"
        } else {
            ""
        };
        phase.run.note(&format!("known point {number}: {apart_m:.2} m from the map{advice}"))?;
    }
    phase.run.note(&format!(
        "{} groups left out in turn: {:.1} % of their fixes inside the stated radius; map variance widened by {:.2}",
        report.groups,
        100.0 * report.held_out_coverage,
        report.widening
    ))
}

/// The encoder of a loaded model.
#[derive(Debug)]
struct GaussianProcessEncoder {
    predictor: Predictor,
    /// Fits of parts of the rows have none.
    auto_encoder: Option<AutoEncoder>,
}

impl GaussianProcessEncoder {
    /// # Errors
    /// Names the tensor or scalar that is missing or cannot be used.
    fn build(parts: &mut ModelParts) -> Result<Self> {
        Ok(Self { predictor: Predictor::take(parts)?, auto_encoder: companion::take(parts)? })
    }

    /// Position and reconstruction of a box, and its prediction.
    #[inline]
    fn predict(
        &self,
        bounding_box: &BoundingBox,
        recent: Option<&mut RecentBoxes>,
    ) -> (Encoded, MapPrediction) {
        let sides = features_of(bounding_box);
        let prediction = self.predictor.predict(&sides, recent);
        let [east_m, north_m] = prediction.position_m;
        let reconstruction_px = match &self.auto_encoder {
            Some(auto_encoder) => auto_encoder.encode(bounding_box).reconstruction_px,
            None => self.predictor.reconstruct(&sides, &prediction.deviation),
        };
        (Encoded { position: EastNorth { east_m, north_m }, reconstruction_px }, prediction)
    }
}

impl Encoder for GaussianProcessEncoder {
    fn encode(&self, _plane: &LocalPlane, bounding_box: &BoundingBox) -> Encoded {
        self.predict(bounding_box, None).0
    }

    /// Its error comes with every answer, not from the error model.
    fn estimate(
        &self,
        model: &ErrorContext<'_>,
        bounding_box: &BoundingBox,
        _fix: Option<EastNorth>,
        recent: Option<&mut RecentBoxes>,
    ) -> Estimate {
        let (encoded, prediction) = self.predict(bounding_box, recent);
        Estimate {
            position: encoded.position,
            reconstruction_error: reconstruction_error(bounding_box, &encoded),
            covariance: plane_covariance(prediction.covariance_m2),
            box_noise: plane_covariance(prediction.box_noise_m2),
            extrapolation_ratio: model.error_model.extrapolation_ratio(bounding_box),
            r95_scale: prediction.r95_scale,
        }
    }

    fn express<'g>(&self, context: &GraphContext<'_, 'g>) -> Answer<'g> {
        onnx::express(&self.predictor, self.auto_encoder.as_ref(), context)
    }

    fn widened(&self, common_m2: PlaneCovariance) -> PlaneCovariance {
        let bias = PlaneCovariance::isotropic(self.predictor.shared_bias_m2);
        common_m2.scaled(self.predictor.widening).plus(bias)
    }

    fn displacement_covariance(&self, boxes: [&BoundingBox; 2]) -> Option<PlaneCovariance> {
        let [from, to] = boxes.map(features_of);
        Some(plane_covariance(self.predictor.displacement_m2([&from, &to])))
    }

    fn hidden_foot(
        &self,
        bounding_box: &BoundingBox,
        recent: Option<&mut RecentBoxes>,
    ) -> Option<HiddenFoot> {
        HiddenFoot::of(bounding_box, &self.predictor.plausibility, recent)
    }
}

/// From east, cross, north, m2.
const fn plane_covariance([east_m2, east_north_m2, north_m2]: [f64; 3]) -> PlaneCovariance {
    PlaneCovariance { east_m2, north_m2, east_north_m2 }
}
