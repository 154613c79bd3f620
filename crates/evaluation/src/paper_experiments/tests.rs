//! The format of the page, from figures that are made up: what it shows, and which marks it calls met.

use super::cases::{Case, key};
use super::marks::{self, ONE_STEP, TRACK, TWO_STEP};
use super::page::{self, Made};
use super::scores::{CaseScore, MethodScore};
use super::simulated::Worlds;
use super::tables;
use super::walks::{WALKS, WalkCurves};
use crate::simulation::Scene;
use crate::{ErrorMetrics, MethodReport, ScoredPrediction};

/// Figures of that mean (m), with that share of the true positions inside the stated radius.
fn figures(mean_m: f64, coverage: Option<f64>) -> ErrorMetrics {
    let r95_m =
        |index: u32| coverage.map(|share| if f64::from(index) < 100.0 * share { 2.0 * mean_m } else { 0.0 });
    let predictions: Vec<ScoredPrediction> =
        (0..100).map(|index| ScoredPrediction { error_m: mean_m, r95_m: r95_m(index) }).collect();
    ErrorMetrics::of(&predictions).expect("some")
}

fn method(name: &str, mean_m: f64, coverage: Option<f64>) -> MethodScore {
    let metrics = figures(mean_m, coverage);
    let report =
        MethodReport { metrics: metrics.clone(), seed_means_m: vec![mean_m], train_cpu_s: 1.0, fuse_us: 1.0 };
    let range_m = Some([mean_m - 0.5, mean_m + 0.5]);
    MethodScore { name: name.to_owned(), report, with_box: Some(metrics), range_m }
}

fn score(key: &str, methods: Vec<MethodScore>) -> CaseScore {
    CaseScore {
        case: Case {
            key: key.to_owned(),
            title: format!("case {key}"),
            description: String::new(),
            command: Some("sightfix simulate airport".to_owned()),
        },
        group: "Simulated airport",
        in_main_table: true,
        worlds: 3,
        train_rows: 10_000,
        test_rows: 400,
        gnss_sigma_m: 29.5,
        methods,
        failed: [("paper.two_step".to_owned(), "made up".to_owned())].into(),
        curves: Vec::new(),
        traces: Vec::new(),
        first_world: Default::default(),
    }
}

/// A case that meets every mark, and one that misses each of them.
fn scores() -> Vec<CaseScore> {
    let good = vec![
        method("gnss", 37.0, Some(0.95)),
        method("homography.denied", 3.0, None),
        method("dnn.denied", 4.0, None),
        method(ONE_STEP, 2.0, Some(0.95)),
        method(TWO_STEP, 1.9, Some(0.95)),
        method(TRACK, 1.8, Some(0.95)),
    ];
    let bad = vec![
        method("gnss", 9.0, Some(0.95)),
        method("homography.denied", 3.0, None),
        method(ONE_STEP, 6.0, Some(0.5)),
        method(TWO_STEP, 6.0, Some(0.5)),
        method(TRACK, 6.0, Some(1.0)),
    ];
    vec![score(key::LARGE, good), score(key::LARGE_NEW_LINE, bad)]
}

fn curves() -> Vec<WalkCurves> {
    let one = |walks: usize| Some(figures(20.0 / walks as f64, Some(0.9)));
    let methods = ["auto.denied", "paper.denied"].map(|name| (name.to_owned(), WALKS.map(one).to_vec()));
    vec![WalkCurves {
        scene: Scene::Square,
        worlds: 3,
        rows: vec![40; WALKS.len()],
        methods: methods.to_vec(),
    }]
}

#[test]
fn the_page_begins_with_a_table_of_means_and_coverages_and_says_which_marks_are_missed() {
    let scores = scores();
    let pictures = page::pictures(&scores, &curves());
    let worlds = Worlds { first: 7, count: 3 };
    let made = Made { worlds, command: "the command".to_owned(), cpu_s: 61.0 };
    let page = page::page("accuracy", &made, &scores, &curves(), &pictures);
    let first_table = page.lines().find(|line| line.starts_with('|')).expect("a table");
    assert!(
        first_table.starts_with("| case | GNSS | IMM-UKF | homography | DNN on the box | paper |"),
        "{page}"
    );
    assert!(
        page.contains("| case large | 37.00 (95) | - | 3.00 | 4.00 | - | 2.00 (95) | 1.90 (95) |"),
        "{page}"
    );
    assert!(page.contains(" 0.63 |  |\n"), "two-step to the best baseline, nothing missed: {page}");
    assert!(page.contains("| 2.00 | two-step coverage, track coverage, ratio |"), "{page}");
    assert!(page.contains("one-step at most 2.5 m, two-step no worse | 2.00 m, 1.90 m | met |"), "{page}");
    assert!(page.contains("| 0.67, 0.50 | **missed** |"), "coverage is too small: {page}");
    assert!(page.contains("| 1 of 2 cases | **missed** |"), "{page}");
    assert!(page.contains("](accuracy/walks_square.svg)") && page.contains("`the command`"), "{page}");
    assert!(page.contains("| `auto` | 20.00 (90) | 10.00 (90) |"), "{page}");
    assert!(
        page.contains("| case large | 1.90 (1.40 to 2.40) | 0 | 95 | 3.61 | "),
        "range, coverage and radius of two-step: {page}"
    );
    // Every row of a table has the cells of its head.
    for table in page.split("\n\n").filter(|part| part.starts_with('|')) {
        let cells: Vec<usize> = table.lines().map(|line| line.matches('|').count()).collect();
        assert!(cells.windows(2).all(|pair| pair[0] == pair[1]), "{table}");
    }
}

#[test]
fn the_tables_hold_every_method_with_the_command_of_the_case() {
    let tables = tables::tables("accuracy", "the command", &scores());
    assert!(tables.contains("[accuracy.md](accuracy.md)"), "{tables}");
    assert!(tables.contains("```sh\nsightfix simulate airport\n```"), "{tables}");
    assert!(tables.contains("| `auto.two_step` | 1.900 | 0.000 |"), "{tables}");
    assert!(tables.contains("`paper.two_step` was not run: made up."), "{tables}");
}

#[test]
fn gross_errors_are_compared_with_the_same_case_without() {
    let [[plain, gross], _] = key::GROSS;
    let of = |key: &str, mean_m: f64| score(key, vec![method(TWO_STEP, mean_m, Some(0.95))]);
    let found = |gross_m: f64| {
        let marks = marks::marks(&[of(plain, 2.0), of(gross, gross_m)]);
        let mark = marks.into_iter().find(|mark| mark.reach.contains("5 %")).expect("the mark");
        (mark.found, mark.is_met)
    };
    assert_eq!(found(2.08), ("+4.0 %".to_owned(), true));
    assert_eq!(found(3.0), ("+50.0 %".to_owned(), false));
}
