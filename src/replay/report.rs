//! The result of a replay: counts and latencies.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::time::Duration;

use serde::Serialize;

use super::fault_injection::FaultCounts;
use super::latency_histogram::LatencyHistogram;
use crate::grpc::client::ClientError;

/// Largest number of reported reasons of cameras that gave up.
const MAX_REASONS: usize = 5;

/// Counts of one simulated camera, or sums over several.
#[derive(Debug, Clone, Default)]
pub(super) struct Counts {
    pub(super) items: u64,
    pub(super) resent: u64,
    pub(super) answered: u64,
    pub(super) refused: BTreeMap<String, u64>,
    pub(super) too_late: u64,
    pub(super) lost_answers: u64,
    pub(super) unanswered: u64,
    pub(super) acknowledged: u64,
    pub(super) unacknowledged: u64,
    pub(super) streams: u64,
    pub(super) reconnects: u64,
    pub(super) reconnect_requests: u64,
    pub(super) redirects: u64,
    pub(super) broken: BTreeMap<String, u64>,
    pub(super) cameras_moved: u64,
    pub(super) model_versions: BTreeSet<u32>,
    pub(super) max_lag: Duration,
    pub(super) latencies: LatencyHistogram,
    pub(super) recoveries: LatencyHistogram,
    pub(super) faults: FaultCounts,
    pub(super) given_up: u64,
    pub(super) reasons: Vec<String>,
}

impl Counts {
    /// Adds the counts of another camera.
    pub(super) fn add(&mut self, other: Self) {
        self.items += other.items;
        self.resent += other.resent;
        self.answered += other.answered;
        add_each(&mut self.refused, other.refused);
        self.too_late += other.too_late;
        self.lost_answers += other.lost_answers;
        self.unanswered += other.unanswered;
        self.acknowledged += other.acknowledged;
        self.unacknowledged += other.unacknowledged;
        self.streams += other.streams;
        self.reconnects += other.reconnects;
        self.reconnect_requests += other.reconnect_requests;
        self.redirects += other.redirects;
        add_each(&mut self.broken, other.broken);
        self.cameras_moved += other.cameras_moved;
        self.model_versions.extend(other.model_versions);
        self.max_lag = self.max_lag.max(other.max_lag);
        self.latencies.add(&other.latencies);
        self.recoveries.add(&other.recoveries);
        self.faults.lost += other.faults.lost;
        self.faults.duplicated += other.faults.duplicated;
        self.faults.reordered += other.faults.reordered;
        self.given_up += other.given_up;
        self.reasons.extend(other.reasons);
        self.reasons.truncate(MAX_REASONS);
    }

    /// Counts a camera that gave up.
    pub(super) fn record_give_up(&mut self, error: &ClientError) {
        self.given_up += 1;
        self.reasons.push(error.to_string());
    }
}

fn add_each(totals: &mut BTreeMap<String, u64>, more: BTreeMap<String, u64>) {
    for (reason, count) in more {
        *totals.entry(reason).or_default() += count;
    }
}

/// Result of a replay. `items` = `answered` + `refused` + `lost_answers` + `unanswered`, and with
/// acknowledgements `items` = `acknowledged` + `unacknowledged`.
#[derive(Debug, Clone, Serialize)]
pub struct ReplayReport {
    /// Number of simulated cameras.
    pub cameras: usize,
    /// Duration of the replay, s.
    pub elapsed_s: f64,
    /// Items sent, each counted once.
    pub items: u64,
    /// Items sent again after a broken connection.
    pub resent: u64,
    /// Items answered, refused ones included, per second.
    pub answers_per_s: f64,
    /// Items accepted by the server.
    pub answered: u64,
    /// Items refused, by reason.
    pub refused: BTreeMap<String, u64>,
    /// Number of these items that are older than what their track takes, so that it did not move.
    pub too_late: u64,
    /// Items whose answer the server dropped because this client read too slowly.
    pub lost_answers: u64,
    /// Items without an answer.
    pub unanswered: u64,
    /// Items acknowledged; `None` if samples are not stored.
    pub acknowledged: Option<u64>,
    /// Items not acknowledged; `None` if samples are not stored.
    pub unacknowledged: Option<u64>,
    /// Latency from sending an item to its answer.
    pub latency_ms: LatencyMs,
    /// Time from the failure of a stream to the next answer or acknowledgement; `None` if none failed.
    pub recovery_ms: Option<LatencyMs>,
    /// Largest lag of sending, compared with the pace, ms.
    pub furthest_behind_ms: f64,
    /// Number of streams opened.
    pub streams: u64,
    /// Streams opened after a camera's first.
    pub reconnects: u64,
    /// Requests of the server to reconnect.
    pub invitations: u64,
    /// Streams that another node of the server was named for.
    pub redirects: u64,
    /// Streams that failed or could not be opened, by reason.
    pub broken: BTreeMap<String, u64>,
    /// Alarms that a camera has moved.
    pub cameras_moved: u64,
    /// Model versions that answered.
    pub model_versions: BTreeSet<u32>,
    /// Numbers of injected faults.
    pub injected: Injected,
    /// Cameras that gave up before everything was sent.
    pub given_up: u64,
    /// Errors of the first of them.
    pub reasons: Vec<String>,
}

