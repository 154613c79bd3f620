//! Sites: the resource, and one set of tracks over all cameras.

mod resource;
mod tracks;
mod training;
mod two_cameras;
