//! Recordings whose boxes have only a tracker's ids and whose fixes only receivers': matched, then paired.
//! Evidence and search are in [`crate::fusion::association`].

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::recording::Recording;
use crate::config::Limits;
use crate::domain::{
    Association, ClockOffset, Error, ErrorKind, ImageSize, ReceiverId, Receivers, Result, TargetId, TrackerId,
};
use crate::fusion::association::{
    Cancellation, CarrierBox, MatchLimits, MatchSettings, MatchedGroup, MatchedPiece, Matching, WorldScores,
    match_with_model, match_without_model,
};
use crate::model::Regressor;

impl From<&Limits> for MatchLimits {
    fn from(limits: &Limits) -> Self {
        Self {
            tracklets: limits.match_tracklets,
            receivers: limits.match_receivers,
            comparisons: limits.match_comparisons,
        }
    }
}

/// The camera, the recording and the options of a match.
#[derive(Debug, Clone, Copy)]
pub struct MatchRequest<'a> {
    /// The camera's model; `None` to find one.
    pub regressor: Option<&'a Regressor>,
    /// Size of the image, needed without a model.
    pub image_size: Option<ImageSize>,
    /// Bounds of probability, clocks and size.
    pub settings: MatchSettings,
    /// Seed of everything random.
    pub seed: u64,
    /// Ends it early.
    pub cancellation: Cancellation<'a>,
}

/// A recording whose sure boxes have the ids of their receivers.
#[derive(Debug, Clone)]
pub struct MatchedRecording {
    /// Boxes that are not sure keep their tracker's id. The mean boxes of groups are among the detections.
    pub recording: Recording,
    /// The receivers under their own ids, with the clock offsets that were found.
    pub receivers: Receivers,
    /// How each sure box was matched, by time and receiver.
    pub associations: Associations,
    /// The report of the match.
    pub report: MatchReport,
}

/// How boxes were matched, by time and target.
pub type Associations = BTreeMap<(Timestamp, TargetId), Association>;

/// The outcome of a match for its tracklets and receivers.
#[derive(Debug, Clone, PartialEq)]
pub struct MatchReport {
    /// Tracklets: segments of boxes of one tracker's id.
    pub tracklets: usize,
    /// Receivers with fixes.
    pub receivers: usize,
    /// Tracklets cut where their id may have moved to another target.
    pub cuts: usize,
    /// Bound on the posterior probability.
    pub min_probability: f64,
    /// Boxes matched with at least that probability.
    pub matched_detections: u64,
    /// Boxes whose most probable receiver is less probable than that, but at least 0.5: left out.
    pub unsure_detections: u64,
    /// Sure pairs, in order of receiver and time.
    pub pairs: Vec<MatchedPair>,
    /// Tracklets that share a receiver with that probability, none of them sure, in order of receiver and time.
    pub groups: Vec<SharedReceiver>,
    /// Clock offsets found, beside those given.
    pub clock_offsets: Vec<(ReceiverId, ClockOffset)>,
    /// The scores of the search of a camera without a model.
    pub world: Option<WorldScores>,
}

/// A tracklet, or a part of it, with its receiver.
#[derive(Debug, Clone, PartialEq)]
pub struct MatchedPair {
    pub receiver_id: ReceiverId,
    /// Id that the tracker gave the boxes.
    pub tracker_id: TargetId,
    /// First and last box.
    pub from: Timestamp,
    /// The time of the last box.
    pub to: Timestamp,
    /// Number of boxes.
    pub detections: u64,
    pub probability: f64,
}

/// A receiver whose carrier is one of several tracklets that are seen at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct SharedReceiver {
    /// The receiver.
    pub receiver_id: ReceiverId,
    /// First instant at which all members are seen.
    pub from: Timestamp,
    /// Last instant at which all members are seen.
    pub to: Timestamp,
    /// Number of mean boxes of the members, of which samples are made.
    pub detections: u64,
    /// Posterior probability that one of the members is the carrier.
    pub probability: f64,
    /// The members, the most probable first.
    pub members: Vec<GroupMember>,
}

/// A tracklet of a group.
#[derive(Debug, Clone, PartialEq)]
pub struct GroupMember {
    /// Id that the tracker gave it.
    pub tracker_id: TargetId,
    /// Posterior probability that this one is the carrier.
    pub probability: f64,
}

/// From this probability on a match that is not sure is counted as such.
const UNSURE_PROBABILITY: f64 = 0.5;

