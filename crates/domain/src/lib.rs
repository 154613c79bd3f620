//! The values that all other crates of sightfix speak in.
//!
//! | module | contents |
//! |---|---|
//! | [`geo`] | WGS 84 positions, the local east-north plane of a camera, geodesic distance |
//! | [`statistics`] | order statistics and moments of plain numbers |
//! | [`domain`] | boxes, fixes, samples, cameras, runs, sites, keys and connections; the one error type |
//!
//! Every value is valid by construction: a constructor checks the numbers and names the field that is wrong, so
//! no other crate checks them again. Degrees are in [`geo::Position`] and metres in [`geo::EastNorth`]; only
//! [`geo::LocalPlane`] converts between them.
//!
//! The crate reads no clock, draws nothing at random, does no input or output, and knows no wire format and no
//! status code.
//!
//! `geo` imports from no other module, `domain` from `geo` alone.

#![warn(missing_docs)]

pub mod domain;
pub mod geo;
pub mod statistics;
