//! The paper's experiments: placeholder.
use std::path::Path;
pub(super) fn run(_shared: Option<&Path>, _out: &Path, _seeds: u64) -> anyhow::Result<()> {
    anyhow::bail!("not yet")
}
