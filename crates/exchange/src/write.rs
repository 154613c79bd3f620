//! Streaming writers of samples and fused positions.
//!
//! Degrees have 8 decimals (about 1 mm) in CSV and full precision elsewhere. GeoJSON is RFC 7946: WGS 84,
//! `[longitude, latitude]`.

use std::borrow::Cow;
use std::fmt::Display;
use std::io::{self, Write};

use serde::Serialize;

use super::columns::{COLUMNS, OF_SAMPLES, OF_UNMATCHED};
use super::format::Format;
use super::formula_guard::guarded;
use super::wire;
use crate::domain::{Association, Fix, FusedFix, Sample, StoredSample};

/// Writes samples one by one. Between two of them the output can be drained (`get_mut`), so an export of
/// any length needs the memory of one page.
pub struct SampleWriter<W: Write>(PositionDocument<W>);

impl<W: Write> SampleWriter<W> {
    /// A writer of that format. Nothing is written yet.
    pub const fn new(out: W, format: Format) -> Self {
        Self(PositionDocument::new(out, format, "samples"))
    }

    /// Writes one sample. Without a fix its columns are empty, and its GeoJSON feature has no geometry.
    ///
    /// # Errors
    /// An I/O error of the output.
    pub fn write<F: Copy + Into<Option<Fix>>>(&mut self, sample: &Sample<F>) -> io::Result<()> {
        let row = wire::Sample::from(sample);
        match self.0.format {
            Format::Csv => self.0.csv_row(sample_header, |out| sample_cells(out, &row)),
            Format::Ndjson | Format::Json => self.0.json_row(&row),
            Format::GeoJson => {
                let position = row.fix.map(|fix| fix.position());
                self.0.json_row(&Feature::new(position, &row))
            }
        }
    }

    /// The output, to drain it.
    pub const fn get_mut(&mut self) -> &mut W {
        &mut self.0.out
    }

    /// Completes the document and returns the output.
    ///
    /// # Errors
    /// An I/O error of the output.
    pub fn finish(self) -> io::Result<W> {
        self.0.finish(sample_header)
    }
}

/// Writes samples with how they were matched, like [`SampleWriter`]: two columns more.
pub struct MatchedSampleWriter<W: Write>(PositionDocument<W>);

impl<W: Write> MatchedSampleWriter<W> {
    /// A writer of that format. Nothing is written yet.
    pub const fn new(out: W, format: Format) -> Self {
        Self(PositionDocument::new(out, format, "samples"))
    }

    /// Writes one sample; without an association its two columns are empty.
    ///
    /// # Errors
    /// An I/O error of the output.
    pub fn write(&mut self, sample: &StoredSample, association: Option<&Association>) -> io::Result<()> {
        let row = MatchedRow {
            sample: wire::Sample::from(sample),
            tracker_id: association.map(|own| own.tracker_id.as_str()),
            match_probability: association.map(|own| own.probability),
        };
        match self.0.format {
            Format::Csv => self.0.csv_row(matched_header, |out| matched_cells(out, &row)),
            Format::Ndjson | Format::Json => self.0.json_row(&row),
            Format::GeoJson => {
                let position = row.sample.fix.map(|fix| fix.position());
                self.0.json_row(&Feature::new(position, &row))
            }
        }
    }

    /// Completes the document and returns the output.
    ///
    /// # Errors
    /// An I/O error of the output.
    pub fn finish(self) -> io::Result<W> {
        self.0.finish(matched_header)
    }
}

/// A sample, the id that the tracker gave it, and the posterior probability of the match.
#[derive(Serialize)]
struct MatchedRow<'a> {
    #[serde(flatten)]
    sample: wire::Sample<'a>,
    #[serde(skip_serializing_if = "Option::is_none")]
    tracker_id: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    match_probability: Option<f64>,
}

/// Writes fused positions one by one, like [`SampleWriter`].
pub struct FusedWriter<W: Write>(PositionDocument<W>);

impl<W: Write> FusedWriter<W> {
    /// A writer of that format. Nothing is written yet.
    pub const fn new(out: W, format: Format) -> Self {
        Self(PositionDocument::new(out, format, "items"))
    }

