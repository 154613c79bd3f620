//! Evaluations over stored samples: start, list, cancel. `worker` runs them.

use jiff::{SignedDuration, Timestamp};

use super::training::check_extent;
use super::{App, JobQueue, Page, page_of};
use crate::clock::{Clock, Randomness};
use crate::config::Limits;
use crate::domain::{
    Camera, CameraId, Error, EvaluationId, EvaluationJob, EvaluationPlan, GnssError, InferenceMode, Method,
    Result, SigmaM, TimeRange, Truth,
};
use crate::store::{SampleFilter, Store};

/// Share of the samples, the latest ones, that is tested on by default.
pub const DEFAULT_TEST_SHARE: f64 = 0.2;
/// Allowed test shares.
const TEST_SHARES: std::ops::RangeInclusive<f64> = 0.01..=0.9;
/// Largest shift of the test boxes, px.
const LARGEST_BOX_SHIFT_PX: f64 = 10_000.0;

/// A request for an evaluation; what is left out is chosen as each field says.
#[derive(Debug, Clone, Default)]
pub struct EvaluationRequest {
    /// The samples to learn from; given together with `test`, or not at all.
    pub train: Option<TimeRange>,
    /// The samples to be judged on.
    pub test: Option<TimeRange>,
    /// The last share of all samples by time is the test, if there are no ranges;
    /// [`DEFAULT_TEST_SHARE`] if `None`.
    pub test_share: Option<f64>,
    /// If `None`, the truth that the test samples state.
    pub truth: Option<Truth>,
    /// The receiver, the filters and the profile's recipe, if `None`.
    pub methods: Option<Vec<Method>>,
    /// 1, if `None`.
    pub seeds: Option<u32>,
    /// 0, if `None`.
    pub box_shift_px: Option<f64>,
    /// The profile's, if `None`.
    pub gnss_sigma: Option<SigmaM>,
}

/// The use cases of evaluations.
#[derive(Clone, Copy)]
pub struct Evaluations<'a> {
    store: &'a Store,
    clock: &'a Clock,
    randomness: &'a Randomness,
    limits: &'a Limits,
    queue: &'a JobQueue,
}

impl App {
    /// The use cases of evaluations.
    #[must_use]
    pub fn evaluations(&self) -> Evaluations<'_> {
        Evaluations {
            store: &self.store,
            clock: &self.clock,
            randomness: &self.randomness,
            limits: &self.limits,
            queue: &self.evaluation_queue,
        }
    }
}

