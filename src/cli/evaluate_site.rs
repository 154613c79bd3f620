//! `sightfix evaluate --site`

use std::path::Path;

use super::output::print_line;
use super::progress::Progress;
use super::site_recording;
use crate::domain::ImageSize;
use crate::evaluation::site::{
    Degradation, Identities, KNOWN_MODEL_SEEDS, MatchingReport, SiteCase, SiteOutcome, SiteRecording,
    SiteReport, SiteTraining, TrainedSite, track_site, train_site,
};

/// Number of draws and the seed of the first; without any, the recording is taken as it is.
pub(super) struct Draws {
    pub(super) count: u64,
    pub(super) first_seed: u64,
    /// True if only the errors of the fixes are drawn.
    pub(super) only_errors: bool,
}

impl Draws {
    /// True if carriers are drawn, so that each draw has other phones.
    const fn carriers(&self) -> bool {
        self.count > 0 && !self.only_errors
    }

    fn of(&self, recording: &SiteRecording, draw: u64) -> SiteRecording {
        let seed = self.first_seed + draw;
        match (self.count, self.only_errors) {
            (0, _) => recording.clone(),
            (_, true) => recording.with_redrawn_fixes(seed),
            (_, false) => recording.redrawn(seed),
        }
    }
}

/// Trains and tracks a recorded site in several ways and prints a table of figures.
pub(super) fn evaluate(
    folder: &Path,
    image_size: Option<ImageSize>,
    draws: &Draws,
    known_points: usize,
) -> anyhow::Result<SiteReport> {
    let recording = site_recording::read(folder, image_size)?;
    let mut cases = cases(&recording);
    if draws.carriers() {
        cases.extend(cases_of_other_phones(&cases[0]));
    }
    let mut outcomes: Vec<Vec<SiteOutcome>> = vec![Vec::new(); cases.len()];
    let mut progress = Progress::new("{spinner} {pos}/{len} {msg}");
    let count = draws.count.max(1);
    for draw in 0..count {
        let of_draw =
            |draw| draws.of(&recording, draw).with_known_points(known_points, draws.first_seed + draw);
        let drawn = of_draw(draw);
        let trained =
            [SiteTraining::Together, SiteTraining::Apart].map(|training| train_site(&drawn, training));
        let [together, apart] = trained;
        let (together, apart) = (together?, apart?);
        // The fixes that are matched with tracks must not be those by which the cameras were trained.
        let of_other_phones = draws.carriers().then(|| of_draw(draw + KNOWN_MODEL_SEEDS));
        let of_other_phones =
            of_other_phones.map(|it| train_site(&it, SiteTraining::Together)).transpose()?;
        let of_other_phones = of_other_phones.as_ref().unwrap_or(&together);
        for (case, outcomes) in cases.iter().zip(&mut outcomes) {
            progress.set(draw, count, &case.name);
            let trained = match (case.phones, case.training) {
                (Phones::OfTraining, SiteTraining::Together) => &together,
                (Phones::OfTraining, SiteTraining::Apart) => &apart,
                (Phones::Other | Phones::OtherMatched, _) => of_other_phones,
            };
            outcomes.push(case.run(&drawn, trained, draws.first_seed + draw));
        }
    }
    progress.finish();
    let report = SiteReport {
        cases: cases
            .iter()
            .zip(&outcomes)
            .filter_map(|(case, own)| {
                let figures = SiteCase::over_draws(&case.name, own)?;
                Some(match (&case.cameras[..], outcomes.first()) {
                    ([camera], Some(together)) => figures.compared_in_view(*camera, together),
                    _ => figures,
                })
            })
            .collect(),
    };
    let mut tables = vec![
        report.table(),
        report.named_table(),
        report.clock_table(),
        report.found_table(),
        report.crossing_table(),
        report.count_table(),
    ];
    tables.retain(|table| !table.is_empty());
    print_line(&tables.join("\n").trim_end())?;
    Ok(report)
}

