//! `sightfix simulate` and the plots of `sightfix evaluate`, through the real binary.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use sightfix::geo::{EastNorth, LocalPlane, Position};

use crate::harness::{data_folder, run, sightfix};

/// The rows of a CSV file by column name.
fn rows(path: &Path) -> Vec<BTreeMap<String, String>> {
    let mut reader = csv::Reader::from_path(path).expect("a CSV file");
    reader.deserialize().map(|row| row.expect("a row")).collect()
}

fn number(row: &BTreeMap<String, String>, column: &str) -> f64 {
    row[column].parse().unwrap_or_else(|_| panic!("{column} of {row:?}"))
}

/// Error of a row's fix, m.
fn gnss_error(row: &BTreeMap<String, String>) -> EastNorth {
    let at = |prefix: &str| {
        Position::new(number(row, &format!("{prefix}longitude")), number(row, &format!("{prefix}latitude")))
    };
    LocalPlane::new(at("truth_").expect("valid")).to_plane(at("").expect("valid"))
}

/// Simulates a training and a test file into a folder.
fn simulate(folder: &Path, flags: &[&str]) {
    let (train, test) = (folder.join("train.csv"), folder.join("test.csv"));
    let files = ["--out", train.to_str().expect("UTF-8"), "--test-out", test.to_str().expect("UTF-8")];
    run(&[&["simulate"][..], flags, &files].concat());
}

#[test]
fn simulated_receivers_keep_a_bias_of_their_own() {
    let folder = data_folder();
    let flags = ["square", "--targets", "4", "--samples", "400", "--test-samples", "400"];
    let biased = ["--gnss-sigma-m", "0.2", "--gnss-bias-sigma-m", "4"];
    simulate(folder.path(), &[&flags[..], &biased].concat());
    let rows = rows(&folder.path().join("test.csv"));
    let mut errors: BTreeMap<&str, Vec<EastNorth>> = BTreeMap::new();
    for row in &rows {
        errors.entry(&row["target_id"]).or_default().push(gnss_error(row));
    }
    assert_eq!(errors.len(), 4);
    let firsts: Vec<EastNorth> = errors.values().map(|errors| errors[0]).collect();
    for own in errors.values() {
        assert!(own.iter().all(|error| error.distance_m(own[0]) < 2.0), "the bias lasts: {own:?}");
    }
    assert!(
        firsts.windows(2).all(|pair| pair[0].distance_m(pair[1]) > 0.5),
        "it is the receiver's: {firsts:?}"
    );
}

#[test]
fn simulated_ids_break_and_come_back_for_other_targets() {
    let folder = data_folder();
    let flags = ["square", "--targets", "8", "--route", "area", "--samples", "800", "--test-samples", "800"];
    simulate(folder.path(), &flags);
    let stable = rows(&folder.path().join("train.csv"));
    simulate(folder.path(), &[&flags[..], &["--tracker-id-lifetime-s", "20"]].concat());
    let broken = rows(&folder.path().join("train.csv"));
    let mut targets_of: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for (broken, stable) in broken.iter().zip(&stable) {
        assert_eq!((&broken["time"], &broken["left"]), (&stable["time"], &stable["left"]));
        targets_of.entry(&broken["target_id"]).or_default().insert(&stable["target_id"]);
    }
    let shared = targets_of.values().filter(|targets| targets.len() > 1).count();
    assert!(shared >= 4, "{targets_of:?}");
}

#[test]
fn simulated_boxes_depend_on_the_targets_size_and_the_same_flags_give_the_same_bytes() {
    let folder = data_folder();
    let flags = ["airport", "--samples", "300", "--test-samples", "50"];
    let bytes = |extra: &[&str]| {
        simulate(folder.path(), &[&flags[..], extra].concat());
        std::fs::read(folder.path().join("train.csv")).expect("written")
    };
    let widest_px =
        || rows(&folder.path().join("train.csv")).iter().map(|row| number(row, "width")).fold(0.0, f64::max);
    let nominal = bytes(&[]);
    let nominal_px = widest_px();
    assert_eq!(nominal, bytes(&["--target-size-m", "35x34x11.8", "--antenna-m", "3,0"]), "the scene's own");
    let large = bytes(&["--target-size-m", "74x68x24", "--antenna-m", "-20,5"]);
    let large_px = widest_px();
    assert_eq!(large, bytes(&["--target-size-m", "74x68x24", "--antenna-m", "-20,5"]));
    assert!(large_px > 1.6 * nominal_px, "{nominal_px} {large_px}");
}

