//! What kind of file it is, from its name or its media type.

use std::path::Path;
use std::str::FromStr;

use crate::domain::{Error, Result};

/// A format of sample, observation or fused rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// Comma-separated, one header line.
    Csv,
    /// One JSON object a line.
    Ndjson,
    /// One JSON document.
    Json,
    /// RFC 7946, written only.
    GeoJson,
}

impl Format {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Csv, Self::Ndjson, Self::Json, Self::GeoJson];

    /// The format of a media type such as `text/csv; charset=utf-8`.
    #[must_use]
    pub fn from_media_type(media_type: &str) -> Option<Self> {
        let essence = media_type.split(';').next().unwrap_or_default().trim();
        let known = [
            ("text/csv", Self::Csv),
            ("application/x-ndjson", Self::Ndjson),
            ("application/ndjson", Self::Ndjson),
            ("application/jsonl", Self::Ndjson),
            ("application/json", Self::Json),
            ("application/geo+json", Self::GeoJson),
        ];
        known.into_iter().find(|(name, _)| essence.eq_ignore_ascii_case(name)).map(|(_, format)| format)
    }

    /// The format that a file's extension announces.
    #[must_use]
    pub fn from_path(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "csv" => Some(Self::Csv),
            "ndjson" | "jsonl" => Some(Self::Ndjson),
            "json" => Some(Self::Json),
            "geojson" => Some(Self::GeoJson),
            _ => None,
        }
    }

    /// What to announce it as.
    #[must_use]
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::Csv => "text/csv",
            Self::Ndjson => "application/x-ndjson",
            Self::Json => "application/json",
            Self::GeoJson => "application/geo+json",
        }
    }
}

/// A format of fixes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FixFormat {
    /// Columns `longitude`, `latitude` and at will `time`, `sigma_m` and `receiver_id`; other columns
    /// of sample files may stand beside them. Without a `receiver_id`, a `target_id` stands for it.
    Csv,
    /// NMEA 0183: positions of GGA, dates of RMC and ZDA; other sentences are passed over.
    Nmea,
    /// GPX: track, route and way points.
    Gpx,
    /// Reports of gpsd, one a line (`gpspipe -w`): those of class TPV. The receiver is the `device`.
    Gpsd,
}

impl FixFormat {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Csv, Self::Nmea, Self::Gpx, Self::Gpsd];

    /// The format that a file's extension announces; `nmea`, `log` and `txt` are NMEA; `json`,
    /// `ndjson` and `jsonl` are gpsd's.
    #[must_use]
    pub fn from_path(path: &std::path::Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "csv" => Some(Self::Csv),
            "nmea" | "log" | "txt" => Some(Self::Nmea),
            "gpx" => Some(Self::Gpx),
            "json" | "ndjson" | "jsonl" => Some(Self::Gpsd),
            _ => None,
        }
    }

    /// The format of a media type.
    #[must_use]
    pub fn from_media_type(media_type: &str) -> Option<Self> {
        let essence = media_type.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
        match essence.as_str() {
            "text/csv" => Some(Self::Csv),
            "application/nmea" | "application/x-nmea" | "text/x-nmea" | "text/plain" => Some(Self::Nmea),
            "application/gpx+xml" => Some(Self::Gpx),
            "application/json" | "application/x-ndjson" | "application/ndjson" | "application/jsonl" => {
                Some(Self::Gpsd)
            }
            _ => None,
        }
    }

    /// The one name used everywhere.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Nmea => "nmea",
            Self::Gpx => "gpx",
            Self::Gpsd => "gpsd",
        }
    }
}

impl FromStr for FixFormat {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL
            .into_iter()
            .find(|format| format.as_str() == name)
            .ok_or_else(|| Error::invalid("format", "must be one of csv, nmea, gpx, gpsd"))
    }
}
