//! `sightfix openapi`

use clap::Args;

use crate::http;

/// Print the OpenAPI description of the REST interface
#[derive(Args)]
pub(super) struct Openapi {}

impl Openapi {
    pub(super) fn run(self) -> anyhow::Result<()> {
        println!("{}", http::openapi().to_pretty_json()?);
        Ok(())
    }
}
