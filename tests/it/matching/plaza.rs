//! The plaza of ../shared/data: pairs with a known model, over draws of carriers, fixes and boxes.

use std::path::Path;

use serde_json::Value;

use crate::harness::{data_folder, sightfix};

/// The report of `sightfix evaluate --site --match` over draws that nothing was chosen on.
fn report(draws: &str) -> Value {
    let folder = data_folder();
    let json = folder.path().join("report.json");
    let output = sightfix()
        .args(["evaluate", "--image-size", "1920x1080", "--match", "--draws", draws, "--first-draw", "601"])
        .arg("--site")
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/plaza"))
        .arg("--json")
        .arg(&json)
        .output()
        .expect("the binary runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    println!("{}", String::from_utf8_lossy(&output.stdout));
    serde_json::from_slice(&std::fs::read(json).expect("a report")).expect("JSON")
}

#[test]
#[ignore = "needs ../shared/data"]
fn shared_plaza_pairs_with_a_known_model() {
    let report = report("5");
    let all = report["cases"].as_array().and_then(|cases| cases.last()).expect("all cameras");
    let known = &all["known"];
    let sum = |key: &str| -> f64 {
        let sure = known["bins"].as_array().expect("bins").iter().skip(4);
        sure.map(|bin| bin[key].as_f64().expect("a number")).sum()
    };
    let (pairs, right, stated) = (sum("pairs"), sum("right"), sum("stated"));
    // The goals are 0.95, and 0.5 of the pairs found: there are few in these draws (docs/explanation/association.md).
    assert!(right >= 0.92 * pairs, "{known}");
    assert!(stated - right <= 0.06 * pairs, "{known}");
    let [found, all] = ["found", "true_pairs"].map(|key| known[key].as_f64().expect("a number"));
    assert!(found >= 0.02 * all, "{known}");
}
