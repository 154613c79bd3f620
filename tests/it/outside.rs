//! Connections with other systems: their messages, brokers, receivers, webhooks, Cursor on Target, files. Tests whose names
//! contain `broker` start a real mosquitto or nats-server; they are ignored by default, and `.ci/run` installs both and
//! runs them.

mod broker;
mod files;
mod messages;
pub(crate) mod peers;
mod receivers;
mod resource;
mod sinks;
