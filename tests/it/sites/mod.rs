//! Sites: the resource, and one set of tracks over all cameras.

mod moved_camera;
mod resource;
mod tracks;
mod training;
mod two_cameras;