    /// Writes one fused position.
    ///
    /// # Errors
    /// An I/O error of the output.
    pub fn write(&mut self, fused: &FusedFix) -> io::Result<()> {
        let row = wire::FusedFix::from(fused);
        match self.0.format {
            Format::Csv => self.0.csv_row(fused_header, |out| fused_cells(out, &row)),
            Format::Ndjson | Format::Json => self.0.json_row(&row),
            Format::GeoJson => self.0.json_row(&Feature::new(Some(row.fused), &row)),
        }
    }

    /// The output, to drain it.
    pub const fn get_mut(&mut self) -> &mut W {
        &mut self.0.out
    }

    /// Completes the document and returns the output.
    ///
    /// # Errors
    /// An I/O error of the output.
    pub fn finish(self) -> io::Result<W> {
        self.0.finish(fused_header)
    }
}

/// Writes samples as one document.
///
/// # Errors
/// An I/O error of the output.
pub fn write_samples<'a, W: Write, F: Copy + Into<Option<Fix>> + 'a>(
    out: W,
    format: Format,
    samples: impl IntoIterator<Item = &'a Sample<F>>,
) -> io::Result<W> {
    let mut writer = SampleWriter::new(out, format);
    for sample in samples {
        writer.write(sample)?;
    }
    writer.finish()
}

/// Writes fused positions as one document.
///
/// # Errors
/// An I/O error of the output.
pub fn write_fused<'a, W: Write>(
    out: W,
    format: Format,
    fused: impl IntoIterator<Item = &'a FusedFix>,
) -> io::Result<W> {
    let mut writer = FusedWriter::new(out, format);
    for row in fused {
        writer.write(row)?;
    }
    writer.finish()
}

/// The framing of a document: beginning, separators and end.
pub(super) struct PositionDocument<W> {
    pub(super) out: W,
    pub(super) format: Format,
    /// Name of the array in a JSON document.
    name: &'static str,
    has_begun: bool,
}

impl<W: Write> PositionDocument<W> {
    pub(super) const fn new(out: W, format: Format, name: &'static str) -> Self {
        Self { out, format, name, has_begun: false }
    }

    pub(super) fn csv_row(
        &mut self,
        header: fn(&mut W) -> io::Result<()>,
        cells: impl FnOnce(&mut W) -> io::Result<()>,
    ) -> io::Result<()> {
        if !self.has_begun {
            self.has_begun = true;
            header(&mut self.out)?;
        }
        cells(&mut self.out)
    }

    pub(super) fn json_row(&mut self, row: &impl Serialize) -> io::Result<()> {
        match self.format {
            Format::Json | Format::GeoJson if self.has_begun => self.out.write_all(b",\n")?,
            Format::Json | Format::GeoJson => self.begin()?,
            Format::Csv | Format::Ndjson => {}
        }
        self.has_begun = true;
        serde_json::to_writer(&mut self.out, row)?;
        if self.format == Format::Ndjson { self.out.write_all(b"\n") } else { Ok(()) }
    }

    fn begin(&mut self) -> io::Result<()> {
        if self.format == Format::GeoJson {
            self.out.write_all(b"{\"type\":\"FeatureCollection\",\"features\":[\n")
        } else {
            writeln!(self.out, "{{\"{}\":[", self.name)
        }
    }

    pub(super) fn finish(mut self, header: fn(&mut W) -> io::Result<()>) -> io::Result<W> {
        match self.format {
            Format::Csv if !self.has_begun => header(&mut self.out)?,
            Format::Csv | Format::Ndjson => {}
            Format::Json | Format::GeoJson => {
                if !self.has_begun {
                    self.begin()?;
                }
                self.out.write_all(b"\n]}\n")?;
            }
        }
        self.out.flush()?;
        Ok(self.out)
    }
}

fn sample_header<W: Write>(out: &mut W) -> io::Result<()> {
    header(out, OF_UNMATCHED)
}

fn matched_header<W: Write>(out: &mut W) -> io::Result<()> {
    header(out, OF_SAMPLES)
}

/// A line of the names of the first columns.
fn header<W: Write>(out: &mut W, columns: usize) -> io::Result<()> {
    for (index, column) in COLUMNS.iter().take(columns).enumerate() {
        let end = if index + 1 < columns { "," } else { "\n" };
        write!(out, "{}{end}", column.plain)?;
    }
    Ok(())
}