#[test]
fn impossible_simulations_are_refused_with_the_flag_and_the_range() {
    let refused = [
        (&["--antenna-m", "40,0"][..], "--antenna-m must be within the target"),
        (&["--target-size-m", "37x34"], "must be three lengths in m"),
        (&["--sessions", "8"], "--sessions must be from 1 to 7"),
        (&["--gross-fixes", "1.5"], "--gross-fixes must be a share from 0 to 0.95"),
        (&["--tracker-id-lifetime-s", "0"], "--tracker-id-lifetime-s must be from 1"),
        (&["--route", "nowhere"], "must be lines, new-line, area or standing"),
    ];
    for (flags, message) in refused {
        let folder = data_folder();
        let out = folder.path().join("train.csv");
        let output = sightfix().args(["simulate", "airport", "--out"]).arg(&out).args(flags).output();
        let output = output.expect("the binary runs");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && errors.contains(message), "{flags:?}: {errors}");
        assert!(!out.exists(), "{flags:?} wrote a file");
    }
}

#[test]
fn plots_show_every_method_and_count_what_is_outside() {
    let folder = data_folder();
    let flags = ["square", "--samples", "300", "--test-samples", "200", "--gross-fixes", "0.02"];
    simulate(folder.path(), &flags);
    let file = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let (train, test, plots) = (file("train.csv"), file("test.csv"), file("plots"));
    let evaluate = |methods: &str| {
        run(&[
            "evaluate",
            "--train",
            &train,
            "--test",
            &test,
            "--plots",
            &plots,
            "--gnss-sigma-m",
            "2.2",
            "--methods",
            methods,
        ]);
    };
    evaluate("gnss,homography.denied");
    let read = |name: &str| std::fs::read_to_string(folder.path().join("plots").join(name));
    assert!(read("error_scale.svg").is_err(), "no recipe, so there is no Es to show");
    evaluate("gnss,imm_ukf,homography.denied,projective.two_step");
    for name in ["error_over_time.svg", "cumulative_share.svg", "plane.svg"] {
        let svg = read(name).expect(name);
        for method in ["gnss", "imm_ukf", "homography.denied", "projective.two_step"] {
            assert!(svg.contains(&format!(">{method}")), "{name} has no {method}");
        }
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{name}");
    }
    let calibration = read("calibration.svg").expect("written");
    assert!(
        calibration.contains(">projective.two_step") && !calibration.contains(">homography"),
        "{calibration}"
    );
    // 1 km off the square: not drawn, but counted.
    let plane = read("plane.svg").expect("written");
    let outside = plane.split(">gnss (").nth(1).and_then(|rest| rest.split(" outside").next());
    let outside: usize = outside.unwrap_or_else(|| panic!("{plane}")).parse().expect("a count");
    assert!((1..=40).contains(&outside), "{outside} of 200 fixes are outside");

    evaluate("hybrid.denied");
    assert!(read("error_scale.svg").expect("hybrid has epochs").contains(">hybrid"));
}

#[test]
fn gross_errors_of_the_fixes_cost_no_accuracy() {
    let folder = data_folder();
    let flags =
        ["airport", "--samples", "1500", "--test-samples", "600", "--seed", "4001", "--camera-seed", "4001"];
    let two_step_m = |gross: &str| {
        simulate(
            folder.path(),
            &[&flags[..], &["--gross-fixes", gross, "--gross-fix-error-m", "1000"]].concat(),
        );
        let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
        let (train, test, json) = (path("train.csv"), path("test.csv"), path("report.json"));
        let flags =
            ["--image-size", "1920x1080", "--gnss-sigma-m", "29.5", "--methods", "projective.two_step"];
        let files = ["evaluate", "--train", &train, "--test", &test, "--json", &json];
        run(&[&files[..], &flags].concat());
        let report = std::fs::read(&json).expect("a report");
        let report: serde_json::Value = serde_json::from_slice(&report).expect("JSON");
        report["methods"]["projective.two_step"]["mean_m"].as_f64().unwrap_or_else(|| panic!("{report}"))
    };
    let (without_m, with_m) = (two_step_m("0"), two_step_m("0.05"));
    println!("two-step {without_m:.2} m, with 5 % of the fixes off by 1 km {with_m:.2} m");
    assert!(with_m < 1.15 * without_m, "{without_m} {with_m}");
}
