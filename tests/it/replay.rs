//! `sightfix replay`: what a client does when things go wrong, and that nothing acknowledged is lost.

mod fake;
mod rules;
mod server;
