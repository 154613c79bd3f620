//! Boxes of a camera matched with receivers: by a model that is known, and with nothing known.

use std::collections::BTreeMap;
use std::ops::ControlFlow;

use jiff::SignedDuration;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::draw::position_at;
use super::pair_figures::PairFigures;
use super::recording::{LabelledBox, RecordedFix, SiteRecording};
use crate::domain::{
    Detection, Error, Fix, GnssError, ReceivedFix, Receivers, Recipe, Result, Sample, TargetId,
};
use crate::fusion::association::{
    Cancellation, CarrierBox, MatchSettings, WorldScores, joint_pairing, match_with_model,
    match_without_model,
};
use crate::fusion::pairing::{PairingRule, PairingSettings, pair};
use crate::model::{FitError, FitInput, FitOptions, Regressor, fit};

/// Every that many boxes are compared with the truth.
const STRIDE: usize = 4;

/// The findings of matching without a model in one camera.
#[derive(Debug, Clone)]
pub struct JointFound {
    /// The pairs.
    pub figures: PairFigures,
    /// Mean error, over all boxes, of the model that is trained on the samples which such a match gives, m.
    pub mean_error_m: f64,
    /// Scores of the place and direction.
    pub scores: WorldScores,
}

impl SiteRecording {
    /// The boxes of a camera under its tracker's ids.
    #[must_use]
    pub fn detections(&self, camera: usize) -> Vec<Detection> {
        let detection = |own: &LabelledBox| Detection {
            time: own.time,
            target_id: own.tracker_id.clone(),
            bounding_box: own.bounding_box,
            class: None,
            score: None,
        };
        self.cameras[camera].boxes.iter().map(detection).collect()
    }

    /// The fixes under their receivers' ids.
    #[must_use]
    pub fn received_fixes(&self) -> Vec<ReceivedFix> {
        let received = |own: &RecordedFix| ReceivedFix {
            time: own.time,
            receiver_id: Some(self.receivers[own.receiver].0.clone()),
            fix: Fix { position: self.plane.to_position(own.position), sigma_m: None },
        };
        self.fixes.iter().map(received).collect()
    }

    /// The same with the fixes shifted in time around the recording's end, so that no identity is true.
    #[must_use]
    pub fn with_shifted_fixes(&self, share: f64) -> Self {
        let mut shifted = self.clone();
        let times = || self.truth.keys().map(|(time, _)| *time);
        let (Some(first), Some(last)) = (times().min(), times().max()) else { return shifted };
        let length_s = last.duration_since(first).as_secs_f64();
        for fix in &mut shifted.fixes {
            let since_s = (fix.time.duration_since(first).as_secs_f64() + share * length_s) % length_s;
            fix.time = first + SignedDuration::from_secs_f64(since_s);
        }
        shifted.fixes.sort_by_key(|fix| (fix.time, fix.receiver));
        shifted
    }

    /// The boxes of a camera's carriers under their receivers' ids, and the boxes of all others.
    fn known_boxes(&self, camera: usize) -> (Vec<Detection>, Vec<Detection>) {
        let carried: BTreeMap<usize, TargetId> =
            self.receivers.iter().map(|(id, target)| (*target, TargetId::from(id.clone()))).collect();
        let (mut own, mut others) = (Vec::new(), Vec::new());
        for (detection, labelled) in self.detections(camera).into_iter().zip(&self.cameras[camera].boxes) {
            match labelled.target.and_then(|target| carried.get(&target)) {
                Some(target_id) => own.push(Detection { target_id: target_id.clone(), ..detection }),
                None => others.push(detection),
            }
        }
        (own, others)
    }

    /// The model of a camera that is trained with the identities.
    ///
    /// # Errors
    /// Those of [`fit`].
    pub fn known_model(&self, camera: usize, recipe: Recipe) -> std::result::Result<Regressor, FitError> {
        let (own, others) = self.known_boxes(camera);
        let pairing = PairingSettings { rule: PairingRule::Interpolated, ..PairingSettings::default() };
        let samples = pair(own, self.received_fixes(), &Receivers::default(), &pairing).samples;
        self.trained(&samples, &others, recipe)
    }

    fn trained(
        &self,
        samples: &[Sample],
        others: &[Detection],
        recipe: Recipe,
    ) -> std::result::Result<Regressor, FitError> {
        let options = FitOptions {
            recipe,
            seed: 1,
            epochs: None,
            image_size: self.image_size,
            gnss_error: GnssError::Unknown,
            gnss_bias_sigma_m: None,
        };
        let input = FitInput { samples, unpaired: others, known_points: &[] };
        fit(input, &options, &mut |_| ControlFlow::Continue(()))?.load().map_err(FitError::Unusable)
    }

    /// Mean error of a model's positions over the boxes of a camera, m.
    #[must_use]
    pub fn mean_error_m(&self, camera: usize, model: &Regressor) -> f64 {
        let paths = self.true_paths();
        let boxes = self.cameras[camera].boxes.iter().step_by(STRIDE);
        let errors: Vec<f64> = boxes
            .filter_map(|own| {
                let truth = position_at(paths.get(&own.target?)?, own.time)?;
                let regressed = model.plane().to_position(model.regress(&own.bounding_box, None).regressed);
                Some(self.plane.to_plane(regressed).distance_m(truth))
            })
            .collect();
        errors.iter().sum::<f64>() / errors.len().max(1) as f64
    }

    /// Matches a camera's boxes with the receivers by a model.
    ///
    /// # Errors
    /// Those of [`match_with_model`].
    pub fn matched_by(&self, camera: usize, model: &Regressor, seed: u64) -> Result<PairFigures> {
        let matching = match_with_model(
            &self.detections(camera),
            &self.received_fixes(),
            &Receivers::default(),
            model,
            &MatchSettings::default(),
            &mut ChaCha8Rng::seed_from_u64(seed),
            Cancellation::NEVER,
        )?;
        Ok(PairFigures::of(self, camera, &matching))
    }

    /// Matches a camera's boxes with the receivers where nothing is known.
    ///
    /// # Errors
    /// `NotIdentifiable` with the reason, and the others of [`match_without_model`] and [`fit`].
    pub fn matched_jointly(&self, camera: usize, seed: u64) -> std::result::Result<JointFound, FitError> {
        let image_size = self
            .image_size
            .ok_or_else(|| FitError::Unusable(Error::invalid("image_size", "is needed to find a camera")))?;
        let (mut detections, fixes) = (self.detections(camera), self.received_fixes());
        let found = match_without_model(
            &detections,
            &fixes,
            &Receivers::default(),
            image_size,
            &MatchSettings::default(),
            &mut ChaCha8Rng::seed_from_u64(seed),
            Cancellation::NEVER,
        )
        .map_err(FitError::Unusable)?;
        for CarrierBox { detection, at, .. } in found.matching.carrier_boxes(&detections) {
            match at {
                Some(at) => detections[at] = detection,
                None => detections.push(detection),
            }
        }
        let receivers = found.matching.receivers_of(&fixes, &Receivers::default());
        let paired = pair(detections, fixes, &receivers, &joint_pairing());
        let model = self.trained(&paired.samples, &paired.unpaired_detections, Recipe::GaussianProcess)?;
        Ok(JointFound {
            figures: PairFigures::of(self, camera, &found.matching),
            mean_error_m: self.mean_error_m(camera, &model),
            scores: found.scores,
        })
    }
}
