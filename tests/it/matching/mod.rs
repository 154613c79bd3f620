//! Boxes that have only a tracker's ids, matched with fixes that have only receivers': by the command line
//! and over REST.

mod crowd;
mod learning;
mod live;
mod plaza;
mod ships;

use std::collections::BTreeMap;
use std::path::Path;

use tempfile::TempDir;

use self::crowd::{Crowd, IMAGE, Recorded};
use crate::harness::{data_folder, sightfix};

/// The output and the files of `sightfix pair --match`.
struct Matched {
    succeeded: bool,
    printed: String,
    /// Samples: target, tracker's id, probability, walker of the box.
    samples: Vec<(String, String, f64, usize)>,
}

impl Matched {
    /// Right samples and all of them.
    fn right(&self) -> (usize, usize) {
        let is_right = |target: &str, number: usize| {
            target.ends_with(&format!("-{number}")) && !target.starts_with("emitter")
        };
        let right = self.samples.iter().filter(|own| is_right(&own.0, own.3)).count();
        (right, self.samples.len())
    }
}

fn run_match(folder: &TempDir, recorded: &Recorded, flags: &[&str]) -> Matched {
    let path = |name: &str| folder.path().join(name);
    std::fs::write(path("detections.csv"), &recorded.detections).expect("written");
    std::fs::write(path("fixes.csv"), &recorded.fixes).expect("written");
    let out = path("samples.csv");
    drop(std::fs::remove_file(&out));
    let output = sightfix()
        .args(["pair", "--match", "--detections"])
        .arg(path("detections.csv"))
        .arg("--fixes")
        .arg(path("fixes.csv"))
        .arg("--out")
        .arg(&out)
        .args(flags)
        .output()
        .expect("the binary runs");
    let printed =
        String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    Matched { succeeded: output.status.success(), printed, samples: samples(&out, recorded) }
}

/// Rows of the written samples, joined with the walkers of their boxes.
fn samples(out: &Path, recorded: &Recorded) -> Vec<(String, String, f64, usize)> {
    let Ok(text) = std::fs::read_to_string(out) else { return Vec::new() };
    let boxes = recorded.detections.lines().skip(1).zip(&recorded.walkers);
    let walkers: BTreeMap<(jiff::Timestamp, String), usize> = boxes
        .map(|(line, walker)| {
            let cells: Vec<&str> = line.split(',').collect();
            ((cells[0].parse().expect("a time"), cells[1].to_owned()), *walker)
        })
        .collect();
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let header = reader.headers().expect("a header").clone();
    let column = |name: &str| header.iter().position(|given| given == name).expect("the column");
    let columns = ["time", "target_id", "tracker_id", "match_probability"].map(column);
    reader
        .records()
        .map(|row| {
            let row = row.expect("a row");
            let [time, target, tracker, probability] = columns.map(|at| row[at].to_owned());
            let time: jiff::Timestamp = time.parse().expect("a time");
            // A sample of a group is of the mean box of its members.
            let members: Vec<usize> = tracker.split('+').map(|id| walkers[&(time, id.to_owned())]).collect();
            let is_named = |walker: &&usize| target.ends_with(&format!("-{walker}"));
            let walker = *members.iter().find(is_named).unwrap_or(&members[0]);
            (target, tracker, probability.parse().expect("a probability"), walker)
        })
        .collect()
}

const ONE_AMONG_TEN: Crowd =
    Crowd { seed: 1, walkers: 11, phones: 1, seconds: 600, lifetime_s: 40.0, swap_s: f64::INFINITY };

#[test]
fn one_phone_among_ten_walkers_is_matched_without_a_model() {
    let folder = data_folder();
    let recorded = ONE_AMONG_TEN.recorded();
    let matched = run_match(&folder, &recorded, &["--image-size", IMAGE, "--json"]);
    let (right, all) = matched.right();
    assert!(
        matched.succeeded && all > 200 && right * 100 >= all * 95,
        "{right} of {all}: {}",
        matched.printed
    );
    let document: serde_json::Value =
        serde_json::from_str(matched.printed.lines().next().unwrap_or("")).expect("a document");
    let (pairs, scores) = (&document["matching"]["pairs"], &document["matching"]["scores"]);
    let sure = |pair: &serde_json::Value| pair["probability"].as_f64().is_some_and(|own| own >= 0.8);
    assert!(pairs.as_array().is_some_and(|pairs| pairs.len() >= 3 && pairs.iter().all(sure)), "{document}");
    assert!(scores["best"].as_f64() > scores["shifted_clocks"].as_f64(), "{document}");
    // The samples are as the importer reads them.
    let data = folder.path().join("data");
    let output = sightfix()
        .args(["import", "--camera", "square", "--create", "--image-size", IMAGE, "--data"])
        .arg(&data)
        .arg(folder.path().join("samples.csv"))
        .output()
        .expect("the binary runs");
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(printed.contains(&format!("accepted {all} ")), "{printed}");
}

#[test]
fn a_short_recording_is_refused_with_what_to_record() {
    let folder = data_folder();
    let recorded = Crowd { seconds: 25, ..ONE_AMONG_TEN }.recorded();
    let matched = run_match(&folder, &recorded, &["--image-size", IMAGE]);
    assert!(!matched.succeeded && matched.samples.is_empty(), "{}", matched.printed);
    for part in ["not identifiable", "record "] {
        assert!(matched.printed.contains(part), "{part} is missing in: {}", matched.printed);
    }
}

