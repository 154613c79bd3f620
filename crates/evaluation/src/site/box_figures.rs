//! Identity by boxes: whether each box is on the track of its target, whatever the positions are.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::Serialize;

use crate::fusion::world::WorldTrackId;
use crate::fusion::world::assignment::{Candidate, assign};

/// A camera that has not seen a target for longer than this sees it for the first time again, s.
const UNSEEN_S: f64 = 2.0;
/// Time after the first box in the new camera at which a hand-over is judged, s.
const JUDGED_AFTER_S: f64 = 2.0;

/// One box with its target and the track that it was assigned to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoxRecord {
    /// Index of the camera.
    pub camera: usize,
    /// The instant of the box.
    pub time: Timestamp,
    /// Number of the target, or of its visit; `None` for a false detection.
    pub target: Option<usize>,
    /// The track; `None` for a box that was not processed.
    pub track: Option<WorldTrackId>,
}

/// Figures of the identity of boxes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BoxFigures {
    /// Identity F1 by boxes: `2 IDTP / (boxes of targets + boxes of tracks)`, with the assignment of targets to
    /// tracks that has most boxes in common (Ristani et al. 2016).
    pub identity_f1: f64,
    /// Association precision: mean over the boxes of targets of the share of their track's boxes that are of the
    /// same target (Luiten et al. 2021).
    pub association_precision: f64,
    /// Association recall: mean over the same boxes of the share of their target's boxes that are on the same
    /// track.
    pub association_recall: f64,
    /// Share of the hand-overs after which both cameras' boxes of the target are on one track.
    pub handover_rate: Option<f64>,
    /// Number of hand-overs.
    pub handovers: usize,
}

impl BoxFigures {
    /// Figures of all boxes of all cameras.
    #[must_use]
    pub fn of(records: &[BoxRecord]) -> Self {
        let mut common: BTreeMap<(usize, WorldTrackId), usize> = BTreeMap::new();
        let mut of_target: BTreeMap<usize, usize> = BTreeMap::new();
        let mut of_track: BTreeMap<WorldTrackId, usize> = BTreeMap::new();
        for record in records {
            if let Some(target) = record.target {
                *of_target.entry(target).or_default() += 1;
            }
            if let Some(track) = record.track {
                *of_track.entry(track).or_default() += 1;
            }
            if let (Some(target), Some(track)) = (record.target, record.track) {
                *common.entry((target, track)).or_default() += 1;
            }
        }
        let all: usize = of_target.values().sum::<usize>() + of_track.values().sum::<usize>();
        let matched: usize = common.values().sum();
        let mean = |share: &dyn Fn(&(usize, WorldTrackId), usize) -> f64| {
            let sum: f64 = common.iter().map(|(pair, &count)| count as f64 * share(pair, count)).sum();
            sum / matched.max(1) as f64
        };
        let judged = handovers(records);
        let kept = judged.iter().filter(|kept| **kept).count();
        Self {
            identity_f1: 2.0 * best_common(&common) as f64 / all.max(1) as f64,
            association_precision: mean(&|(_, track), count| count as f64 / of_track[track] as f64),
            association_recall: mean(&|(target, _), count| count as f64 / of_target[target] as f64),
            handover_rate: (!judged.is_empty()).then(|| kept as f64 / judged.len() as f64),
            handovers: judged.len(),
        }
    }
}

/// Most rows in common that an assignment of targets to tracks can have.
pub(super) fn best_common(common: &BTreeMap<(usize, WorldTrackId), usize>) -> usize {
    let mut targets: Vec<usize> = common.keys().map(|(target, _)| *target).collect();
    targets.dedup();
    let mut tracks: Vec<WorldTrackId> = common.keys().map(|(_, track)| *track).collect();
    tracks.sort_unstable();
    tracks.dedup();
    let candidates: Vec<Candidate> = common
        .iter()
        .map(|((target, track), &count)| Candidate {
            row: targets.partition_point(|it| it < target),
            column: tracks.partition_point(|it| it < track),
            cost: -(count as f64),
        })
        .collect();
    let assigned = assign(targets.len(), &candidates, 0.0);
    candidates
        .iter()
        .filter(|candidate| assigned[candidate.row] == Some(candidate.column))
        .map(|candidate| (-candidate.cost).round() as usize)
        .sum()
}

/// For each first box of a target in a camera while or shortly after another camera saw it: whether, two seconds
/// later, its latest boxes in both cameras are on one track.
fn handovers(records: &[BoxRecord]) -> Vec<bool> {
    let mut by_target: BTreeMap<usize, Vec<&BoxRecord>> = BTreeMap::new();
    for record in records {
        if let Some(target) = record.target {
            by_target.entry(target).or_default().push(record);
        }
    }
    let mut judged = Vec::new();
    for own in by_target.values_mut() {
        own.sort_by_key(|record| (record.time, record.camera));
        for (index, record) in own.iter().enumerate() {
            let before = own[..index].iter().rev();
            let recent = |other: &&&BoxRecord| seconds(other.time, record.time) <= UNSEEN_S;
            if before.clone().take_while(recent).any(|other| other.camera == record.camera) {
                continue;
            }
            let Some(from) = before.clone().take_while(recent).map(|other| other.camera).next() else {
                continue;
            };
            let until = own.partition_point(|other| seconds(record.time, other.time) <= JUDGED_AFTER_S);
            let latest_track = |camera: usize| {
                own[..until].iter().rev().find(|other| other.camera == camera).and_then(|it| it.track)
            };
            judged.push(latest_track(from).is_some() && latest_track(from) == latest_track(record.camera));
        }
    }
    judged
}

fn seconds(from: Timestamp, to: Timestamp) -> f64 {
    to.duration_since(from).as_secs_f64()
}
