//! Synthetic cameras, targets and receivers, with the truth: worlds to prove the methods on.
//!
//! A world comes from its [`Options`] alone, bit for bit. The camera is drawn from `camera_seed`,
//! everything that happens before it from `seed`; so two worlds may share one camera.
//! What never happens here: any clock or randomness but the seeds, any knowledge of the methods.

mod camera;
mod noise;
mod path;
mod scene;
mod world;

pub use scene::Scene;
pub use world::{Options, Route, SimulatedRow, World, simulate, simulate_split};
