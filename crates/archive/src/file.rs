//! One file of positions: GeoParquet, written and read a group of rows at a time.

use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use bytes::{Buf as _, Bytes};
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::metadata::{
    ColumnChunkMetaData, KeyValue, ParquetMetaData, ParquetMetaDataReader, RowGroupMetaData,
};
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::file::reader::{ChunkReader, Length};
use parquet::file::serialized_reader::SerializedPageReader;
use parquet::file::statistics::Statistics;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::ColumnPath;

use crate::columns::{self, Columns, nanoseconds, schema};
use crate::domain::{ArchivedPosition, Error, Result, TrackScope};
use crate::selection::Selection;

/// Rows that are written, pruned by statistics and read together.
pub(crate) const GROUP_ROWS: usize = 8_192;
/// What is read from the end of a file at first, bytes: the footer of a file of a million rows is smaller.
const FOOTER_BYTES: u64 = 64 * 1024;

/// What GeoParquet 1.1 asks of a file: which column is the geometry, and how it is written. Without `crs`, coordinates
/// are longitude and latitude of WGS 84.
const GEO: &str = r#"{"version":"1.1.0","primary_column":"geometry","columns":{"geometry":{"encoding":"point","geometry_types":["Point"]}}}"#;

/// The bytes that were written and not taken yet.
#[derive(Debug, Clone, Default)]
struct Output(Arc<Mutex<Vec<u8>>>);

impl Output {
    fn take(&self) -> Vec<u8> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl std::io::Write for Output {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Writes a file whose bytes are taken while it grows.
pub struct FileWriter {
    scope: TrackScope,
    writer: SerializedFileWriter<Output>,
    output: Output,
    waiting: Vec<ArchivedPosition>,
}

impl FileWriter {
    /// An empty file.
    ///
    /// # Errors
    /// A fault of the library.
    pub fn new(scope: TrackScope) -> Result<Self> {
        let output = Output::default();
        let root = schema()?.root_schema_ptr();
        let writer = SerializedFileWriter::new(output.clone(), root, properties()?.into());
        Ok(Self { scope, writer: writer.map_err(Error::fault)?, output, waiting: Vec::new() })
    }

    /// Adds a row and returns the bytes that are complete, mostly none.
    ///
    /// # Errors
    /// A fault of the library.
    pub fn push(&mut self, row: ArchivedPosition) -> Result<Vec<u8>> {
        self.waiting.push(row);
        if self.waiting.len() >= GROUP_ROWS {
            self.write_group()?;
        }
        Ok(self.output.take())
    }

    /// The rest of the file.
    ///
    /// # Errors
    /// A fault of the library.
    pub fn finish(mut self) -> Result<Vec<u8>> {
        self.write_group()?;
        self.writer.finish().map_err(Error::fault)?;
        Ok(self.output.take())
    }

    fn write_group(&mut self) -> Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        let columns = Columns::of(&self.scope, &self.waiting);
        self.waiting.clear();
        let mut group = self.writer.next_row_group().map_err(Error::fault)?;
        columns.write(&mut group).map_err(Error::fault)?;
        group.close().map_err(Error::fault)?;
        Ok(())
    }
}

/// Numbers are split into their bytes, which compresses them twice as well as whole; texts repeat, so they become
/// dictionaries.
fn properties() -> Result<WriterProperties> {
    let mut properties = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(1).map_err(Error::fault)?))
        .set_statistics_enabled(EnabledStatistics::Chunk)
        .set_offset_index_disabled(true)
        .set_created_by("sightfix".to_owned())
        .set_key_value_metadata(Some(vec![KeyValue::new("geo".to_owned(), GEO.to_owned())]));
    for column in schema()?.columns() {
        let path = || ColumnPath::new(column.path().parts().to_vec());
        let encoding = match column.physical_type() {
            parquet::basic::Type::INT64 => Encoding::DELTA_BINARY_PACKED,
            parquet::basic::Type::FLOAT | parquet::basic::Type::DOUBLE => Encoding::BYTE_STREAM_SPLIT,
            _ => continue,
        };
        properties =
            properties.set_column_dictionary_enabled(path(), false).set_column_encoding(path(), encoding);
    }
    Ok(properties.build())
}

/// A part of a file.
#[derive(Clone)]
struct Section {
    start: u64,
    bytes: Bytes,
}

impl Length for Section {
    fn len(&self) -> u64 {
        self.start + self.bytes.len() as u64
    }
}

impl ChunkReader for Section {
    type T = bytes::buf::Reader<Bytes>;

    fn get_read(&self, start: u64) -> parquet::errors::Result<Self::T> {
        let length = Length::len(self).saturating_sub(start);
        Ok(self.get_bytes(start, usize::try_from(length).unwrap_or(usize::MAX))?.reader())
    }

