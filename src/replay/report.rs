//! What came of a replay, in numbers that add up.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::time::Duration;

use serde::Serialize;

use super::faults::FaultCounts;
use super::latency::Latencies;
use crate::grpc::client::ClientError;

/// Reasons of cameras that gave up, told in full.
const MOST_REASONS: usize = 5;

/// What was counted, by one camera or by all.
#[derive(Debug, Clone, Default)]
pub struct Tally {
    pub(super) items: u64,
    pub(super) resent: u64,
    pub(super) answered: u64,
    pub(super) refused: BTreeMap<String, u64>,
    pub(super) lost_answers: u64,
    pub(super) unanswered: u64,
    pub(super) acknowledged: u64,
    pub(super) unacknowledged: u64,
    pub(super) streams: u64,
    pub(super) reconnects: u64,
    pub(super) invitations: u64,
    pub(super) broken: BTreeMap<String, u64>,
    pub(super) cameras_moved: u64,
    pub(super) model_versions: BTreeSet<u32>,
    pub(super) furthest_behind: Duration,
    pub(super) latencies: Latencies,
    pub(super) faults: FaultCounts,
    pub(super) given_up: u64,
    pub(super) reasons: Vec<String>,
}

impl Tally {
    /// Takes in another's counts.
    pub(super) fn add(&mut self, other: Self) {
        self.items += other.items;
        self.resent += other.resent;
        self.answered += other.answered;
        add_each(&mut self.refused, other.refused);
        self.lost_answers += other.lost_answers;
        self.unanswered += other.unanswered;
        self.acknowledged += other.acknowledged;
        self.unacknowledged += other.unacknowledged;
        self.streams += other.streams;
        self.reconnects += other.reconnects;
        self.invitations += other.invitations;
        add_each(&mut self.broken, other.broken);
        self.cameras_moved += other.cameras_moved;
        self.model_versions.extend(other.model_versions);
        self.furthest_behind = self.furthest_behind.max(other.furthest_behind);
        self.latencies.add(&other.latencies);
        self.faults.lost += other.faults.lost;
        self.faults.duplicated += other.faults.duplicated;
        self.faults.reordered += other.faults.reordered;
        self.given_up += other.given_up;
        self.reasons.extend(other.reasons);
        self.reasons.truncate(MOST_REASONS);
    }

    /// A camera gives up.
    pub(super) fn give_up(&mut self, why: &ClientError) {
        self.given_up += 1;
        self.reasons.push(why.to_string());
    }
}

fn add_each(counts: &mut BTreeMap<String, u64>, more: BTreeMap<String, u64>) {
    for (reason, count) in more {
        *counts.entry(reason).or_default() += count;
    }
}

/// What came of a replay. `items` = `answered` + `refused` + `lost_answers` + `unanswered`, and with
/// acknowledgements `items` = `acknowledged` + `unacknowledged`.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// Simulated cameras.
    pub cameras: usize,
    /// From the first to the last, seconds.
    pub elapsed_s: f64,
    /// Items sent, each counted once.
    pub items: u64,
    /// Items sent again after a broken line.
    pub resent: u64,
    /// Items answered, refused ones included, per second.
    pub answers_per_s: f64,
    /// Items taken by the server.
    pub answered: u64,
    /// Items not taken, by reason.
    pub refused: BTreeMap<String, u64>,
    /// Items whose answer the server dropped because this reader was too slow.
    pub lost_answers: u64,
    /// Items that were never answered.
    pub unanswered: u64,
    /// Items acknowledged; `None` if nothing was to be kept.
    pub acknowledged: Option<u64>,
    /// Items not acknowledged; `None` if nothing was to be kept.
    pub unacknowledged: Option<u64>,
    /// From sending an item to its answer.
    pub latency_ms: LatencyMs,
    /// Farthest that sending fell behind the pace, milliseconds.
    pub furthest_behind_ms: f64,
    /// Streams opened.
    pub streams: u64,
    /// Streams opened after a camera's first.
    pub reconnects: u64,
    /// Invitations of the server to open another stream.
    pub invitations: u64,
    /// Streams that broke or were not opened, by reason.
    pub broken: BTreeMap<String, u64>,
    /// Alarms that a camera was moved.
    pub cameras_moved: u64,
    /// Model versions that answered.
    pub model_versions: BTreeSet<u32>,
    /// Faults that were made on purpose.
    pub injected: Injected,
    /// Cameras that gave up before all was sent.
    pub given_up: u64,
    /// Why the first of them did.
    pub reasons: Vec<String>,
}

