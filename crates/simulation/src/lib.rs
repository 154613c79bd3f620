//! Synthetic cameras, targets and receivers with ground truth, for tests and evaluation.
//!
//! A world is a function of its [`Options`] alone, bit for bit. The camera is drawn from
//! `camera_seed`, everything else from `seed`, so two worlds may share one camera. Each kind of disturbance
//! draws from a stream of its own: switching one on leaves everything else as it was.
//! What never happens here: any clock or randomness but the seeds, any knowledge of the methods.

mod camera;
mod noise;
mod options;
mod path;
#[cfg(test)]
mod positions;
mod row;
mod scene;
mod shape;
mod site;
mod target;
mod tracker;
mod world;

pub use noise::SimulatedReceiver;
pub use options::{Options, Route};
pub use row::SimulatedRow;
pub use scene::Scene;
pub use shape::TargetShape;
pub use site::{LabelledDetection, SimulatedCamera, SimulatedSite, SiteOptions, simulate_site};
pub use world::{World, simulate, simulate_split};

#[cfg(test)]
pub(crate) use noise::{standard_normal, stream};
#[cfg(test)]
pub(crate) use positions::{
    SimulatedPositions, SiteVisits, VISIT_GNSS_SIGMA_M, VISIT_MODEL_SIGMA_M, Walk, at_s,
};