impl Evaluations<'_> {
    /// Queues an evaluation.
    ///
    /// # Errors
    /// `CameraNotFound`; `InvalidArgument` naming the field; `UnusableSamples` if there are too few
    /// to learn from; `Overloaded` beyond the limit of live evaluations.
    pub async fn start(&self, id: &CameraId, request: EvaluationRequest) -> Result<EvaluationJob> {
        let camera = self.store.camera(id).await?;
        let plan = self.plan(&camera, request).await?;
        let now = self.clock.now();
        let evaluation = EvaluationId(self.randomness.uuid_v7(now));
        let most = self.limits.live_evaluations;
        let queued = self.store.insert_evaluation(evaluation, id, &plan, most, now).await?;
        self.queue.notify();
        Ok(queued)
    }

    /// One evaluation, with its report as a JSON document once it has succeeded.
    ///
    /// # Errors
    /// `EvaluationNotFound`.
    pub async fn get(&self, id: EvaluationId) -> Result<(EvaluationJob, Option<String>)> {
        let job = self.store.evaluation(id).await?;
        let report = if job.state.has_ended() { self.store.evaluation_report(id).await? } else { None };
        Ok((job, report))
    }

    /// Evaluations, of a camera or of all, newest first, after a cursor.
    ///
    /// # Errors
    /// `CameraNotFound`.
    pub async fn list(
        &self,
        camera: Option<&CameraId>,
        before: Option<EvaluationId>,
        limit: u32,
    ) -> Result<Page<EvaluationJob, EvaluationId>> {
        let jobs = self.store.evaluations(camera, before, limit + 1).await?;
        Ok(page_of(jobs, limit, |job| job.id))
    }

    /// Cancels an evaluation: at once if no worker holds it, at its next step if one does.
    ///
    /// # Errors
    /// `EvaluationNotFound`, `EvaluationEnded`.
    pub async fn cancel(&self, id: EvaluationId) -> Result<EvaluationJob> {
        self.store.cancel_evaluation(id, self.clock.now()).await
    }

    /// Deletes an evaluation; one that runs stops at its next step.
    ///
    /// # Errors
    /// `EvaluationNotFound`.
    pub async fn delete(&self, id: EvaluationId) -> Result<()> {
        self.store.delete_evaluation(id, self.clock.now()).await
    }

    /// The request with its defaults filled in, if the stored samples allow it.
    async fn plan(&self, camera: &Camera, request: EvaluationRequest) -> Result<EvaluationPlan> {
        let recipe = camera.profile.recipe;
        let methods = request.methods.unwrap_or_else(|| {
            let of_recipe = [InferenceMode::OneStep, InferenceMode::TwoStep, InferenceMode::Denied]
                .map(|step| Method::Recipe(recipe, step));
            let baselines = [Method::Gnss, Method::ImmUkf, Method::HomographyDenied];
            let tracks = [Method::Track, Method::TrackDenied];
            baselines.into_iter().chain(of_recipe).chain(tracks).collect()
        });
        check_methods(&methods)?;
        let (seeds, most) = (request.seeds.unwrap_or(1), self.limits.evaluation_seeds);
        if !(1..=most).contains(&seeds) {
            return Err(Error::invalid("seeds", format!("must be from 1 to {most}")));
        }
        let box_shift_px = request.box_shift_px.unwrap_or(0.0);
        if !(0.0..=LARGEST_BOX_SHIFT_PX).contains(&box_shift_px) {
            return Err(Error::invalid("box_shift_px", format!("must be from 0 to {LARGEST_BOX_SHIFT_PX}")));
        }
        let truth = request.truth.unwrap_or(Truth::Columns);
        self.check_truth_size(&truth)?;
        let (train, test) = self.ranges(camera.id(), request.train, request.test, request.test_share).await?;
        self.check_samples(camera.id(), train, test, &truth).await?;
        let known = match camera.profile.gnss_error {
            GnssError::Known(sigma) => Some(sigma),
            GnssError::Unknown => None,
        };
        let gnss_sigma = request.gnss_sigma.or(known);
        Ok(EvaluationPlan { train, test, truth, methods, recipe, seeds, box_shift_px, gnss_sigma })
    }

    fn check_truth_size(&self, truth: &Truth) -> Result<()> {
        let Truth::Lines(lines) = truth else { return Ok(()) };
        let (positions, most) = (lines.iter().map(Vec::len).sum::<usize>(), self.limits.truth_line_positions);
        if positions < 2 || positions > most {
            return Err(Error::invalid(
                "truth_line",
                format!("must be 2 to {most} positions, has {positions}"),
            ));
        }
        Ok(())
    }

    /// The ranges of time to train on and to test on.
    async fn ranges(
        &self,
        id: &CameraId,
        train: Option<TimeRange>,
        test: Option<TimeRange>,
        test_share: Option<f64>,
    ) -> Result<(TimeRange, TimeRange)> {
        match (train, test) {
            (Some(_), Some(_)) if test_share.is_some() => {
                Err(Error::invalid("test_share", "splits all samples: give it, or train and test"))
            }
            (Some(train), Some(test)) if train.overlaps(test) => Err(Error::invalid(
                "test",
                "overlaps train: a method must not be tested on samples that it was trained on",
            )),
            (Some(train), Some(test)) => Ok((train, test)),
            (Some(_), None) => Err(Error::invalid("test", "is missing: give train and test, or neither")),
            (None, Some(_)) => Err(Error::invalid("train", "is missing: give train and test, or neither")),
            (None, None) => self.split(id, test_share.unwrap_or(DEFAULT_TEST_SHARE)).await,
        }
    }

    /// All samples, split at an instant so that about that share of them is later.
    async fn split(&self, id: &CameraId, test_share: f64) -> Result<(TimeRange, TimeRange)> {
        if !TEST_SHARES.contains(&test_share) {
            let (least, most) = (TEST_SHARES.start(), TEST_SHARES.end());
            return Err(Error::invalid("test_share", format!("must be from {least} to {most}")));
        }
        let with_fix = SampleFilter { has_fix: Some(true), ..SampleFilter::default() };
        let count = self.store.count_samples(id, &with_fix).await?;
        let before = (count as f64 * (1.0 - test_share)).round() as u64;
        let at = self.store.sample_time(id, before.min(count.saturating_sub(1))).await?;
        let last = self.store.sample_time(id, count.saturating_sub(1)).await?;
        // Closed, so that samples that arrive while the evaluation is queued change nothing.
        let end =
            last.map(|last| last.saturating_add(SignedDuration::from_micros(1)).unwrap_or(Timestamp::MAX));
        Ok((TimeRange::new(None, at)?, TimeRange::new(at, end)?))
    }

    /// Refuses samples that cannot be evaluated, before the evaluation is queued.
    async fn check_samples(
        &self,
        id: &CameraId,
        train: TimeRange,
        test: TimeRange,
        truth: &Truth,
    ) -> Result<()> {
        let train_filter = SampleFilter::within(train);
        let test_filter = SampleFilter { has_fix: Some(true), ..SampleFilter::within(test) };
        let (train_count, extent) = self.store.sample_extent(id, &train_filter).await?;
        check_extent(id, train_count, extent).map_err(|error| error.at("train"))?;
        let test_count = self.store.count_samples(id, &test_filter).await?;
        if test_count == 0 {
            return Err(Error::invalid("test", "holds no sample of the camera"));
        }
        let (all, most) = (train_count + test_count, self.limits.rows_per_evaluation);
        if all > u64::from(most) {
            let message = format!(
                "has {all} samples together with test, at most {most} may be: give shorter train and test"
            );
            return Err(Error::invalid("train", message));
        }
        if *truth == Truth::Columns && self.store.count_truths(id, &test_filter).await? == 0 {
            return Err(Error::invalid(
                "truth_point",
                "is missing, and no test sample has its truth: give truth_point or truth_line, or import the \
                 samples with truth_longitude and truth_latitude",
            ));
        }
        Ok(())
    }
}

fn check_methods(methods: &[Method]) -> Result<()> {
    if methods.is_empty() {
        return Err(Error::invalid("methods", "must name at least one method"));
    }
    for (index, method) in methods.iter().enumerate() {
        if methods[..index].contains(method) {
            return Err(Error::invalid(format!("methods[{index}]"), "appears twice; name each method once"));
        }
    }
    Ok(())
}
