//! Sources and sinks: other systems that give detections and fixes, or take positions.
//!
//! A source is a [`source::Source`] and a decoder of [`crate::exchange`]; a sink is a [`sink::Sink`]. A task per
//! connection of `/v1/connections` runs it, opens it again with growing pauses when it fails, and keeps its status.
//! Messages of a source are acknowledged to its peer after their items are stored; messages of a sink are stored first,
//! and deleted after its receiver has them.
//!
//! Does not contain formats of messages (they are in `exchange`), rules of tracks (they are in `app`), or a
//! queue without a limit.

// Input of other systems reaches this module: nothing in it may end the process.
#![warn(clippy::expect_used, clippy::panic, clippy::unreachable)]

mod credentials;
mod deliver;
mod inbox;
mod intake;
mod kinds;
mod peer;
mod publish;
mod sign_in;
mod sink;
mod snapshot;
mod source;
mod supervisor;
mod tls;
mod trial;

pub use snapshot::fetch_snapshot;
pub use supervisor::Supervisor;
pub use trial::{Trial, try_connection};
