//! Connections with other systems: their messages, brokers, receivers, webhooks, Cursor on Target, files. Tests whose names
//! contain `broker` start a real mosquitto or nats-server, or librdkafka's mock cluster, and those with `rtsp` GStreamer's RTSP
//! server; they are ignored by default, and `.ci/run` installs what they need and runs them.

pub(crate) mod broker;
mod files;
mod filters;
pub(crate) mod kafka;
mod messages;
pub(crate) mod peers;
mod phones;
mod receivers;
mod resource;
mod rtsp;
mod sinks;