/// Times from sending to answer, milliseconds; at most 1/32 above the true percentile.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct LatencyMs {
    /// Half of all are shorter.
    pub p50: f64,
    /// One in ten is longer.
    pub p90: f64,
    /// One in a hundred is longer.
    pub p99: f64,
    /// The longest.
    pub max: f64,
}

/// Faults that were made on purpose.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Injected {
    /// Items not sent.
    pub lost: u64,
    /// Items sent twice.
    pub duplicated: u64,
    /// Items sent late.
    pub reordered: u64,
}

impl Report {
    pub(super) fn new(tally: Tally, cameras: usize, elapsed: Duration, must_acknowledge: bool) -> Self {
        let ms = |duration: Duration| duration.as_secs_f64() * 1e3;
        let percentile = |share| ms(tally.latencies.percentile(share));
        let refused: u64 = tally.refused.values().sum();
        let elapsed_s = elapsed.as_secs_f64();
        Self {
            cameras,
            elapsed_s,
            items: tally.items,
            resent: tally.resent,
            answers_per_s: (tally.answered + refused) as f64 / elapsed_s.max(1e-9),
            answered: tally.answered,
            lost_answers: tally.lost_answers,
            unanswered: tally.unanswered,
            acknowledged: must_acknowledge.then_some(tally.acknowledged),
            unacknowledged: must_acknowledge.then_some(tally.unacknowledged),
            latency_ms: LatencyMs {
                p50: percentile(0.5),
                p90: percentile(0.9),
                p99: percentile(0.99),
                max: ms(tally.latencies.longest()),
            },
            furthest_behind_ms: ms(tally.furthest_behind),
            streams: tally.streams,
            reconnects: tally.reconnects,
            invitations: tally.invitations,
            cameras_moved: tally.cameras_moved,
            injected: Injected {
                lost: tally.faults.lost,
                duplicated: tally.faults.duplicated,
                reordered: tally.faults.reordered,
            },
            given_up: tally.given_up,
            refused: tally.refused,
            broken: tally.broken,
            model_versions: tally.model_versions,
            reasons: tally.reasons,
        }
    }

    /// Whether every item was answered (or its answer lost by this reader) and acknowledged.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.unanswered == 0 && self.unacknowledged.unwrap_or(0) == 0 && self.given_up == 0
    }
}

impl fmt::Display for Report {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cameras, elapsed_s, items, resent, answers_per_s, .. } = self;
        writeln!(
            out,
            "items {items}, cameras {cameras}, {elapsed_s:.1} s, {answers_per_s:.0} answers a second"
        )?;
        let refused: u64 = self.refused.values().sum();
        writeln!(
            out,
            "answered {}, refused {refused}, lost answers {}, unanswered {}",
            self.answered, self.lost_answers, self.unanswered
        )?;
        each(out, "refused", &self.refused)?;
        if let (Some(acknowledged), Some(unacknowledged)) = (self.acknowledged, self.unacknowledged) {
            writeln!(out, "acknowledged {acknowledged}, unacknowledged {unacknowledged}")?;
        }
        let LatencyMs { p50, p90, p99, max } = self.latency_ms;
        writeln!(out, "send to answer: p50 {p50:.2} ms, p90 {p90:.2} ms, p99 {p99:.2} ms, max {max:.2} ms")?;
        if self.furthest_behind_ms > 0.0 {
            writeln!(out, "at most {:.1} ms behind the pace", self.furthest_behind_ms)?;
        }
        writeln!(
            out,
            "streams {}, reconnects {}, by invitation {}, items sent again {resent}",
            self.streams, self.reconnects, self.invitations
        )?;
        each(out, "broken", &self.broken)?;
        let Injected { lost, duplicated, reordered } = self.injected;
        if lost + duplicated + reordered > 0 {
            writeln!(out, "on purpose: lost {lost}, duplicated {duplicated}, reordered {reordered}")?;
        }
        if self.cameras_moved > 0 {
            writeln!(out, "alarms of a moved camera: {}", self.cameras_moved)?;
        }
        if self.given_up > 0 {
            writeln!(out, "cameras that gave up: {}", self.given_up)?;
            self.reasons.iter().try_for_each(|reason| writeln!(out, "  {reason}"))?;
        }
        Ok(())
    }
}

fn each(out: &mut fmt::Formatter<'_>, what: &str, counts: &BTreeMap<String, u64>) -> fmt::Result {
    counts.iter().try_for_each(|(reason, count)| writeln!(out, "  {what}: {reason} {count}"))
}