    fn get_bytes(&self, start: u64, length: usize) -> parquet::errors::Result<Bytes> {
        let begin = start.checked_sub(self.start).and_then(|begin| usize::try_from(begin).ok());
        let range = begin.and_then(|begin| Some(begin..begin.checked_add(length)?));
        range
            .filter(|range| range.end <= self.bytes.len())
            .map(|range| self.bytes.slice(range))
            .ok_or_else(|| ParquetError::EOF("a part of a file ends outside of what was read".to_owned()))
    }
}

/// The footer of a file: where its groups of rows are, and what their statistics say.
pub(crate) struct Footer(ParquetMetaData);

impl Footer {
    /// Reads the footer of a file of `size` bytes, whose parts `fetch` returns.
    pub(crate) fn read(size: u64, mut fetch: impl FnMut(Range<u64>) -> Result<Bytes>) -> Result<Self> {
        let mut reader = ParquetMetaDataReader::new();
        let mut wanted = FOOTER_BYTES.min(size);
        loop {
            let tail = fetch(size - wanted..size)?;
            match reader.try_parse_sized(&tail, size) {
                Ok(()) => return Ok(Self(reader.finish().map_err(Error::fault)?)),
                Err(ParquetError::NeedMoreData(more)) if more as u64 > wanted && more as u64 <= size => {
                    wanted = more as u64;
                }
                Err(error) => return Err(Error::fault(error)),
            }
        }
    }

    /// The groups that may contain rows of a selection, by their statistics.
    pub(crate) fn groups(&self, selection: &Selection) -> Vec<usize> {
        let groups = self.0.row_groups().iter().enumerate();
        groups.filter(|(_, group)| may_contain(group, selection)).map(|(at, _)| at).collect()
    }

    /// Reads the rows of a group.
    pub(crate) fn read_group(
        &self,
        group: usize,
        fetch: impl FnOnce(Range<u64>) -> Result<Bytes>,
    ) -> Result<Vec<ArchivedPosition>> {
        let damaged = || Error::fault("a group of rows in a file of the archive is damaged");
        let group = self.0.row_groups().get(group).ok_or_else(damaged)?;
        let ranges = || group.columns().iter().map(ColumnChunkMetaData::byte_range);
        let start = ranges().map(|(start, _)| start).min().ok_or_else(damaged)?;
        let end = ranges().map(|(start, length)| start + length).max().ok_or_else(damaged)?;
        let section = Arc::new(Section { start, bytes: fetch(start..end)? });
        let rows = usize::try_from(group.num_rows()).map_err(Error::fault)?;
        let pages = |column: usize| -> parquet::errors::Result<_> {
            let chunk = group.columns().get(column);
            let chunk = chunk.ok_or_else(|| ParquetError::General("a column is missing".to_owned()))?;
            Ok(Box::new(SerializedPageReader::new(section.clone(), chunk, rows, None)?) as _)
        };
        Columns::read(rows, pages)?.rows()
    }
}

fn may_contain(group: &RowGroupMetaData, selection: &Selection) -> bool {
    let statistics = |column: usize| group.columns().get(column).and_then(ColumnChunkMetaData::statistics);
    let may_have = |column, text: &str| statistics(column).is_none_or(|it| may_have_text(it, text));
    let times = match statistics(columns::TIME) {
        Some(Statistics::Int64(times)) => times.min_opt().copied().zip(times.max_opt().copied()),
        _ => None,
    };
    let doubles = |column| match statistics(column) {
        Some(Statistics::Double(values)) => Some([*values.min_opt()?, *values.max_opt()?]),
        _ => None,
    };
    let coordinates = doubles(columns::LONGITUDE).zip(doubles(columns::LATITUDE));
    times.is_none_or(|(first, last)| {
        selection.from.is_none_or(|from| nanoseconds(from) <= last)
            && selection.until.is_none_or(|until| nanoseconds(until) > first)
    }) && selection.area.zip(coordinates).is_none_or(|(area, (east, north))| area.may_contain(east, north))
        && selection.class.as_ref().is_none_or(|class| may_have(columns::CLASS, class.as_str()))
        && selection.track.as_ref().is_none_or(|track| may_have(columns::TRACK, track))
        && (selection.targets.is_empty()
            || selection.targets.iter().any(|target| may_have(columns::TARGET, target.as_str()))
            || selection.tracks_of_targets.iter().any(|track| may_have(columns::TRACK, track)))
}

/// False if a column has no such text. A column in which no row has a value states no bounds.
fn may_have_text(statistics: &Statistics, text: &str) -> bool {
    match (statistics.min_bytes_opt(), statistics.max_bytes_opt()) {
        (Some(first), Some(last)) => first <= text.as_bytes() && text.as_bytes() <= last,
        _ => true,
    }
}
