//! Settings of the operator's console.

use std::io::Read as _;
use std::path::PathBuf;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::origin::tile_origin;

/// How a PMTiles file of version 3 begins.
const PMTILES_MAGIC: &[u8; 8] = b"PMTiles\x03";

/// Tiles of the OpenStreetMap Foundation.
const OPENSTREETMAP: &str = "https://tile.openstreetmap.org/{z}/{x}/{y}.png";

/// The settings of the operator's console.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Console {
    /// Map tiles under the cameras, with `{z}`, `{x}` and `{y}`; without it the map is a plain plane and the
    /// console asks no other server.
    pub tile_url: Option<String>,
    /// A PMTiles file of map tiles that the server itself offers; instead of `tile_url`.
    #[schema(value_type = Option<String>)]
    pub tile_file: Option<PathBuf>,
    /// The attribution that the provider of the tiles asks for on the map.
    pub tile_attribution: Option<String>,
    /// File with the authority (PEM) of the server's own certificate. Phones fetch it from `/authority.crt` to trust it.
    #[schema(value_type = Option<String>)]
    pub authority: Option<PathBuf>,
    /// True if the page offers the map of OpenStreetMap, whose server browsers ask once their user has agreed. Only
    /// without tiles of these settings.
    pub offer_openstreetmap: bool,
}

impl Default for Console {
    fn default() -> Self {
        Self {
            tile_url: None,
            tile_file: None,
            tile_attribution: None,
            authority: None,
            offer_openstreetmap: true,
        }
    }
}

impl Console {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if let Some(authority) = &self.authority {
            std::fs::File::open(authority)
                .with_context(|| format!("console.authority: cannot read {}", authority.display()))?;
        }
        if let Some(url) = &self.tile_url {
            anyhow::ensure!(
                tile_origin(url).is_some() && ["{z}", "{x}", "{y}"].iter().all(|part| url.contains(part)),
                "console.tile_url must be a URL like https://tiles.example.org/{{z}}/{{x}}/{{y}}.png"
            );
        }
        let Some(file) = &self.tile_file else { return Ok(()) };
        anyhow::ensure!(self.tile_url.is_none(), "give console.tile_url or console.tile_file, not both");
        let mut magic = [0; PMTILES_MAGIC.len()];
        std::fs::File::open(file)
            .and_then(|mut opened| opened.read_exact(&mut magic))
            .with_context(|| format!("console.tile_file: cannot read {}", file.display()))?;
        anyhow::ensure!(
            magic == *PMTILES_MAGIC,
            "console.tile_file must be a PMTiles file of version 3; {} is none",
            file.display()
        );
        Ok(())
    }

    /// The tiles that the page offers its user: URL and what their provider asks to be shown. `None` where the settings
    /// name tiles, or forbid it.
    #[must_use]
    pub fn offered_tiles(&self) -> Option<(&'static str, &'static str)> {
        let has_tiles = self.tile_url.is_some() || self.tile_file.is_some();
        (self.offer_openstreetmap && !has_tiles).then_some((OPENSTREETMAP, "© OpenStreetMap contributors"))
    }

    /// The origin of the tiles' server (`https://tiles.example.org`), for the console's security policy;
    /// `None` for tiles of this server.
    #[must_use]
    pub fn tile_origin(&self) -> Option<&str> {
        let url = self.tile_url.as_deref().or(self.offered_tiles().map(|(url, _)| url));
        url.and_then(tile_origin).filter(|origin| !origin.is_empty())
    }
}