impl Recording {
    /// Finds out whose boxes show whose receivers, and gives sure boxes the ids of their receivers.
    ///
    /// # Errors
    /// `NotIdentifiable` with the reason and a remedy; `TooLarge` beyond the settings' bounds; `Cancelled`;
    /// `InvalidArgument` where neither model nor image size is given.
    pub fn matched(mut self, receivers: &Receivers, request: &MatchRequest<'_>) -> Result<MatchedRecording> {
        let mut random = ChaCha8Rng::seed_from_u64(request.seed);
        let settings = &request.settings;
        let (matching, world) = match (request.regressor, request.image_size) {
            (Some(regressor), _) => {
                let matching = match_with_model(
                    &self.detections,
                    &self.fixes,
                    receivers,
                    regressor,
                    settings,
                    &mut random,
                    request.cancellation,
                )?;
                (matching, None)
            }
            (None, Some(image_size)) => {
                let joint = match_without_model(
                    &self.detections,
                    &self.fixes,
                    receivers,
                    image_size,
                    settings,
                    &mut random,
                    request.cancellation,
                )?;
                (joint.matching, Some(joint.scores))
            }
            (None, None) => {
                let message = "is needed to match without a model";
                return Err(Error::invalid("image_size", message));
            }
        };
        let report = self.report(&matching, world);
        if report.pairs.is_empty() && report.groups.is_empty() {
            return Err(Error::refused(
                ErrorKind::NotIdentifiable,
                format!(
                    "no tracklet, and no group of them, has a receiver of probability {} or more; record longer, with \
                     receivers carried across the whole view while few others are there",
                    report.min_probability
                ),
            ));
        }
        let receivers = matching.receivers_of(&self.fixes, receivers);
        let associations = self.rename(&matching)?;
        Ok(MatchedRecording { recording: self, receivers, associations, report })
    }

    fn report(&self, matching: &Matching, world: Option<WorldScores>) -> MatchReport {
        let min_probability = matching.min_probability;
        let time = |at: Option<&usize>| at.map_or(Timestamp::UNIX_EPOCH, |at| self.detections[*at].time);
        let mut pairs: Vec<MatchedPair> = matching
            .sure()
            .map(|piece| MatchedPair {
                receiver_id: piece.receiver_id.clone(),
                tracker_id: piece.tracker_id.clone(),
                from: time(piece.detections.first()),
                to: time(piece.detections.last()),
                detections: piece.detections.len() as u64,
                probability: piece.probability,
            })
            .collect();
        pairs.sort_by(|one, other| (&one.receiver_id, one.from).cmp(&(&other.receiver_id, other.from)));
        let shared = |group: &MatchedGroup| {
            let times = group.members.iter().flat_map(|member| &member.detections);
            let times: BTreeSet<Timestamp> = times.map(|at| self.detections[*at].time).collect();
            let member = |own: &MatchedPiece| GroupMember {
                tracker_id: own.tracker_id.clone(),
                probability: own.probability,
            };
            Some(SharedReceiver {
                receiver_id: group.receiver_id().clone(),
                from: *times.first()?,
                to: *times.last()?,
                detections: group.boxes(&self.detections).count() as u64,
                probability: group.probability(),
                members: group.members.iter().map(member).collect(),
            })
        };
        let unsure = matching
            .pieces
            .iter()
            .filter(|piece| (UNSURE_PROBABILITY..min_probability).contains(&piece.probability));
        MatchReport {
            tracklets: matching.tracklets,
            receivers: matching.receivers,
            cuts: matching.cuts,
            min_probability,
            matched_detections: pairs.iter().map(|pair| pair.detections).sum(),
            unsure_detections: unsure.map(|piece| piece.detections.len() as u64).sum(),
            pairs,
            groups: matching.groups.iter().filter_map(shared).collect(),
            clock_offsets: matching.clock_offsets.clone(),
            world,
        }
    }

    /// The boxes of carriers get their receivers' ids; those of groups come beside those of their members. A tracker's id that is also
    /// a receiver's is changed: its boxes must not be paired by name.
    fn rename(&mut self, matching: &Matching) -> Result<Associations> {
        let carriers = matching.carrier_boxes(&self.detections);
        let receivers: BTreeSet<TargetId> =
            self.fixes.iter().filter_map(|fix| fix.receiver_id.clone()).map(TargetId::from).collect();
        for own in self.detections.iter_mut().filter(|own| receivers.contains(&own.target_id)) {
            own.target_id = TargetId::from(&TrackerId::new(own.target_id.as_str())?);
        }
        let mut associations = Associations::new();
        for CarrierBox { detection, association, at } in carriers {
            associations.insert((detection.time, detection.target_id.clone()), association);
            match at {
                Some(at) => self.detections[at] = detection,
                None => self.detections.push(detection),
            }
        }
        Ok(associations)
    }
}
