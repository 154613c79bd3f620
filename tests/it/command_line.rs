//! The command line as shells and scripts use it: pipes, compression, summaries, completions, manual pages.

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::process::{Output, Stdio};

use serde_json::Value;

use crate::harness::{data_folder, run, sightfix};

/// Runs the binary with a text on its standard input.
fn piped(arguments: &[&str], input: &[u8]) -> Output {
    let mut process = sightfix()
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("started");
    let mut stdin = process.stdin.take().expect("piped");
    let input = input.to_vec();
    let writing = std::thread::spawn(move || stdin.write_all(&input));
    let output = process.wait_with_output().expect("ended");
    // A command that refuses its flags reads nothing.
    let _ = writing.join().expect("no panic");
    output
}

#[track_caller]
fn succeeded(output: Output) -> (String, String) {
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    let (out, error) = (text(output.stdout), text(output.stderr));
    assert!(output.status.success(), "{error}");
    (out, error)
}

fn path(folder: &Path, name: &str) -> String {
    folder.join(name).to_string_lossy().into_owned()
}

const DEMO_MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/demo-square.safetensors");
const HEADER: &str = "time,target_id,left,top,width,height,longitude,latitude\n";

/// Boxes of the square.
fn observations(rows: usize) -> String {
    let row = |at: usize| {
        format!("2026-01-01T00:00:{:02}Z,a,{},{},40,110,,\n", at % 60, 300 + at % 100, 300 + at % 50)
    };
    HEADER.to_owned() + &(0..rows).map(row).collect::<String>()
}

#[test]
fn a_dash_is_standard_input_and_output() {
    let fuse = ["fuse", "-", "--model", DEMO_MODEL, "--out", "-"];
    let (rows, summary) = succeeded(piped(&fuse, observations(3).as_bytes()));
    assert_eq!(rows.lines().count(), 4, "the header and three rows, nothing else: {rows}");
    assert_eq!(summary.trim(), "answered 3, rejected 0", "the summary is on standard error");

    let as_ndjson = [&fuse[..], &["--out-format", "ndjson", "--json"]].concat();
    let (rows, summary) = succeeded(piped(&as_ndjson, observations(2).as_bytes()));
    assert!(rows.lines().all(|row| serde_json::from_str::<Value>(row).expect("JSON").is_object()), "{rows}");
    let summary: Value = serde_json::from_str(&summary).expect("JSON");
    assert_eq!(summary["answered"], 2);

    let folder = data_folder();
    let data = path(folder.path(), "data");
    let (samples, _) = succeeded(piped(&["simulate", "square", "--samples", "50", "--out", "-"], b""));
    let import = ["import", "-", "--camera", "c", "--create", "--data", &data, "--json"];
    let (report, _) = succeeded(piped(&import, samples.as_bytes()));
    let report: Value = serde_json::from_str(&report).expect("JSON");
    assert_eq!((&report["accepted"], &report["rejected"]), (&50.into(), &0.into()));
}

#[test]
fn endings_mean_what_they_say() {
    let folder = data_folder();
    let file = |name: &str| path(folder.path(), name);
    for name in ["a.csv", "a.csv.gz", "a.csv.zst", "a.ndjson", "a.ndjson.gz", "a.json"] {
        run(&["simulate", "square", "--samples", "40", "--out", &file(name)]);
        let first = std::fs::read(file(name)).expect("written")[..2].to_vec();
        let expected: &[u8] = match name.rsplit('.').next().expect("an ending") {
            "gz" => &[0x1f, 0x8b],
            "zst" => &[0x28, 0xb5],
            "csv" => b"ti",
            "ndjson" => b"{\"",
            _ => b"[{",
        };
        if name != "a.json" && name != "a.csv" {
            assert_eq!(first, expected, "{name}");
        }
        let data = file(&format!("data-{name}"));
        let report = run(&["import", &file(name), "--camera", "c", "--create", "--data", &data, "--json"]);
        let report: Value = serde_json::from_str(&report).expect("JSON");
        assert_eq!(report["accepted"], 40, "{name}: {report}");
    }
    for (name, reason) in [("a.txt", "extension"), ("a.gz", "extension")] {
        let refused = piped(&["simulate", "square", "--out", &file(name)], b"");
        assert!(!refused.status.success(), "{name}");
        assert!(String::from_utf8_lossy(&refused.stderr).contains(reason), "{name}");
        assert!(!Path::new(&file(name)).exists(), "{name} is not written");
    }
}

