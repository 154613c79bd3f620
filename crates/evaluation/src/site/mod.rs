//! How well a site is tracked: the maps of its cameras trained together or apart, the world tracks over all
//! cameras or one, against the true targets.
//!
//! Definitions are in docs/explanation/world-tracks.md, with their sources.

mod box_figures;
mod clock_figures;
mod crossing_figures;
mod degradation;
mod draw;
mod known_points;
mod matching_report;
mod pair_figures;
mod receiver_feed;
mod receiver_matching;
mod recording;
mod report;
mod runner;
#[cfg(test)]
mod tests;
mod world_figures;

pub use box_figures::{BoxFigures, BoxRecord};
pub use clock_figures::{ClockFigures, EstimateFigures};
pub use crossing_figures::{CrossingFigures, PlaceCounts};
pub use degradation::Degradation;
pub use draw::position_at;
pub use known_points::nearest_to_corners;
pub use matching_report::{JointFigures, KNOWN_MODEL_SEEDS, MatchingCase, MatchingReport};
pub use pair_figures::{Bin, PairFigures};
pub use receiver_feed::NamedFigures;
pub use receiver_matching::JointFound;
pub use recording::{LabelledBox, RecordedCamera, RecordedFix, SiteRecording, Visits};
pub use report::{FoundCameraFigures, SiteCase, SiteReport};
pub use runner::{
    FoundCamera, Identities, SiteOutcome, SiteTraining, TrainedSite, site_fit_rows, track_site, train_site,
};
pub use world_figures::{PositionFigures, ReportedTrack, WorldFigures, WorldInstant};