/// Matches the boxes of each camera with the receivers and prints tables of figures.
pub(super) fn evaluate_matching(
    folder: &Path,
    image_size: Option<ImageSize>,
    draws: &Draws,
    with_search: bool,
) -> anyhow::Result<MatchingReport> {
    let recording = site_recording::read(folder, image_size)?;
    let mut report = MatchingReport::new(&recording);
    let mut progress = Progress::new("{spinner} {pos}/{len} {msg}");
    for draw in 0..draws.count {
        progress.set(draw, draws.count, "draws");
        report.add_draw(&recording, draws.first_seed + draw, with_search)?;
    }
    progress.finish();
    print_line(&report.table().trim_end())?;
    Ok(report)
}

/// One row of the table.
#[derive(Clone)]
struct Case {
    name: String,
    training: SiteTraining,
    identities: Identities,
    degradation: Option<Degradation>,
    cameras: Vec<usize>,
    phones: Phones,
}

/// The phones of a case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phones {
    /// Those by which the cameras were trained.
    OfTraining,
    /// The cameras were trained by the phones of another draw.
    Other,
    /// The same, and the fixes of the draw come beside its boxes.
    OtherMatched,
}

impl Case {
    fn run(&self, recording: &SiteRecording, trained: &TrainedSite, seed: u64) -> SiteOutcome {
        let degraded = self.degradation.map(|degradation| degradation.apply(recording, seed));
        let boxes = degraded.as_ref().unwrap_or(recording);
        let with_fixes = self.phones == Phones::OtherMatched;
        let mut outcome = track_site(boxes, recording, trained, self.identities, &self.cameras, with_fixes);
        if let Some(knocked_at) = self.degradation.and_then(|own| own.knocked_at(recording)) {
            outcome.count_moves_from(knocked_at);
        }
        outcome
    }
}

/// All cameras trained together and apart, with the true identities, with degraded boxes, and each camera alone.
fn cases(recording: &SiteRecording) -> Vec<Case> {
    let all: Vec<usize> = (0..recording.cameras.len()).collect();
    let case = |name: &str, training, identities, degradation| Case {
        name: name.to_owned(),
        training,
        identities,
        degradation,
        cameras: all.clone(),
        phones: Phones::OfTraining,
    };
    let rough = Some(Degradation::ROUGH);
    let mut cases = vec![
        case("trained together", SiteTraining::Together, Identities::Tracked, None),
        case("together, true identities", SiteTraining::Together, Identities::Oracle, None),
        case("together, degraded boxes", SiteTraining::Together, Identities::Tracked, rough),
        case(
            "together, one clock late",
            SiteTraining::Together,
            Identities::Tracked,
            Some(Degradation::LATE),
        ),
        case(
            "together, one camera knocked by 60 px",
            SiteTraining::Together,
            Identities::Tracked,
            Some(Degradation::KNOCKED),
        ),
        case(
            "together, one camera knocked by 200 px",
            SiteTraining::Together,
            Identities::Tracked,
            Some(Degradation::KNOCKED_HARD),
        ),
        case("trained apart", SiteTraining::Apart, Identities::Tracked, None),
        case("apart, true identities", SiteTraining::Apart, Identities::Oracle, None),
    ];
    cases.extend(recording.cameras.iter().enumerate().map(|(camera, recorded)| Case {
        cameras: vec![camera],
        ..case(&format!("camera {} alone", recorded.id), SiteTraining::Apart, Identities::Tracked, None)
    }));
    cases
}

/// All cameras trained together by the phones of another draw, without fixes and with them.
fn cases_of_other_phones(together: &Case) -> [Case; 3] {
    [
        ("together, other phones", Phones::Other, None),
        ("together, other phones beside the boxes", Phones::OtherMatched, None),
        ("the same, the phones late by 1 s", Phones::OtherMatched, Some(Degradation::LATE_RECEIVERS)),
    ]
    .map(|(name, phones, degradation)| Case {
        name: name.to_owned(),
        phones,
        degradation,
        ..together.clone()
    })
}
