//! Rows as columns of a Parquet file: the schema, and both directions of the conversion.

use std::sync::LazyLock;

use jiff::Timestamp;
use parquet::column::page::PageReader;
use parquet::column::reader::{get_column_reader, get_typed_column_reader};
use parquet::data_type::{ByteArray, ByteArrayType, DataType, DoubleType, FloatType, Int64Type};
use parquet::file::writer::SerializedRowGroupWriter;
use parquet::schema::parser::parse_message_type;
use parquet::schema::types::{ColumnDescPtr, SchemaDescriptor};

use crate::domain::{
    Acceleration, ArchivedPosition, Course, Error, Motion, Result, TargetClass, TargetId, TrackScope,
};
use crate::geo::{PlaneCovariance, Position};

const MESSAGE: &str = "message positions {
    required int64 time (TIMESTAMP(NANOS, true));
    optional binary camera_id (STRING);
    optional binary site_id (STRING);
    required binary track_id (STRING);
    optional binary target_id (STRING);
    optional binary class (STRING);
    required group geometry { required double x; required double y; }
    required float covariance_east_m2;
    required float covariance_north_m2;
    required float covariance_east_north_m2;
    required float speed_mps;
    required float speed_low_mps;
    required float speed_high_mps;
    optional float course_deg;
    optional float course_low_deg;
    optional float course_high_deg;
    required float stationary_probability;
    optional float acceleration_east_mps2;
    optional float acceleration_north_mps2;
    optional float acceleration_covariance_east_m2_s4;
    optional float acceleration_covariance_north_m2_s4;
    optional float acceleration_covariance_east_north_m2_s4;
}";

/// The positions of columns that statistics are read of.
pub(crate) const TIME: usize = 0;
pub(crate) const TRACK: usize = 3;
pub(crate) const TARGET: usize = 4;
pub(crate) const CLASS: usize = 5;
pub(crate) const LONGITUDE: usize = 6;
pub(crate) const LATITUDE: usize = 7;

/// The schema of a file; an error only if [`MESSAGE`] is none.
pub(crate) static SCHEMA: LazyLock<Result<SchemaDescriptor, String>> = LazyLock::new(|| {
    let message = parse_message_type(MESSAGE).map_err(|error| error.to_string())?;
    Ok(SchemaDescriptor::new(message.into()))
});

pub(crate) fn schema() -> Result<&'static SchemaDescriptor> {
    SCHEMA.as_ref().map_err(|message| Error::fault(message.as_str()))
}

/// The values of one column, `None` where a row has none.
enum Values {
    Integer(Vec<i64>),
    Text(Vec<Option<ByteArray>>),
    Double(Vec<f64>),
    Float(Vec<Option<f32>>),
}

/// The columns of some rows, in the order of the schema.
pub(crate) struct Columns(Vec<Values>);

impl Columns {
    pub(crate) fn of(scope: &TrackScope, rows: &[ArchivedPosition]) -> Self {
        let text = |value: &dyn Fn(&ArchivedPosition) -> Option<String>| {
            Values::Text(rows.iter().map(|row| value(row).map(|text| text.as_str().into())).collect())
        };
        let float = |value: &dyn Fn(&ArchivedPosition) -> f64| {
            Values::Float(rows.iter().map(|row| Some(value(row) as f32)).collect())
        };
        let course = |value: &dyn Fn(Course) -> f64| {
            Values::Float(rows.iter().map(|row| row.motion.course.map(|it| value(it) as f32)).collect())
        };
        let acceleration = |value: &dyn Fn(Acceleration) -> f64| {
            Values::Float(rows.iter().map(|row| row.acceleration.map(|it| value(it) as f32)).collect())
        };
        Self(vec![
            Values::Integer(rows.iter().map(|row| nanoseconds(row.time)).collect()),
            text(&|_| scope.camera().map(ToString::to_string)),
            text(&|_| scope.site().map(ToString::to_string)),
            text(&|row| Some(row.track.clone())),
            text(&|row| row.target.as_ref().map(|it| it.as_str().to_owned())),
            text(&|row| row.class.as_ref().map(|it| it.as_str().to_owned())),
            Values::Double(rows.iter().map(|row| row.position.longitude_deg()).collect()),
            Values::Double(rows.iter().map(|row| row.position.latitude_deg()).collect()),
            float(&|row| row.covariance_m2.east_m2),
            float(&|row| row.covariance_m2.north_m2),
            float(&|row| row.covariance_m2.east_north_m2),
            float(&|row| row.motion.speed_mps),
            float(&|row| row.motion.speed_interval_mps[0]),
            float(&|row| row.motion.speed_interval_mps[1]),
            course(&|course| course.deg),
            course(&|course| course.interval_deg[0]),
            course(&|course| course.interval_deg[1]),
            float(&|row| row.motion.stationary_probability),
            acceleration(&|it| it.east_m_s2),
            acceleration(&|it| it.north_m_s2),
            acceleration(&|it| it.covariance.east_m2),
            acceleration(&|it| it.covariance.north_m2),
            acceleration(&|it| it.covariance.east_north_m2),
        ])
    }

