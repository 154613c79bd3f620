//! `sightfix health`

use std::net::SocketAddr;
use std::path::Path;

use anyhow::Context as _;
use clap::Args;

use super::output::print_line;
use crate::config::{Config, Overrides};
use crate::doctor::request_liveness;

/// Check whether the server of these settings is alive; for the health check of a container
#[derive(Args)]
pub(super) struct Health {
    /// Address of the server
    #[arg(long, value_name = "ADDR")]
    listen: Option<SocketAddr>,
}

impl Health {
    pub(super) fn run(self, file: Option<&Path>) -> anyhow::Result<()> {
        let settings = Config::load(file, Overrides { listen: self.listen, ..Overrides::default() })?;
        let address = settings.listen;
        let answer = request_liveness(address).with_context(|| format!("no answer from {address}"))?;
        anyhow::ensure!(answer.starts_with("HTTP/1.1 200"), "{address} answered {answer:?}");
        print_line(&format_args!("{address} is alive"))?;
        Ok(())
    }
}
