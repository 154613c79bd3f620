//! `sightfix openapi`

use clap::Args;

use super::output::print_line;
use crate::http;

/// Print the OpenAPI description of the REST interface
#[derive(Args)]
pub(super) struct Openapi {}

impl Openapi {
    pub(super) fn run(self) -> anyhow::Result<()> {
        print_line(&http::openapi().to_pretty_json()?)
    }
}