    pub(crate) fn write<W: std::io::Write + Send>(
        &self,
        group: &mut SerializedRowGroupWriter<'_, W>,
    ) -> parquet::errors::Result<()> {
        for (values, descriptor) in self.0.iter().zip(schema_columns()) {
            let is_optional = descriptor.max_def_level() > 0;
            match values {
                Values::Integer(values) => write::<Int64Type, _>(group, values, None),
                Values::Double(values) => write::<DoubleType, _>(group, values, None),
                Values::Text(values) => write_optional::<ByteArrayType, _>(group, values, is_optional),
                Values::Float(values) => write_optional::<FloatType, _>(group, values, is_optional),
            }?;
        }
        Ok(())
    }

    /// Reads all columns of a group of rows, each with its pages.
    pub(crate) fn read(
        rows: usize,
        mut pages: impl FnMut(usize) -> parquet::errors::Result<Box<dyn PageReader>>,
    ) -> Result<Self> {
        let column = |(at, descriptor): (usize, &ColumnDescPtr)| {
            let values = read_column(rows, descriptor, pages(at).map_err(Error::fault)?)?;
            Ok(values)
        };
        Ok(Self(schema_columns().iter().enumerate().map(column).collect::<Result<_>>()?))
    }

    /// The rows, in their order.
    pub(crate) fn rows(&self) -> Result<Vec<ArchivedPosition>> {
        let Some(Values::Integer(times)) = self.0.first() else { return Err(damaged()) };
        (0..times.len()).map(|at| self.row(at)).collect()
    }

    fn row(&self, at: usize) -> Result<ArchivedPosition> {
        let mut cells = Cells { columns: self.0.iter(), at };
        let time = Timestamp::from_nanosecond(cells.integer()?.into()).map_err(Error::fault)?;
        let (_camera, _site) = (cells.text()?, cells.text()?);
        let track = cells.text()?.ok_or_else(damaged)?.to_owned();
        let target = cells.text()?.map(TargetId::new).transpose()?;
        let class = cells.text()?.map(TargetClass::new).transpose()?;
        let (longitude_deg, latitude_deg) = (cells.double()?, cells.double()?);
        let position = Position::new(longitude_deg, latitude_deg).map_err(Error::fault)?;
        let [east_m2, north_m2, east_north_m2] = cells.floats()?;
        let [speed_mps, low_mps, high_mps] = cells.floats()?;
        let course = [cells.float()?, cells.float()?, cells.float()?];
        let course = match course {
            [Some(deg), Some(from), Some(to)] => Some(Course { deg, interval_deg: [from, to] }),
            _ => None,
        };
        let [stationary_probability] = cells.floats()?;
        let speed_interval_mps = [low_mps, high_mps];
        Ok(ArchivedPosition {
            time,
            track,
            target,
            class,
            position,
            covariance_m2: PlaneCovariance { east_m2, north_m2, east_north_m2 },
            motion: Motion { speed_mps, speed_interval_mps, course, stationary_probability },
            acceleration: cells.acceleration()?,
        })
    }
}

/// The cells of one row, in the order of the schema.
struct Cells<'a> {
    columns: std::slice::Iter<'a, Values>,
    at: usize,
}

impl<'a> Cells<'a> {
    fn integer(&mut self) -> Result<i64> {
        match self.columns.next() {
            Some(Values::Integer(values)) => values.get(self.at).copied().ok_or_else(damaged),
            _ => Err(damaged()),
        }
    }

