//! File formats, by file name or media type.

use std::path::Path;

use strum::{EnumString, IntoStaticStr, VariantArray};

use crate::domain::Error;

/// A format of sample, observation or fused rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// Comma-separated values with a header line.
    Csv,
    /// One JSON object per line.
    Ndjson,
    /// One JSON document.
    Json,
    /// GeoJSON (RFC 7946), written only.
    GeoJson,
}

impl Format {
    /// All formats.
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

    /// The format of a file's extension.
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

    /// The media type in responses.
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, EnumString, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case", parse_err_ty = Error, parse_err_fn = unknown_fix_format)]
pub enum FixFormat {
    /// Columns `longitude`, `latitude` and optionally `time`, `sigma_m` and `receiver_id`; other columns
    /// of sample files are accepted. Without a `receiver_id` the `target_id` is used instead.
    Csv,
    /// NMEA 0183: positions of GGA, dates of RMC and ZDA; other sentences are skipped.
    Nmea,
    /// GPX: track, route and way points.
    Gpx,
    /// Reports of gpsd, one per line (`gpspipe -w`): those of class TPV. The receiver is the `device`.
    Gpsd,
    /// Solutions of RTKLIB (`.pos`) in degrees, with times of GPS, UTC or Japan.
    Rtklib,
    /// Activities of sports watches and bicycle computers (`.fit`): the messages `record`.
    Fit,
    /// Logs of Android's GnssLogger: the lines `Fix` of the provider `gps`.
    GnssLogger,
}

impl FixFormat {
    /// All formats.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// The format of a file's extension; `nmea`, `log` and `txt` are NMEA ([`FixFormat::of_content`] tells logs of
    /// GnssLogger from it); `json`, `ndjson` and `jsonl` are gpsd's.
    #[must_use]
    pub fn from_path(path: &std::path::Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "csv" => Some(Self::Csv),
            "nmea" | "log" | "txt" => Some(Self::Nmea),
            "gpx" => Some(Self::Gpx),
            "pos" => Some(Self::Rtklib),
            "fit" => Some(Self::Fit),
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
            "text/x-rtklib" => Some(Self::Rtklib),
            "application/vnd.ant.fit" | "application/fit" => Some(Self::Fit),
            "application/json" | "application/x-ndjson" | "application/ndjson" | "application/jsonl" => {
                Some(Self::Gpsd)
            }
            _ => None,
        }
    }

    /// The format of a file that is named as of this one and begins so: a log of GnssLogger is named as text and begins
    /// with a comment, which NMEA does not have.
    #[must_use]
    pub fn of_content(self, beginning: &[u8]) -> Self {
        if self == Self::Nmea && beginning.starts_with(b"#") { Self::GnssLogger } else { self }
    }

    /// Name in commands and reports.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

fn unknown_fix_format(_: &str) -> Error {
    Error::invalid("format", "must be one of csv, nmea, gpx, gpsd, rtklib, fit, gnss_logger")
}
