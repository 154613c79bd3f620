//! The predictor of every method: from the rows of one target to positions.

use super::baselines::{dnn, homography, imm_ukf};
use super::model_fits::RecipeModel;
use super::options::{EvaluateOptions, TestRow};
use crate::domain::{BoundingBox, InferenceMode, Method, Observation, SigmaM};
use crate::filters::ImmUkf;
use crate::fusion::observed::UNKNOWN_RECEIVER_M2;
use crate::fusion::target_track::TargetTrack;
use crate::fusion::track::TrackSettings;
use crate::fusion::two_step::fuse;
use crate::geo::{EastNorth, LocalPlane, PlaneCovariance, Position};
use crate::model::{FEWEST_SAMPLES, FitInput, R95_PER_SIGMA, Regressor, fix_sequences};

/// A predicted position with its stated 95 % radius.
#[derive(Debug, Clone, Copy)]
pub(super) struct Prediction {
    pub(super) position: Position,
    /// Radius that contains the true position with 95 % probability, m; `None` where the method states
    /// none.
    pub(super) r95_m: Option<f64>,
    /// Covariance of its error, where the method states one.
    pub(super) covariance: Option<PlaneCovariance>,
}

impl Prediction {
    const fn new(position: Position, r95_m: Option<f64>) -> Self {
        Self { position, r95_m, covariance: None }
    }
}

/// Indexes of the test rows of one target, in order of time.
pub(super) type TargetRows = Vec<usize>;

/// Predicts a position for each of one target's rows, in their order; `None` where the method cannot.
pub(super) type Predictor<'a> = Box<dyn FnMut(&TargetRows) -> Vec<Option<Prediction>> + 'a>;

/// The state that the predictors of one evaluation share.
#[derive(Clone, Copy)]
pub(super) struct Predictors<'a> {
    pub(super) train: FitInput<'a>,
    pub(super) test: &'a [TestRow],
    pub(super) options: &'a EvaluateOptions,
    /// The plane in which the baselines work.
    pub(super) plane: LocalPlane,
}

