//! The marks that the figures are held against, met or missed.

use super::cases::key;
use super::scores::CaseScore;

/// The methods that the two-step fusion must not be worse than.
const BASELINES: [&str; 3] = ["gnss", "homography.denied", "dnn.denied"];
pub(super) const TWO_STEP: &str = "auto.two_step";
pub(super) const ONE_STEP: &str = "auto.one_step";
pub(super) const TRACK: &str = "track";
/// Share of true positions inside the 95 % radius, for every case: of two-step, and of tracks.
const TWO_STEP_COVERAGE: [f64; 2] = [0.90, 0.99];
const TRACK_COVERAGE: [f64; 2] = [0.88, 0.99];
/// Largest ratio of two-step to the best baseline, for every case.
const LARGEST_RATIO: f64 = 1.05;

/// A mark, what was found, and whether that meets it.
pub(super) struct Mark {
    pub(super) case: String,
    pub(super) reach: &'static str,
    pub(super) found: String,
    pub(super) is_met: bool,
}

/// Ratio of two-step's mean to that of the best baseline that could run.
pub(super) fn ratio_to_best(score: &CaseScore) -> Option<f64> {
    let best_m = BASELINES.iter().filter_map(|method| score.mean_m(method)).reduce(f64::min)?;
    Some(score.mean_m(TWO_STEP)? / best_m)
}

/// Which of the marks of every case a case misses, in words.
pub(super) fn missed(score: &CaseScore) -> Vec<&'static str> {
    let mut missed = Vec::new();
    if !is_within(score.coverage95(TWO_STEP), TWO_STEP_COVERAGE) {
        missed.push("two-step coverage");
    }
    if !is_within(score.coverage95(TRACK), TRACK_COVERAGE) {
        missed.push("track coverage");
    }
    if ratio_to_best(score).is_none_or(|ratio| ratio > LARGEST_RATIO) {
        missed.push("ratio");
    }
    missed
}

fn is_within(share: Option<f64>, [low, high]: [f64; 2]) -> bool {
    // Rounded as it is shown.
    share.is_some_and(|share| (low..=high).contains(&((1e3 * share).round() / 1e3)))
}

/// The marks for which there are cases.
pub(super) fn marks(scores: &[CaseScore]) -> Vec<Mark> {
    let of = |key: &str| scores.iter().find(|score| score.case.key == key);
    let prefixed = |prefix: &'static str| {
        scores.iter().filter(move |score| score.in_main_table && score.case.key.starts_with(prefix))
    };
    let mut all = Vec::new();
    all.extend(of(key::LARGE).and_then(large_aircraft));
    all.extend(of(key::LARGE_NEW_LINE).and_then(|score| {
        against_gnss(score, "two-step at most 0.7 of GNSS, coverage at least 0.85", 0.7, 0.85)
    }));
    all.extend(of(key::LARGE_30_PX).and_then(|score| {
        against_gnss(score, "two-step at most 0.5 of GNSS, coverage at least 0.90", 0.5, 0.90)
    }));
    all.extend(prefixed(key::PLAZA).filter_map(real_people));
    all.extend(of(key::MANY_RECEIVERS).and_then(many_receivers));
    all.extend(prefixed(key::REAL).filter_map(real_square));
    all.extend(key::GROSS.iter().filter_map(|[plain, gross]| gross_errors(of(plain)?, of(gross)?)));
    all.push(every_case(scores));
    all
}

fn large_aircraft(score: &CaseScore) -> Option<Mark> {
    let (one_m, two_m) = (score.mean_m(ONE_STEP)?, score.mean_m(TWO_STEP)?);
    Some(Mark {
        case: score.case.title.clone(),
        reach: "one-step at most 2.5 m, two-step no worse",
        found: format!("{one_m:.2} m, {two_m:.2} m"),
        is_met: one_m <= 2.5 && two_m <= one_m,
    })
}

fn against_gnss(score: &CaseScore, reach: &'static str, ratio: f64, coverage: f64) -> Option<Mark> {
    let found = score.mean_m(TWO_STEP)? / score.mean_m("gnss")?;
    let inside = score.coverage95(TWO_STEP)?;
    Some(Mark {
        case: score.case.title.clone(),
        reach,
        found: format!("{found:.2}, {inside:.2}"),
        is_met: found <= ratio && inside >= coverage,
    })
}

fn real_people(score: &CaseScore) -> Option<Mark> {
    let homography_m = score.mean_m("homography.denied")?;
    let ratio = score.mean_m(TWO_STEP)? / homography_m;
    let inside = score.coverage95(TWO_STEP);
    let most = if homography_m > 0.5 { 0.8 } else { 1.0 };
    Some(Mark {
        case: score.case.title.clone(),
        reach: "at most 0.8 of the homography where that has more than 0.5 m, else 1.0; coverage 0.90 to 0.99",
        found: format!("{ratio:.2} of {homography_m:.2} m, {:.2}", inside.unwrap_or_default()),
        is_met: ratio <= most && is_within(inside, TWO_STEP_COVERAGE),
    })
}

fn many_receivers(score: &CaseScore) -> Option<Mark> {
    let (two_step, track) = (score.coverage95(TWO_STEP)?, score.coverage95(TRACK)?);
    Some(Mark {
        case: score.case.title.clone(),
        reach: "coverage of two-step and track 0.90 to 0.99 over 20 worlds",
        found: format!("{two_step:.2}, {track:.2}"),
        is_met: [two_step, track].into_iter().all(|share| is_within(Some(share), TWO_STEP_COVERAGE)),
    })
}

fn real_square(score: &CaseScore) -> Option<Mark> {
    let inside = score.coverage95(TWO_STEP)?;
    Some(Mark {
        case: format!("real square, {}", score.case.title),
        reach: "coverage of two-step 0.90 to 0.99",
        found: format!("{inside:.2} (mean {:.2} m)", score.mean_m(TWO_STEP)?),
        is_met: is_within(Some(inside), TWO_STEP_COVERAGE),
    })
}

fn gross_errors(plain: &CaseScore, gross: &CaseScore) -> Option<Mark> {
    let ratio = gross.mean_m(TWO_STEP)? / plain.mean_m(TWO_STEP)?;
    Some(Mark {
        case: format!("{}: {}", gross.group.to_lowercase(), gross.case.title),
        reach: "two-step within 5 % of that without them",
        found: format!("{:+.1} %", 100.0 * (ratio - 1.0)),
        is_met: ratio <= 1.05,
    })
}

fn every_case(scores: &[CaseScore]) -> Mark {
    let shown: Vec<&CaseScore> = scores.iter().filter(|score| score.in_main_table).collect();
    let met = shown.iter().filter(|score| missed(score).is_empty()).count();
    Mark {
        case: "every case".to_owned(),
        reach: "coverage of two-step 0.90 to 0.99, of tracks 0.88 to 0.99, two-step at most 1.05 of the best of \
                GNSS, homography and DNN",
        found: format!("{met} of {} cases", shown.len()),
        is_met: met == shown.len(),
    }
}
