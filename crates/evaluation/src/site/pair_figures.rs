//! Pairs of tracklets and receivers against the truth.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use serde::Serialize;

use super::recording::{LabelledBox, SiteRecording};
use crate::domain::TargetId;
use crate::fusion::association::{MatchedPiece, Matching};

/// Posterior probability from which on a pair is sure.
const SURE: f64 = 0.9;
/// Lower bounds of the bins of stated probabilities, after that from 0 on.
const BINS: [f64; 5] = [0.3, 0.5, 0.7, 0.9, 0.95];
/// A target within this distance of the carrier for most of a piece's boxes is its companion, m.
const COMPANION_WITHIN_M: f64 = 1.5;
/// Fixes during a tracklet that make a true pair.
const LEAST_FIXES: usize = 3;

/// Pairs whose stated probabilities are in one bin.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Bin {
    /// Number of pairs.
    pub pairs: usize,
    /// Number of right ones.
    pub right: usize,
    /// Sum of the stated probabilities.
    pub stated: f64,
}

impl Bin {
    fn plus(&self, other: &Self) -> Self {
        Self {
            pairs: self.pairs + other.pairs,
            right: self.right + other.right,
            stated: self.stated + other.stated,
        }
    }
}

/// Counts of pairs, and of the boxes of pairs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct PairFigures {
    /// Pairs by stated probability: from 0, 0.3, 0.5, 0.7, 0.9 and 0.95 on.
    pub bins: [Bin; 6],
    /// True pairs, and those of them that were found with a probability of 0.9 or more.
    pub true_pairs: usize,
    /// See `true_pairs`.
    pub found: usize,
    /// Boxes of true pairs, and those of them in right pairs of a probability of 0.9 or more.
    pub true_boxes: usize,
    /// See `true_boxes`.
    pub found_boxes: usize,
    /// Wrong pairs of a probability of 0.9 or more whose target walks with the carrier.
    pub companions: usize,
    /// Groups that share a receiver; right if one of the members is the carrier.
    pub groups: Bin,
}

impl PairFigures {
    /// The pairs that were found in one camera of a recording, whose boxes were matched in their order.
    #[must_use]
    pub fn of(recording: &SiteRecording, camera: usize, matching: &Matching) -> Self {
        let boxes = &recording.cameras[camera].boxes;
        let mut figures = Self::default();
        let truth = true_pairs(recording, boxes);
        figures.true_pairs = truth.len();
        let has_receiver: BTreeSet<&TargetId> = truth.iter().map(|(tracker_id, _)| *tracker_id).collect();
        figures.true_boxes = boxes.iter().filter(|own| has_receiver.contains(&own.tracker_id)).count();
        let mut found = BTreeSet::new();
        for piece in &matching.pieces {
            let receiver = recording.receivers.iter().position(|(id, _)| *id == piece.receiver_id);
            let carrier = receiver.map(|receiver| recording.receivers[receiver].1);
            let is_right = carrier.is_some() && target_of(boxes, piece) == carrier;
            let bin = &mut figures.bins[BINS.iter().filter(|least| piece.probability >= **least).count()];
            bin.pairs += 1;
            bin.right += usize::from(is_right);
            bin.stated += piece.probability;
            if piece.probability < SURE {
                continue;
            }
            if is_right {
                figures.found_boxes += piece.detections.len();
                found.extend(receiver.map(|receiver| (&piece.tracker_id, receiver)));
            } else if carrier.is_some_and(|carrier| shows_companion(recording, boxes, piece, carrier)) {
                figures.companions += 1;
            }
        }
        figures.found = found.intersection(&truth).count();
        for group in &matching.groups {
            let carrier = recording.receivers.iter().find(|(id, _)| id == group.receiver_id());
            let is_carrier = |member: &MatchedPiece| {
                carrier.is_some_and(|(_, carrier)| target_of(boxes, member) == Some(*carrier))
            };
            figures.groups.pairs += 1;
            figures.groups.right += usize::from(group.members.iter().any(is_carrier));
            figures.groups.stated += group.probability();
        }
        figures
    }

    /// These and others together.
    #[must_use]
    pub fn plus(mut self, other: &Self) -> Self {
        for (own, other) in self.bins.iter_mut().zip(&other.bins) {
            *own = own.plus(other);
        }
        self.groups = self.groups.plus(&other.groups);
        self.true_pairs += other.true_pairs;
        self.found += other.found;
        self.true_boxes += other.true_boxes;
        self.found_boxes += other.found_boxes;
        self.companions += other.companions;
        self
    }

    /// The pairs from a probability of 0.9 on.
    #[must_use]
    pub fn sure(&self) -> Bin {
        self.bins[4..].iter().fold(Bin::default(), |sum, bin| sum.plus(bin))
    }
}

/// The target of most boxes of a piece.
fn target_of(boxes: &[LabelledBox], piece: &MatchedPiece) -> Option<usize> {
    let mut counts: BTreeMap<Option<usize>, usize> = BTreeMap::new();
    piece.detections.iter().for_each(|at| *counts.entry(boxes[*at].target).or_default() += 1);
    counts.into_iter().max_by_key(|(_, count)| *count)?.0
}

/// True if most boxes of a piece show a target near the carrier.
fn shows_companion(
    recording: &SiteRecording,
    boxes: &[LabelledBox],
    piece: &MatchedPiece,
    carrier: usize,
) -> bool {
    let is_near = |own: &LabelledBox| {
        let position = |target| recording.truth.get(&(own.time, target));
        let own_position = own.target.and_then(position);
        own_position
            .zip(position(carrier))
            .is_some_and(|(own, carrier)| own.distance_m(*carrier) <= COMPANION_WITHIN_M)
    };
    2 * piece.detections.iter().filter(|at| is_near(&boxes[**at])).count() > piece.detections.len()
}

/// Ids of trackers with the receivers of their targets that have enough fixes between the first and the last box.
fn true_pairs<'a>(recording: &SiteRecording, boxes: &'a [LabelledBox]) -> BTreeSet<(&'a TargetId, usize)> {
    let mut spans: BTreeMap<(&TargetId, usize), (Timestamp, Timestamp)> = BTreeMap::new();
    for own in boxes {
        let Some(target) = own.target else { continue };
        let span = spans.entry((&own.tracker_id, target)).or_insert((own.time, own.time));
        *span = (span.0.min(own.time), span.1.max(own.time));
    }
    let mut times: BTreeMap<usize, Vec<Timestamp>> = BTreeMap::new();
    recording.fixes.iter().for_each(|fix| times.entry(fix.receiver).or_default().push(fix.time));
    let pairs = spans.into_iter().flat_map(|((tracker_id, target), (from, until))| {
        let carried =
            recording.receivers.iter().enumerate().filter(move |(_, (_, carrier))| *carrier == target);
        let times = &times;
        carried.filter_map(move |(receiver, _)| {
            let during = times.get(&receiver)?.iter().filter(|time| (from..=until).contains(*time)).count();
            (during >= LEAST_FIXES).then_some((tracker_id, receiver))
        })
    });
    pairs.collect()
}
