//! The cases on recordings of real cameras.

use super::cases::{Case, Experiment, METHODS, key};
use super::splits::{Split, leave_out, sessions};
use super::{RealCamera, RealRecording};
use crate::domain::SigmaM;
use crate::{Method, Truth};

/// Standard deviation per axis of the square recording's receiver, m: 2.7 m mean error at a fixed point,
/// divided by sqrt(pi / 2).
const SQUARE_SIGMA_M: f64 = 2.2;
/// The same of the phones on the plaza, m: 2.5 m coloured and 0.75 m white, as its description states.
const PLAZA_SIGMA_M: f64 = 2.61;

/// The real square: each session is the test set of a model trained on the others.
pub(super) fn real_square(recording: &RealRecording) -> anyhow::Result<Vec<Experiment>> {
    let each = sessions(recording).into_iter().enumerate().map(|(index, session)| {
        let case = Case {
            key: format!("{}{}", key::REAL, index + 1),
            title: format!("session {} of one person", index + 1),
            description: format!(
                "{} to {}, trained on the other sessions; the error is the distance to the surveyed line.",
                session.from, session.until
            ),
            command: None,
        };
        let recording = recording.clone();
        let truth = recording.truth.clone();
        recorded("Real square", case, truth, SQUARE_SIGMA_M, move || Ok(leave_out(&recording, &session)))
    });
    each.collect()
}

/// People on a real square with simulated phones: trained on those who carry one, judged on all others.
pub(super) fn plaza(cameras: &[RealCamera]) -> anyhow::Result<Vec<Experiment>> {
    let each = cameras.iter().map(|camera| {
        let case = Case {
            key: format!("{}{}", key::PLAZA, camera.name),
            title: format!("camera {}, 20 people with phones, judged on the others", camera.name),
            description: "Trained on the boxes and fixes of those who carry a phone; nobody else has a fix."
                .to_owned(),
            command: None,
        };
        let camera = camera.clone();
        recorded("Real people, simulated phones", case, Truth::Columns, PLAZA_SIGMA_M, move || {
            Ok(Split {
                train: camera.train.clone(),
                unpaired: camera.unpaired.clone(),
                tests: vec![camera.test.clone()],
                image_size: camera.image_size,
            })
        })
    });
    each.collect()
}

fn recorded(
    group: &'static str,
    case: Case,
    truth: Truth,
    sigma_m: f64,
    split: impl Fn() -> anyhow::Result<Split> + 'static,
) -> anyhow::Result<Experiment> {
    Ok(Experiment {
        group,
        cases: vec![case],
        splits: vec![Box::new(split)],
        seeds: 1,
        truth,
        gnss_sigma: SigmaM::new(sigma_m)?,
        methods: Method::list(METHODS)?,
        show_curves: false,
        in_main_table: true,
    })
}
