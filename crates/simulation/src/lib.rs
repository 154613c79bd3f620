//! Synthetic cameras, targets and receivers with ground truth, for tests and evaluation.
//!
//! | function | contents |
//! |---|---|
//! | [`simulate`], [`simulate_split`] | one camera and its targets, a [`World`] of a [`Scene`] |
//! | [`simulate_site`] | the cameras of a site, their trackers and the receivers of all targets |
//! | [`site_stills`] | what these cameras see while nobody is in view |
//! | [`SimulatedReceiver`] | the error of one GNSS receiver along a path |
//! | [`stream`], [`standard_normal`] | an independent random stream of a seed, and a draw from it |
//!
//! A world is a function of its [`Options`] alone, bit for bit. The camera is drawn from
//! `camera_seed`, everything else from `seed`, so two worlds may share one camera. Each kind of disturbance
//! draws from a stream of its own: switching one on leaves everything else as it was.
//! Nothing here knows the methods that are tested on it.
//!
//! The feature `testing` adds what the tests of other crates need: a few rows for a quick fit, and positions without
//! boxes, of one walk or of visits over months.

#![warn(missing_docs)]

mod airport_form;
mod camera;
mod noise;
mod options;
#[cfg(feature = "testing")]
mod passes;
mod path;
#[cfg(feature = "testing")]
mod positions;
mod row;
mod scene;
mod shape;
mod site;
mod target;
mod tracker;
mod world;

pub use airport_form::AirportForm;
pub use noise::{SimulatedReceiver, standard_normal, stream};
pub use options::{Options, Route};
#[cfg(feature = "testing")]
pub use passes::walk;
#[cfg(feature = "testing")]
pub use positions::{SimulatedPositions, SiteVisits, VISIT_GNSS_SIGMA_M, VISIT_MODEL_SIGMA_M, Walk, at_s};
pub use row::SimulatedRow;
pub use scene::Scene;
pub use shape::TargetShape;
pub use site::{
    LabelledDetection, SimulatedCamera, SimulatedSite, SiteOptions, Still, simulate_site, site_stills,
};
pub use world::{World, simulate, simulate_split};

use sightfix_domain::{domain, geo};
