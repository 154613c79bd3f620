//! Whose fix is it: anonymous tracklets matched with the receivers that their targets carry.
//!
//! [`match_with_model`] compares fixes with regressed positions; [`match_without_model`] finds the camera,
//! too. `docs/explanation/association.md` has the formulas and figures. The files in the order of their imports:
//! `cancellation`, `tracklet`, `disjoint`, `axis_filter`, `evidence`, `links`, `chains`, `assignment`, `cuts`, `companions`, `placement`, `recording`, `matching`, `joint`, `live`, `receiver_clocks`, `world_receivers`.
//! Does not use I/O, clocks, or randomness that is not handed in.

mod assignment;
mod axis_filter;
mod cancellation;
mod carriers;
mod chains;
mod companions;
mod company;
mod cuts;
mod disjoint;
mod evidence;
mod groups;
mod joint;
mod links;
mod live;
mod matching;
mod placement;
mod receiver_clocks;
mod recording;
mod tracklet;
mod world_receivers;

pub use self::cancellation::Cancellation;
pub use self::carriers::{CarrierBox, MatchedGroup, MatchedPiece, Matching};
pub use self::chains::ChainSettings;
pub use self::joint::{JointMatch, WorldScores, joint_pairing, match_without_model};
pub use self::live::{LiveMatchSettings, LiveMatches, LiveWindow};
pub use self::matching::{MatchLimits, MatchSettings, match_with_model};
pub use self::receiver_clocks::ReceiverClocks;
pub use self::world_receivers::{MatchedReceivers, WorldReceiverWindow, WorldReceivers};

#[cfg(test)]
mod tests;