impl<'a> Predictors<'a> {
    /// A predictor that looks at each row on its own.
    fn per_row<'b>(&self, predict: impl Fn(&Observation) -> Option<Prediction> + 'b) -> Predictor<'b>
    where
        'a: 'b,
    {
        let test = self.test;
        Box::new(move |target| target.iter().map(|&row| predict(&test[row].observation)).collect())
    }

    /// Error variance per axis of fixes that do not state their own, m2.
    fn gnss_variance_m2(&self, of_model_m2: Option<f64>) -> f64 {
        let known_m2 = self.options.gnss_sigma.map(SigmaM::variance_m2);
        known_m2.or(of_model_m2).unwrap_or(UNKNOWN_RECEIVER_M2)
    }

    /// The predictor of a method that uses no recipe's model.
    ///
    /// # Errors
    /// The reason why the method cannot be fitted to the training samples.
    pub(super) fn baseline<'b>(&self, method: Method, seed: u64) -> Result<Predictor<'b>, String>
    where
        'a: 'b,
    {
        match method {
            Method::Gnss => Ok(self.gnss()),
            Method::ImmUkf => Ok(self.imm_ukf()),
            Method::Dnn | Method::DnnDenied => self.dnn(method == Method::Dnn, seed),
            Method::HomographyDenied => self.homography(seed),
            Method::Recipe(..) | Method::Track | Method::TrackDenied => Err("needs a model".to_owned()),
        }
    }

    /// The fix itself; it states a radius where its error is known.
    fn gnss<'b>(&self) -> Predictor<'b>
    where
        'a: 'b,
    {
        let known_sigma_m = self.options.gnss_sigma.map(SigmaM::metres);
        self.per_row(move |observation| {
            let fix = observation.fix()?;
            let sigma_m = fix.sigma_m.map(SigmaM::metres).or(known_sigma_m);
            Some(Prediction::new(fix.position, sigma_m.map(|sigma_m| R95_PER_SIGMA * sigma_m)))
        })
    }

    /// The supervised network; in its 6D form it predicts only for rows that have a fix.
    fn dnn<'b>(&self, with_fix: bool, seed: u64) -> Result<Predictor<'b>, String>
    where
        'a: 'b,
    {
        // The recipes check the number of samples themselves; the network does not.
        if (self.train.samples.len() as u64) < FEWEST_SAMPLES {
            let count = self.train.samples.len();
            return Err(format!("needs at least {FEWEST_SAMPLES} training samples, has {count}"));
        }
        let plane = self.plane;
        let network = dnn::fit(self.train.samples, &plane, with_fix, seed);
        Ok(self.per_row(move |observation| {
            let bounding_box = &observation.bounding_box()?;
            let fix = observation.fix().filter(|_| with_fix).map(|fix| plane.to_plane(fix.position));
            let point = (fix.is_some() == with_fix).then(|| network.regress(bounding_box, fix))?;
            Some(Prediction::new(plane.to_position(point), None))
        }))
    }

    fn homography<'b>(&self, seed: u64) -> Result<Predictor<'b>, String>
    where
        'a: 'b,
    {
        let plane = self.plane;
        let pairs: Vec<(BoundingBox, EastNorth)> = self
            .train
            .samples
            .iter()
            .map(|sample| (sample.bounding_box, plane.to_plane(sample.fix.position)))
            .collect();
        let homography = homography::fit(&pairs, seed)
            .ok_or("fewer than 8 training samples, or all of them at one position")?;
        Ok(self.per_row(move |observation| {
            let point = homography.project(&observation.bounding_box()?)?;
            Some(Prediction::new(plane.to_position(point), None))
        }))
    }

    fn imm_ukf<'b>(&self) -> Predictor<'b>
    where
        'a: 'b,
    {
        let variance_m2 = self.gnss_variance_m2(None);
        let tuned = imm_ukf::tune(&fix_sequences(self.train.samples, &self.plane), variance_m2);
        let (plane, test) = (self.plane, self.test);
        Box::new(move |target| {
            let mut filter = ImmUkf::new(tuned);
            let mut last = target.first().map(|&row| test[row].observation.time());
            let predict = |&row: &usize| {
                let (time, fix) = (test[row].observation.time(), test[row].observation.fix());
                let seconds = last.replace(time).map_or(0.0, |last| time.duration_since(last).as_secs_f64());
                let fix = fix.map(|fix| {
                    let stated_m2 = fix.sigma_m.map_or(variance_m2, SigmaM::variance_m2);
                    (plane.to_plane(fix.position), stated_m2)
                });
                let estimate = filter.step(seconds, fix)?;
                let r95_m = R95_PER_SIGMA * estimate.variance_m2.sqrt();
                Some(Prediction::new(plane.to_position(estimate.position), Some(r95_m)))
            };
            target.iter().map(predict).collect()
        })
    }

    /// The predictor of a method that uses a recipe's model.
    ///
    /// # Errors
    /// A method that uses none.
    pub(super) fn of_model<'b>(&self, method: Method, model: &'b RecipeModel) -> Result<Predictor<'b>, String>
    where
        'a: 'b,
    {
        let regressor = &model.regressor;
        let e_gnss_m2 = self.gnss_variance_m2(Some(regressor.e_gnss_m2()));
        match method {
            Method::Recipe(_, InferenceMode::TwoStep) => {
                let image_size = self.options.image_size;
                Ok(self.per_row(move |observation| {
                    let fused = fuse(observation, Some((regressor, 0)), image_size, Some(e_gnss_m2))?;
                    Some(Prediction::new(fused.fused, Some(fused.r95_m)))
                }))
            }
            Method::Recipe(_, mode) => Ok(self.regressed(mode == InferenceMode::OneStep, regressor)),
            Method::Track => Ok(self.track(regressor, e_gnss_m2, true)),
            Method::TrackDenied => Ok(self.track(regressor, e_gnss_m2, false)),
            _ => Err("needs no model".to_owned()),
        }
    }

    /// The regressed position alone.
    fn regressed<'b>(&self, with_fix: bool, regressor: &'b Regressor) -> Predictor<'b>
    where
        'a: 'b,
    {
        let plane = *regressor.plane();
        self.per_row(move |observation| {
            let fix = observation.fix().filter(|_| with_fix).map(|fix| plane.to_plane(fix.position));
            let regression = regressor.regress(&observation.bounding_box()?, fix);
            let r95_m = regression.r95_scale * regression.e_regression_m2.sqrt();
            Some(Prediction::new(plane.to_position(regression.regressed), Some(r95_m)))
        })
    }

    /// The sequence fusion of each target, with the fixes or without.
    fn track<'b>(&self, regressor: &'b Regressor, e_gnss_m2: f64, with_fix: bool) -> Predictor<'b>
    where
        'a: 'b,
    {
        let settings = TrackSettings::from_model(regressor);
        let (test, image_size) = (self.test, self.options.image_size);
        Box::new(move |target| {
            let mut track = TargetTrack::default();
            let predict = |&row: &usize| {
                let given = &test[row].observation;
                let used = if with_fix { Some(given.clone()) } else { given.without_fix() };
                let observed = used.as_ref().map(|observation| {
                    track.observe(observation, Some(regressor), image_size, Some(e_gnss_m2))
                });
                let estimate = match observed.filter(|observed| !observed.is_empty()) {
                    Some(observed) => track.update(&observed, || settings),
                    None => track.at(given.time()),
                }?;
                Some(Prediction {
                    position: estimate.position,
                    r95_m: Some(estimate.state.r95_m),
                    covariance: Some(estimate.state.covariance),
                })
            };
            target.iter().map(predict).collect()
        })
    }
}