    fn text(&mut self) -> Result<Option<&'a str>> {
        match self.columns.next() {
            Some(Values::Text(values)) => {
                let cell = values.get(self.at).ok_or_else(damaged)?;
                cell.as_ref().map(|text| text.as_utf8().map_err(Error::fault)).transpose()
            }
            _ => Err(damaged()),
        }
    }

    fn double(&mut self) -> Result<f64> {
        match self.columns.next() {
            Some(Values::Double(values)) => values.get(self.at).copied().ok_or_else(damaged),
            _ => Err(damaged()),
        }
    }

    fn float(&mut self) -> Result<Option<f64>> {
        match self.columns.next() {
            Some(Values::Float(values)) => Ok(values.get(self.at).ok_or_else(damaged)?.map(widened)),
            _ => Err(damaged()),
        }
    }

    fn floats<const N: usize>(&mut self) -> Result<[f64; N]> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.float()?.ok_or_else(damaged)?;
        }
        Ok(numbers)
    }

    fn acceleration(&mut self) -> Result<Option<Acceleration>> {
        let numbers = [self.float()?, self.float()?, self.float()?, self.float()?, self.float()?];
        let [Some(east_m_s2), Some(north_m_s2), Some(east_m2), Some(north_m2), Some(east_north_m2)] = numbers
        else {
            return Ok(None);
        };
        let covariance = PlaneCovariance { east_m2, north_m2, east_north_m2 };
        Ok(Some(Acceleration { east_m_s2, north_m_s2, covariance }))
    }
}

fn schema_columns() -> &'static [ColumnDescPtr] {
    SCHEMA.as_ref().map_or(&[], SchemaDescriptor::columns)
}

fn damaged() -> Error {
    Error::fault("a file of the archive does not have the columns of positions")
}

/// Nanoseconds since 1970; an instant that they cannot express becomes the nearest that they can.
pub(crate) fn nanoseconds(time: Timestamp) -> i64 {
    let nanoseconds = time.as_nanosecond();
    nanoseconds.clamp(i64::MIN.into(), i64::MAX.into()) as i64
}

/// A number of single precision with the seven digits that it has, instead of those that double precision adds.
fn widened(value: f32) -> f64 {
    let value = f64::from(value);
    if value == 0.0 || !value.is_finite() {
        return value;
    }
    let digits = 6 - value.abs().log10().floor() as i32;
    let scale = 10_f64.powi(digits.abs());
    if digits < 0 { (value / scale).round() * scale } else { (value * scale).round() / scale }
}

fn write<T: DataType, W: std::io::Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    values: &[T::T],
    levels: Option<&[i16]>,
) -> parquet::errors::Result<()> {
    let Some(mut column) = group.next_column()? else {
        return Err(parquet::errors::ParquetError::General("a column more than the schema has".to_owned()));
    };
    column.typed::<T>().write_batch(values, levels, None)?;
    column.close()
}

fn write_optional<T: DataType, W: std::io::Write + Send>(
    group: &mut SerializedRowGroupWriter<'_, W>,
    values: &[Option<T::T>],
    is_optional: bool,
) -> parquet::errors::Result<()> {
    let present: Vec<T::T> = values.iter().flatten().cloned().collect();
    let levels: Vec<i16> = values.iter().map(|value| i16::from(value.is_some())).collect();
    write::<T, W>(group, &present, is_optional.then_some(&levels))
}

fn read_column(rows: usize, descriptor: &ColumnDescPtr, pages: Box<dyn PageReader>) -> Result<Values> {
    use parquet::basic::Type;
    Ok(match descriptor.physical_type() {
        Type::INT64 => Values::Integer(read_all::<Int64Type>(rows, descriptor, pages)?),
        Type::DOUBLE => Values::Double(read_all::<DoubleType>(rows, descriptor, pages)?),
        Type::FLOAT => Values::Float(read_optional::<FloatType>(rows, descriptor, pages)?),
        Type::BYTE_ARRAY => Values::Text(read_optional::<ByteArrayType>(rows, descriptor, pages)?),
        _ => return Err(damaged()),
    })
}

fn read_all<T: DataType>(
    rows: usize,
    descriptor: &ColumnDescPtr,
    pages: Box<dyn PageReader>,
) -> Result<Vec<T::T>> {
    let values: Vec<Option<T::T>> = read_optional::<T>(rows, descriptor, pages)?;
    values.into_iter().map(|value| value.ok_or_else(damaged)).collect()
}

fn read_optional<T: DataType>(
    rows: usize,
    descriptor: &ColumnDescPtr,
    pages: Box<dyn PageReader>,
) -> Result<Vec<Option<T::T>>> {
    let mut column = get_typed_column_reader::<T>(get_column_reader(descriptor.clone(), pages));
    let is_optional = descriptor.max_def_level() > 0;
    let (mut values, mut levels) = (Vec::new(), Vec::new());
    let mut read = 0;
    while read < rows {
        let wanted = is_optional.then_some(&mut levels);
        let (more, ..) = column.read_records(rows - read, wanted, None, &mut values).map_err(Error::fault)?;
        if more == 0 {
            return Err(damaged());
        }
        read += more;
    }
    let mut values = values.into_iter();
    if is_optional {
        Ok(levels.iter().map(|level| if *level > 0 { values.next() } else { None }).collect())
    } else {
        Ok(values.map(Some).collect())
    }
}