#[test]
fn values_may_begin_with_a_minus() {
    let folder = data_folder();
    let (train, test) = (path(folder.path(), "train.csv"), path(folder.path(), "test.csv"));
    run(&["simulate", "square", "--samples", "300", "--out", &train, "--test-out", &test]);
    let evaluate = ["evaluate", "--train", &train, "--test", &test, "--methods", "gnss"];
    let (report, _) =
        succeeded(piped(&[&evaluate[..], &["--truth-point", "-74.0,40.7", "--json", "-"]].concat(), b""));
    let report: Value = serde_json::from_str(&report).expect("the document and nothing else");
    assert!(
        report["methods"]["gnss"]["mean_m"].as_f64().expect("a figure") > 1e6,
        "New York is far from there"
    );
}

#[test]
fn a_reader_that_goes_ends_a_command_quietly() {
    let fuse = ["fuse", "-", "--model", DEMO_MODEL, "--out", "-"];
    for arguments in [&fuse[..], &["openapi"], &["completions", "bash"], &["man"]] {
        let mut process = sightfix()
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("started");
        drop(process.stdout.take());
        let mut stdin = process.stdin.take().expect("piped");
        let _ = stdin.write_all(observations(2_000).as_bytes());
        drop(stdin);
        let output = process.wait_with_output().expect("ended");
        let error = String::from_utf8(output.stderr).expect("UTF-8");
        assert!(output.status.success(), "{arguments:?}: {:?} {error}", output.status);
        assert_eq!(error, "", "{arguments:?}");
    }
}

#[test]
fn a_full_device_is_an_error_and_no_panic() {
    let full = || File::options().write(true).open("/dev/full").expect("Linux");
    let data = observations(2_000);
    let fuse = ["fuse", "-", "--model", DEMO_MODEL, "--out", "-"];
    for arguments in [&fuse[..], &["openapi"], &["completions", "zsh"], &["man"]] {
        let mut process = sightfix()
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(full())
            .stderr(Stdio::piped())
            .spawn()
            .expect("started");
        let _ = process.stdin.take().expect("piped").write_all(data.as_bytes());
        let output = process.wait_with_output().expect("ended");
        let error = String::from_utf8(output.stderr).expect("UTF-8");
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {error}");
        assert_eq!(error.lines().count(), 1, "{arguments:?}: {error}");
        assert!(error.starts_with("error: ") && error.contains("No space left"), "{error}");
    }
    let folder = data_folder();
    let rows = path(folder.path(), "rows.csv");
    std::fs::write(&rows, data).expect("written");
    let output =
        piped(&["fuse", &rows, "--model", DEMO_MODEL, "--out", "/dev/full", "--out-format", "csv"], b"");
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("/dev/full"), "the error names the file");
}

#[test]
fn quiet_commands_print_results_and_errors_alone() {
    let folder = data_folder();
    let data = path(folder.path(), "data");
    let csv = path(folder.path(), "a.csv");
    run(&["simulate", "square", "--samples", "200", "--out", &csv]);
    let import = ["import", &csv, "--camera", "c", "--create", "--data", &data];
    let (report, notes) = succeeded(piped(&[&import[..], &["--quiet"]].concat(), b""));
    assert!(report.starts_with("accepted 200"), "{report}");
    assert_eq!(notes, "");
    let train = ["train", "--camera", "c", "--recipe", "projective", "--epochs", "5", "--data", &data];
    let (_, notes) = succeeded(piped(&train, b""));
    assert!(!notes.is_empty() && !notes.contains("0/0"), "{notes}");
    let (trained, notes) = succeeded(piped(&[&train[..], &["-q", "--json"]].concat(), b""));
    assert_eq!(notes, "");
    let trained: Value = serde_json::from_str(&trained).expect("JSON");
    assert_eq!(trained["model_version"], 2, "{trained}");
    let failed = piped(&["train", "--camera", "none", "--data", &data, "--quiet"], b"");
    assert_eq!(failed.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&failed.stderr).starts_with("error: "));
}

#[test]
fn the_environment_is_named_in_the_help_and_is_read() {
    let help = run(&["serve", "--help"]);
    for name in ["SIGHTFIX_LISTEN", "SIGHTFIX_DATA"] {
        assert!(help.contains(&format!("[env: {name}]")), "{help}");
    }
    assert!(run(&["--help"]).contains("SIGHTFIX_LIMITS__BODY_BYTES"));
    let printed = sightfix()
        .arg("config")
        .env("SIGHTFIX_LISTEN", "127.0.0.1:9")
        .env("SIGHTFIX_DATA", "/elsewhere")
        .env("SIGHTFIX_LIMITS__BODY_BYTES", "123456")
        .env("SIGHTFIX_LOG_FORMAT", "json")
        .output()
        .expect("ended");
    let (settings, _) = succeeded(printed);
    for value in ["127.0.0.1:9", "/elsewhere", "123456", "json"] {
        assert!(settings.contains(value), "{settings}");
    }
}

