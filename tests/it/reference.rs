//! The pages of docs/reference that the code writes. `UPDATE_REFERENCE=1 cargo test reference` writes them again.

use std::fmt::Write as _;
use std::path::Path;
use std::time::Duration;

use serde_json::Value;
use sightfix::config::{Config, Console, Limits, OpenIdSettings, TlsSettings, Workers};
use sightfix::telemetry::{Metrics, OTHER_RPC, Route};
use utoipa::PartialSchema;

/// What comes after this line of a page is written by the code.
const MARK: &str = "<!-- written by `UPDATE_REFERENCE=1 cargo test reference` -->\n";

fn assert_current(page: &str, written: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/reference").join(page);
    let text = std::fs::read_to_string(&path).expect("the page is there");
    let (head, committed) = text.split_once(MARK).expect("the page has the mark");
    if std::env::var_os("UPDATE_REFERENCE").is_some() {
        std::fs::write(&path, format!("{head}{MARK}{written}")).expect("the page can be written");
    } else {
        assert_eq!(committed, written, "{page} is not current: UPDATE_REFERENCE=1 cargo test reference");
    }
}

fn json_of(value: &impl serde::Serialize) -> Value {
    serde_json::to_value(value).expect("JSON")
}

/// Rows of a section's settings in the order of their names: name, default, meaning.
fn rows<T: PartialSchema>(section: &str, defaults: &Value) -> String {
    let schema = json_of(&T::schema());
    let mut rows = String::new();
    for (name, property) in schema["properties"].as_object().expect("an object") {
        let default = match &defaults[name] {
            // A section of its own.
            Value::Object(_) => continue,
            Value::Null => "none".to_owned(),
            default => format!("`{default}`"),
        };
        let meaning = property["description"].as_str().unwrap_or_default().replace('\n', " ");
        assert!(!meaning.is_empty(), "{section}{name} has no description");
        writeln!(rows, "| `{section}{name}` | {default} | {meaning} |").expect("text");
    }
    rows
}

#[test]
fn the_page_of_settings_is_current() {
    let defaults = json_of(&Config::default());
    let sections = [
        ("At the top", rows::<Config>("", &defaults)),
        ("TLS", rows::<TlsSettings>("tls.", &defaults["tls"])),
        ("OpenID Connect", rows::<OpenIdSettings>("openid.", &defaults["openid"])),
        ("Training", rows::<Workers>("training.", &defaults["training"])),
        ("Evaluation", rows::<Workers>("evaluation.", &defaults["evaluation"])),
        ("Console", rows::<Console>("console.", &defaults["console"])),
        ("Limits", rows::<Limits>("limits.", &defaults["limits"])),
    ];
    let mut page = String::new();
    for (title, rows) in sections {
        write!(page, "\n## {title}\n\n| setting | default | meaning |\n|---|---|---|\n{rows}").expect("text");
    }
    assert_current("settings.md", &page);
}

#[test]
fn the_page_of_metrics_is_current() {
    let metrics = Metrics::new();
    // Those of routes and RPCs begin with their first request.
    metrics.answered(Route::OTHER, 200, Duration::ZERO);
    metrics.call(OTHER_RPC).answered(Duration::ZERO);
    let text = metrics.render();
    let mut named: Vec<(&str, &str, &str, String)> = text
        .lines()
        .filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '))
        .map(|(name, kind)| {
            let help = text.lines().find_map(|line| line.strip_prefix(&*format!("# HELP {name} ")));
            (name, kind, help.expect("a description"), labels_of(name, &text))
        })
        .collect();
    named.sort_unstable();
    let mut page = "\n| metric | kind | labels | meaning |\n|---|---|---|---|\n".to_owned();
    for (name, kind, help, labels) in named {
        writeln!(page, "| `{name}` | {kind} | {labels} | {help} |").expect("text");
    }
    assert_current("metrics.md", &page);
}

/// Names of the labels of a metric's first series, but those of its buckets.
fn labels_of(name: &str, text: &str) -> String {
    let is_own = |rest: &str| ["{", "_bucket{"].iter().any(|start| rest.starts_with(start));
    let series = text.lines().find_map(|line| line.strip_prefix(name).filter(|rest| is_own(rest)));
    let labels =
        series.and_then(|rest| Some(rest.split_once('{')?.1.rsplit_once('}')?.0)).unwrap_or_default();
    let names = labels.split(',').filter_map(|label| Some(label.split_once('=')?.0));
    names.filter(|name| *name != "le").map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
}
