//! Training and test rows of the experiments, from simulated worlds and from recordings.

use jiff::{SignedDuration, Timestamp};

use super::RealRecording;
use crate::TestRow;
use crate::domain::{BoundingBox, Detection, ImageSize, Observation, Sample, TargetId};
use crate::model::FitInput;
use crate::simulation::{Options, Route, SimulatedRow, World, simulate};

/// A gap in a recording longer than this separates sessions.
const MAX_GAP: SignedDuration = SignedDuration::from_mins(10);
/// Sessions with fewer rows are not used as test sets.
const MIN_SESSION_ROWS: usize = 300;
/// A gap longer than this separates traverses, s.
const TRAVERSE_GAP_S: i64 = 20;

/// How the test rows of a simulated case differ from its training rows.
#[derive(Debug, Clone, Copy)]
pub(super) struct TestSet {
    pub(super) rows: usize,
    /// `None` for that of training.
    pub(super) route: Option<Route>,
    pub(super) new_line_offset_m: Option<f64>,
    pub(super) box_shift_px: f64,
}

impl TestSet {
    pub(super) const fn new(rows: usize) -> Self {
        Self { rows, route: None, new_line_offset_m: None, box_shift_px: 0.0 }
    }

    pub(super) const fn on(self, route: Route) -> Self {
        Self { route: Some(route), ..self }
    }

    pub(super) const fn enlarged_by(self, box_shift_px: f64) -> Self {
        Self { box_shift_px, ..self }
    }
}

/// Training rows of one camera, and one or several sets of test rows.
pub(super) struct Split {
    pub(super) train: Vec<Sample>,
    /// Boxes of training without a fix.
    pub(super) unpaired: Vec<Detection>,
    pub(super) tests: Vec<Vec<TestRow>>,
    pub(super) image_size: Option<ImageSize>,
}

impl Split {
    /// The world of those options and its test sets.
    ///
    /// # Errors
    /// A box shift that makes boxes invalid.
    pub(super) fn of_world(options: &Options, tests: &[TestSet]) -> anyhow::Result<Self> {
        let world = simulate(options);
        let rows = |test: &TestSet| {
            let shifted_px = test.box_shift_px;
            let simulated = simulate(&Options {
                route: test.route.unwrap_or(options.route),
                new_line_offset_m: test.new_line_offset_m.or(options.new_line_offset_m),
                ..options.test(test.rows)
            });
            test_rows_of(&simulated).into_iter().map(|row| shifted(row, shifted_px)).collect()
        };
        Ok(Self {
            train: world.training_samples(),
            unpaired: Vec::new(),
            tests: tests.iter().map(rows).collect::<anyhow::Result<_>>()?,
            image_size: Some(world.image_size),
        })
    }

    /// Returns the training input of a fit.
    pub(super) fn input(&self) -> FitInput<'_> {
        FitInput { samples: &self.train, unpaired: &self.unpaired, known_points: &[] }
    }

    /// All test sets as one, whose targets are distinguished by the number of the set, and the index of the
    /// first row of each set. So one model is judged on all of them.
    pub(super) fn joined_tests(&self) -> anyhow::Result<(Vec<TestRow>, Vec<usize>)> {
        let (mut joined, mut begins) = (Vec::new(), Vec::new());
        for (number, rows) in self.tests.iter().enumerate() {
            begins.push(joined.len());
            for row in rows {
                let (time, target_id, bounding_box, fix) = row.observation.clone().into_parts();
                let id = target_id.as_ref().map_or("target", TargetId::as_str);
                let target_id = Some(TargetId::new(&format!("{id}-set-{number}"))?);
                let observation = Observation::new(time, target_id, bounding_box, fix)?;
                joined.push(TestRow { observation, truth: row.truth });
            }
        }
        Ok((joined, begins))
    }
}

fn shifted(row: TestRow, by_px: f64) -> anyhow::Result<TestRow> {
    let grow = |bounding_box: BoundingBox| bounding_box.grown_to_upper_left(by_px);
    Ok(TestRow { observation: row.observation.try_map_box(grow)?, ..row })
}

fn test_rows_of(world: &World) -> Vec<TestRow> {
    let test_row =
        |row: &SimulatedRow| Some(TestRow { observation: row.observation()?, truth: Some(row.truth) });
    world.rows.iter().filter_map(test_row).collect()
}

/// The traverses of one target's samples, which are in order of time.
pub(super) fn traverses(samples: &[Sample]) -> impl Iterator<Item = &[Sample]> {
    samples.chunk_by(|one, next| next.time.duration_since(one.time).as_secs() < TRAVERSE_GAP_S)
}

/// Ten evenly spaced rows of each of the first four traverses.
pub(super) fn forty_rows_of_four_traverses(samples: &[Sample]) -> Vec<Sample> {
    let ten = |traverse: &[Sample]| {
        (0..10).filter_map(|index| traverse.get(index * traverse.len() / 10).cloned()).collect::<Vec<_>>()
    };
    traverses(samples).take(4).flat_map(ten).collect()
}

/// A session of a recording, in the order of time.
pub(super) struct RecordedSession {
    pub(super) from: Timestamp,
    pub(super) until: Timestamp,
}

/// The sessions of a recording that are long enough to be test sets.
pub(super) fn sessions(recording: &RealRecording) -> Vec<RecordedSession> {
    let is_same = |one: &Sample, next: &Sample| next.time.duration_since(one.time) < MAX_GAP;
    recording
        .samples
        .chunk_by(is_same)
        .filter(|session| session.len() >= MIN_SESSION_ROWS)
        .map(|session| RecordedSession { from: session[0].time, until: session[session.len() - 1].time })
        .collect()
}

/// One session as the test set of a model that is trained on the others.
pub(super) fn leave_out(recording: &RealRecording, session: &RecordedSession) -> Split {
    let is_test = |sample: &&Sample| (session.from..=session.until).contains(&sample.time);
    Split {
        train: recording.samples.iter().filter(|sample| !is_test(sample)).cloned().collect(),
        unpaired: Vec::new(),
        tests: vec![recording.samples.iter().filter(is_test).map(test_row).collect()],
        image_size: None,
    }
}

fn test_row(sample: &Sample) -> TestRow {
    TestRow {
        observation: Observation::with_fix(
            sample.time,
            Some(sample.target_id.clone()),
            Some(sample.bounding_box),
            sample.fix,
        ),
        truth: None,
    }
}
