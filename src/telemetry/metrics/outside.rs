//! Metrics of connections with other systems, a series for each: written anew every time, so that one that was deleted
//! leaves none.

use std::fmt::Write as _;

/// The figures of one connection on this node.
#[derive(Debug, Clone, PartialEq)]
pub struct OutsideFigures {
    /// Its id: letters, digits and hyphens.
    pub id: String,
    /// Name of its state.
    pub state: &'static str,
    /// Messages that came, or were delivered.
    pub messages: u64,
    /// Boxes and fixes that were taken, or positions that were queued.
    pub items: u64,
    /// Boxes, fixes and parts of messages that were not taken.
    pub skipped: u64,
    /// Messages that could not be read, or that the receiver refused.
    pub rejected: u64,
    /// Positions that were dropped, and messages that were dropped unread.
    pub dropped: u64,
    /// Number of items that wait to be stored, or for their receiver.
    pub queued: u64,
    /// Messages that are not tried any more.
    pub dead_letters: u64,
    /// Age of the last item when it came, s; of the oldest waiting message of a sink.
    pub lag_s: Option<f64>,
}

type Value = fn(&OutsideFigures) -> Option<f64>;

/// Name, kind and description of each metric, and its value.
const METRICS: [(&str, &str, &str, Value); 8] = [
    ("messages_total", "counter", "Messages that came, or were delivered", |own| Some(own.messages as f64)),
    ("items_total", "counter", "Boxes and fixes taken, or positions queued", |own| Some(own.items as f64)),
    ("skipped_total", "counter", "Parts of messages that were not taken", |own| Some(own.skipped as f64)),
    ("rejected_total", "counter", "Messages that could not be read, or were refused", |own| {
        Some(own.rejected as f64)
    }),
    ("dropped_total", "counter", "Positions or messages that were dropped", |own| Some(own.dropped as f64)),
    ("queued", "gauge", "Items that wait to be stored, or messages that wait for their receiver", |own| {
        Some(own.queued as f64)
    }),
    ("dead_letters", "gauge", "Messages that are not tried any more", |own| Some(own.dead_letters as f64)),
    ("lag_seconds", "gauge", "Age of the last item, or of the oldest waiting message", |own| own.lag_s),
];

/// The metrics in Prometheus' text format.
pub(super) fn rendered(connections: &[OutsideFigures]) -> String {
    let mut text = String::new();
    let head = |text: &mut String, name: &str, kind: &str, help: &str| {
        let _ = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
    };
    let name = "sightfix_outside_connection_state";
    head(&mut text, name, "gauge", "1 for the state of a connection with another system");
    for OutsideFigures { id, state, .. } in connections {
        let _ = writeln!(text, "{name}{{connection=\"{id}\",state=\"{state}\"}} 1");
    }
    for (name, kind, help, value) in METRICS {
        let name = format!("sightfix_outside_connection_{name}");
        head(&mut text, &name, kind, help);
        for own in connections {
            if let Some(value) = value(own) {
                let _ = writeln!(text, "{name}{{connection=\"{}\"}} {value}", own.id);
            }
        }
    }
    text
}
