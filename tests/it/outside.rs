//! Connections with other systems: brokers, receivers, webhooks, Cursor on Target. Tests whose names contain `broker`
//! start a real mosquitto; they are ignored by default, and `.ci/run` installs it and runs them.

mod broker;
mod peers;
mod receivers;
mod resource;
mod sinks;