#[test]
#[ignore = "takes minutes: the marks of docs/explanation/association.md"]
fn marks_of_one_phone_among_ten_walkers() {
    let folder = data_folder();
    let (mut identified, mut wrong) = (0, 0);
    for seed in 1..=20 {
        let recorded = Crowd { seed, ..ONE_AMONG_TEN }.recorded();
        let matched = run_match(&folder, &recorded, &["--image-size", IMAGE]);
        let (right, all) = matched.right();
        identified += usize::from(matched.succeeded && right * 100 >= all * 95);
        wrong += usize::from(matched.succeeded && right * 100 < all * 95);
        println!(
            "world {seed}: {right} of {all} samples right; {}",
            matched.printed.lines().next().unwrap_or("")
        );
    }
    println!("right in {identified} of 20 worlds, wrong in {wrong}");
    assert!(identified >= 19 && wrong == 0);
}

/// Share of right samples over some worlds, and the number of worlds that were matched.
fn share_right(crowd: Crowd, seeds: std::ops::RangeInclusive<u64>) -> (f64, usize) {
    let folder = data_folder();
    let (mut right, mut all, mut matched) = (0, 0, 0);
    for seed in seeds {
        let found = run_match(&folder, &Crowd { seed, ..crowd }.recorded(), &["--image-size", IMAGE]);
        let own = found.right();
        println!("world {seed}: {} of {}; {}", own.0, own.1, found.printed.lines().next().unwrap_or(""));
        matched += usize::from(found.succeeded);
        (right, all) = (right + own.0, all + own.1);
    }
    (right as f64 / all.max(1) as f64, matched)
}

#[test]
#[ignore = "takes minutes: the marks of docs/explanation/association.md"]
fn marks_of_ids_that_swap() {
    let crowd = Crowd { walkers: 15, phones: 6, seconds: 240, ..ONE_AMONG_TEN };
    let (steady, steady_worlds) = share_right(crowd, 1..=4);
    let (swapped, swapped_worlds) = share_right(Crowd { swap_s: 60.0, ..crowd }, 1..=4);
    println!(
        "right without swaps {steady:.3} ({steady_worlds} worlds), with swaps {swapped:.3} ({swapped_worlds} worlds)"
    );
    assert!(swapped >= steady - 0.05 && swapped_worlds > 0);
}

/// Ships that pass five times are found with their scale, which their boxes do not tell; those that pass once are not
/// identifiable.
#[test]
fn ships_are_found_by_several_passes() {
    let folder = data_folder();
    let (mut refused, mut identified, mut wrong) = (0, 0, 0);
    for seed in 1..=5 {
        for passes in [1, 5] {
            let matched = run_match(&folder, &ships::recorded(seed, passes), &["--image-size", IMAGE]);
            let (right, all) = matched.right();
            println!(
                "world {seed}, {passes} passes: {right} of {all}; {}",
                matched.printed.lines().next().unwrap_or("")
            );
            let is_right = matched.succeeded && right * 100 >= all * 95;
            refused += usize::from(passes == 1 && !matched.succeeded);
            identified += usize::from(passes == 5 && is_right);
            wrong += usize::from(matched.succeeded && !is_right);
        }
    }
    println!("one pass refused in {refused} of 5, five passes right in {identified} of 5, wrong {wrong}");
    assert!(refused == 5 && identified >= 4 && wrong == 0);
}

/// CPU time of a process, in ticks.
fn cpu_ticks(pid: u32) -> u64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).expect("it runs");
    let fields = stat.rsplit_once(") ").expect("a name").1.split(' ').skip(11).take(2);
    fields.map(|ticks| ticks.parse::<u64>().expect("a number")).sum()
}

#[tokio::test]
async fn a_match_ends_when_its_client_leaves() {
    let crowd = Crowd { seed: 1, walkers: 60, phones: 60, seconds: 600, lifetime_s: 120.0, swap_s: 1e9 };
    let recorded = crowd.recorded();
    let folder = data_folder();
    let settings = [("SIGHTFIX_LIMITS__MATCH_COMPARISONS", "1000000000")];
    let server = crate::harness::TestServer::start_with(folder.path(), &settings);
    let camera = serde_json::json!({"id": "c", "image_size": {"width_px": 1920, "height_px": 1080}});
    server.post("/v1/cameras", &camera).await.expect(201);
    let part = |name: &str, content: &str| {
        format!(
            "--b\r\ncontent-disposition: form-data; name=\"{name}\"\r\ncontent-type: text/csv\r\n\r\n{content}\r\n"
        )
    };
    let body = part("detections", &recorded.detections) + &part("fixes", &recorded.fixes) + "--b--\r\n";
    let headers = [("content-type", "multipart/form-data; boundary=b")];
    let before = cpu_ticks(server.pid());
    let matching = server.send(
        "POST",
        "/v1/cameras/c/samples/pairings?match=true",
        &headers,
        hyper::body::Bytes::from(body),
    );
    let at_work = async {
        // Reading the files takes less; from then on it is matched.
        while cpu_ticks(server.pid()) < before + 500 {
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    };
    tokio::select! {
        answer = matching => panic!("it must not be done yet: {}", answer.text()),
        () = at_work => {}
    }
    // The client has left; the process comes to rest, which without that takes minutes.
    for _ in 0..60 {
        let ticks = cpu_ticks(server.pid());
        tokio::time::sleep(std::time::Duration::from_secs(1)).await;
        if cpu_ticks(server.pid()) < ticks + 20 {
            return;
        }
    }
    panic!("the match goes on without its client");
}