/// Quantiles of the latency in ms, at most 1 % above the true ones.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct LatencyMs {
    pub p50: f64,
    /// 90 % quantile.
    pub p90: f64,
    /// 99 % quantile.
    pub p99: f64,
    /// The maximum; exact.
    pub max: f64,
}

impl LatencyMs {
    fn of(latencies: &LatencyHistogram) -> Self {
        let quantile = |share| ms(latencies.quantile(share));
        Self { p50: quantile(0.5), p90: quantile(0.9), p99: quantile(0.99), max: ms(latencies.max()) }
    }
}

const fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

/// Number of injected faults.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Injected {
    /// Items not sent.
    pub lost: u64,
    /// Items sent twice.
    pub duplicated: u64,
    /// Items sent late.
    pub reordered: u64,
}

impl ReplayReport {
    pub(super) fn new(counts: Counts, cameras: usize, elapsed: Duration, must_acknowledge: bool) -> Self {
        let refused: u64 = counts.refused.values().sum();
        let elapsed_s = elapsed.as_secs_f64();
        Self {
            cameras,
            elapsed_s,
            items: counts.items,
            resent: counts.resent,
            answers_per_s: (counts.answered + refused) as f64 / elapsed_s.max(1e-9),
            answered: counts.answered,
            too_late: counts.too_late,
            lost_answers: counts.lost_answers,
            unanswered: counts.unanswered,
            acknowledged: must_acknowledge.then_some(counts.acknowledged),
            unacknowledged: must_acknowledge.then_some(counts.unacknowledged),
            latency_ms: LatencyMs::of(&counts.latencies),
            recovery_ms: (!counts.recoveries.is_empty()).then(|| LatencyMs::of(&counts.recoveries)),
            furthest_behind_ms: ms(counts.max_lag),
            streams: counts.streams,
            reconnects: counts.reconnects,
            invitations: counts.reconnect_requests,
            redirects: counts.redirects,
            cameras_moved: counts.cameras_moved,
            injected: Injected {
                lost: counts.faults.lost,
                duplicated: counts.faults.duplicated,
                reordered: counts.faults.reordered,
            },
            given_up: counts.given_up,
            refused: counts.refused,
            broken: counts.broken,
            model_versions: counts.model_versions,
            reasons: counts.reasons,
        }
    }

    /// True if every item was answered (or its answer was dropped) and acknowledged.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.unanswered == 0 && self.unacknowledged.unwrap_or(0) == 0 && self.given_up == 0
    }
}

impl fmt::Display for ReplayReport {
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
        if self.too_late > 0 {
            writeln!(
                out,
                "too late for their track {}: the server has later items of these targets; --shift-to-now replays a \
                 recording as if it were of now",
                self.too_late
            )?;
        }
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
            "streams {}, reconnects {}, requested by the server {}, items sent again {resent}",
            self.streams, self.reconnects, self.invitations
        )?;
        if self.redirects > 0 {
            writeln!(out, "redirected to other nodes {}", self.redirects)?;
        }
        each(out, "broken", &self.broken)?;
        if let Some(LatencyMs { p50, p99, max, .. }) = self.recovery_ms {
            writeln!(out, "failure to answer: p50 {p50:.0} ms, p99 {p99:.0} ms, max {max:.0} ms")?;
        }
        let Injected { lost, duplicated, reordered } = self.injected;
        if lost + duplicated + reordered > 0 {
            writeln!(out, "injected faults: lost {lost}, duplicated {duplicated}, reordered {reordered}")?;
        }
        if self.cameras_moved > 0 {
            writeln!(out, "camera-moved alarms: {}", self.cameras_moved)?;
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