fn sample_cells<W: Write>(out: &mut W, row: &wire::Sample<'_>) -> io::Result<()> {
    unmatched_cells(out, row)?;
    writeln!(out)
}

fn matched_cells<W: Write>(out: &mut W, row: &MatchedRow<'_>) -> io::Result<()> {
    unmatched_cells(out, &row.sample)?;
    write!(out, ",{},", row.tracker_id.map(text_cell).unwrap_or_default())?;
    match row.match_probability {
        Some(probability) => writeln!(out, "{probability:.4}"),
        None => writeln!(out),
    }
}

fn unmatched_cells<W: Write>(out: &mut W, row: &wire::Sample<'_>) -> io::Result<()> {
    let wire::BoundingBox { left_px, top_px, width_px, height_px } = row.bounding_box;
    write!(out, "{},{},", row.time, text_cell(row.target_id))?;
    write!(out, "{left_px},{top_px},{width_px},{height_px},")?;
    degrees(out, row.fix.map(|fix| fix.position()))?;
    cell(out, row.fix.and_then(|fix| fix.sigma_m))?;
    cell(out, row.class.map(text_cell))?;
    cell(out, row.score)?;
    match row.truth {
        Some(truth) => write!(out, "{:.8},{:.8}", truth.longitude_deg, truth.latitude_deg),
        None => write!(out, ","),
    }
}

const FUSED_COLUMNS: &str = "time,target_id,longitude,latitude,r95_m,regressed_longitude,regressed_latitude,\
                             gnss_longitude,gnss_latitude,gnss_sigma_m,confidence_regression,\
                             confidence_gnss,e_regression_m2,e_gnss_m2,reconstruction_error,\
                             model_version,flags";

fn fused_header<W: Write>(out: &mut W) -> io::Result<()> {
    writeln!(out, "{FUSED_COLUMNS}")
}

fn fused_cells<W: Write>(out: &mut W, row: &wire::FusedFix<'_>) -> io::Result<()> {
    write!(out, "{},{},", row.time, row.target_id.map(text_cell).unwrap_or_default())?;
    degrees(out, Some(row.fused))?;
    write!(out, "{},", row.r95_m)?;
    degrees(out, row.regressed)?;
    let fix = row.gnss;
    degrees(out, fix.map(|fix| fix.position()))?;
    cell(out, fix.and_then(|fix| fix.sigma_m))?;
    write!(out, "{},{},", row.confidence_regression, row.confidence_gnss)?;
    cell(out, row.e_regression_m2)?;
    cell(out, row.e_gnss_m2)?;
    cell(out, row.reconstruction_error)?;
    cell(out, row.model_version)?;
    writeln!(out, "{}", row.flags)
}

pub(super) fn degrees<W: Write>(out: &mut W, position: Option<wire::Position>) -> io::Result<()> {
    match position {
        Some(position) => write!(out, "{:.8},{:.8},", position.longitude_deg, position.latitude_deg),
        None => out.write_all(b",,"),
    }
}

/// An optional value, followed by a comma.
pub(super) fn cell<W: Write>(out: &mut W, value: Option<impl Display>) -> io::Result<()> {
    match value {
        Some(value) => write!(out, "{value},"),
        None => out.write_all(b","),
    }
}

/// A name as a cell. Names contain no control characters, so only commas and quotes require quoting.
pub(super) fn text_cell(name: &str) -> Cow<'_, str> {
    let name = guarded(name);
    if name.contains([',', '"']) { Cow::Owned(format!("\"{}\"", name.replace('"', "\"\""))) } else { name }
}

/// A GeoJSON feature: a point with properties; the geometry is null where there is no position (RFC 7946,
/// 3.2).
#[derive(Serialize)]
pub(super) struct Feature<P> {
    r#type: &'static str,
    geometry: Option<PointGeometry>,
    properties: P,
}

#[derive(Serialize)]
struct PointGeometry {
    r#type: &'static str,
    coordinates: [f64; 2],
}

impl<P> Feature<P> {
    pub(super) fn new(position: Option<wire::Position>, properties: P) -> Self {
        let geometry = position.map(|wire::Position { longitude_deg, latitude_deg }| PointGeometry {
            r#type: "Point",
            coordinates: [longitude_deg, latitude_deg],
        });
        Self { r#type: "Feature", geometry, properties }
    }
}