#[test]
fn completions_and_manual_pages_name_every_subcommand() {
    let help = run(&["--help"]);
    let listed =
        help.split("Commands:").nth(1).and_then(|text| text.split("Options:").next()).expect("a list");
    let commands: Vec<&str> = listed
        .lines()
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .collect();
    assert!(commands.len() >= 18, "{commands:?}");
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let script = run(&["completions", shell]);
        assert!(commands.iter().all(|command| script.contains(command)), "{shell}");
    }
    let folder = data_folder();
    run(&["man", "--out", folder.path().to_str().expect("UTF-8")]);
    for command in commands {
        let page =
            std::fs::read_to_string(folder.path().join(format!("sightfix-{command}.1"))).expect("a page");
        assert!(page.contains(".SH SYNOPSIS"), "{command}");
    }
    let mut script = String::new();
    let bash =
        std::process::Command::new("bash").args(["-n"]).stdin(Stdio::piped()).stderr(Stdio::piped()).spawn();
    if let Ok(mut bash) = bash {
        script.push_str(&run(&["completions", "bash"]));
        bash.stdin.take().expect("piped").write_all(script.as_bytes()).expect("read");
        let mut error = String::new();
        bash.stderr.take().expect("piped").read_to_string(&mut error).expect("UTF-8");
        assert!(bash.wait().expect("ended").success(), "{error}");
    }
}

#[test]
fn only_one_file_can_be_standard_input() {
    let refused = piped(&["pair", "--detections", "-", "--fixes", "-", "--out", "-"], b"");
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("only one of"));
}

#[test]
fn pair_replaces_a_file_only_when_told() {
    let folder = data_folder();
    let file = |name: &str| path(folder.path(), name);
    let (boxes, fixes) = (file("boxes.csv"), file("fixes.csv"));
    std::fs::write(&boxes, "time,target_id,left,top,width,height\n2026-01-01T00:00:00Z,a,1,2,30,40\n")
        .expect("written");
    std::fs::write(&fixes, "time,longitude,latitude\n2026-01-01T00:00:00Z,11,48\n").expect("written");
    let before = std::fs::read(&boxes).expect("a file");
    let pair = |out: &str, flags: &[&str]| {
        let files = ["pair", "--detections", &boxes, "--fixes", &fixes, "--out", out];
        piped(&[&files[..], flags].concat(), b"")
    };
    let refused = pair(&boxes, &[]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("exists"));
    assert_eq!(std::fs::read(&boxes).expect("a file"), before);
    succeeded(pair(&file("samples.csv"), &[]));
    succeeded(pair(&file("samples.csv"), &["--overwrite"]));
}

#[test]
fn an_import_of_too_many_bad_rows_is_told_from_a_success() {
    let folder = data_folder();
    let (data, csv) = (path(folder.path(), "data"), path(folder.path(), "rows.csv"));
    let row = |at: usize| {
        format!("2026-01-01 10:00:{:02}{},a,1,2,30,40,11,48\n", at, if at < 24 { "" } else { "Z" })
    };
    std::fs::write(&csv, HEADER.to_owned() + &(0..60).map(row).collect::<String>()).expect("written");
    let import = |flags: &[&str]| {
        let arguments = ["import", &csv, "--data", &data, "--camera", "c", "--create"];
        piped(&[&arguments[..], flags].concat(), b"")
    };
    let rejected = import(&[]);
    assert_eq!(rejected.status.code(), Some(5));
    let told = String::from_utf8_lossy(&rejected.stderr).into_owned();
    assert!(told.contains("24 of 60 rows (40 %) were rejected"), "{told}");
    succeeded(import(&["--max-rejected", "0.5"]));
    // The times without an offset are those of a zone.
    let (summary, _) = succeeded(import(&["--timezone", "Europe/Berlin"]));
    assert!(summary.contains("accepted 24 (without a fix 0), duplicate 36, rejected 0"), "{summary}");
    let refused = import(&["--timezone", "Mars/Olympus"]);
    assert_eq!(refused.status.code(), Some(2));
    let unknown = piped(&["import", "-", "--data", &data, "--camera", "c"], b"Zeit;left\n1;2\n");
    assert!(String::from_utf8_lossy(&unknown.stderr).contains("with `columns` as `auto`"));
}
