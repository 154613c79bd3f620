//! The files of a command: `-` is standard input or output, and the ending names format and compression.

use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use flate2::Compression;
use flate2::read::MultiGzDecoder;
use flate2::write::GzEncoder;

use super::output::StandardOutput;
use crate::exchange::{FixFormat, Format};

/// Level of zstd: its own default.
const ZSTD_LEVEL: i32 = 0;

/// How the content of a file is compressed, by its ending.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Coding {
    None,
    Gzip,
    Zstd,
}

/// True if a path stands for standard input or output.
pub(super) fn is_standard(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// The coding by the ending, and the path without that ending.
fn coding_of(path: &Path) -> (Coding, PathBuf) {
    let ending = path.extension().and_then(|ending| ending.to_str()).map(str::to_ascii_lowercase);
    let coding = match ending.as_deref() {
        Some("gz") => Coding::Gzip,
        Some("zst") => Coding::Zstd,
        _ => return (Coding::None, path.to_owned()),
    };
    (coding, path.with_extension(""))
}

/// A format as a flag names it.
pub(super) fn format(text: &str) -> Result<Format, String> {
    Format::from_path(Path::new(&format!("rows.{text}")))
        .ok_or_else(|| "must be csv, ndjson, json or geojson".to_owned())
}

/// The format of a file: the given one, else that of its ending; CSV for `-`.
pub(super) fn format_of(path: &Path, given: Option<Format>) -> anyhow::Result<Format> {
    if let Some(format) = given {
        return Ok(format);
    }
    if is_standard(path) {
        return Ok(Format::Csv);
    }
    Format::from_path(&coding_of(path).1).with_context(|| {
        let name = path.display();
        format!("{name}: the extension must be .csv, .ndjson, .jsonl, .json or .geojson, or one of these and .gz or .zst")
    })
}

/// The format of a file of fixes: the given one, else that of its ending; CSV for `-`.
pub(super) fn fix_format_of(path: &Path, given: Option<FixFormat>) -> Option<FixFormat> {
    let by_ending =
        || if is_standard(path) { Some(FixFormat::Csv) } else { FixFormat::from_path(&coding_of(path).1) };
    given.or_else(by_ending)
}

/// A file as it is stored, with its length in bytes if that is known.
pub(super) fn open_stored(path: &Path) -> anyhow::Result<(Box<dyn Read + Send>, Option<u64>)> {
    if is_standard(path) {
        return Ok((Box::new(io::stdin()), None));
    }
    let cannot = || format!("cannot open {}", path.display());
    let file = File::open(path).with_context(cannot)?;
    let attributes = file.metadata().with_context(cannot)?;
    anyhow::ensure!(!attributes.is_dir(), "{} is a folder", path.display());
    let length = attributes.is_file().then_some(attributes.len());
    Ok((Box::new(file), length))
}

/// The content of what is stored under a path.
pub(super) fn decoded(
    path: &Path,
    stored: impl Read + Send + 'static,
) -> anyhow::Result<Box<dyn Read + Send>> {
    Ok(match coding_of(path).0 {
        Coding::None => Box::new(stored),
        Coding::Gzip => Box::new(MultiGzDecoder::new(stored)),
        Coding::Zstd => Box::new(zstd::stream::read::Decoder::new(stored)?),
    })
}

/// Opens a file for reading; an error contains its name.
pub(super) fn open_input(path: &Path) -> anyhow::Result<Box<dyn Read + Send>> {
    decoded(path, open_stored(path)?.0)
}

/// A file that is written, compressed if its ending says so. What is not finished may be cut off.
pub(super) enum Output {
    Plain(Box<dyn Write>),
    Gzip(GzEncoder<Box<dyn Write>>),
    Zstd(zstd::stream::write::Encoder<'static, Box<dyn Write>>),
}

impl Output {
    /// Creates the file; an error contains its name.
    pub(super) fn create(path: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot write {}", path.display());
        let stored: Box<dyn Write> = if is_standard(path) {
            Box::new(BufWriter::new(StandardOutput))
        } else {
            Box::new(BufWriter::new(File::create(path).with_context(cannot)?))
        };
        Ok(match coding_of(path).0 {
            Coding::None => Self::Plain(stored),
            Coding::Gzip => Self::Gzip(GzEncoder::new(stored, Compression::default())),
            Coding::Zstd => {
                Self::Zstd(zstd::stream::write::Encoder::new(stored, ZSTD_LEVEL).with_context(cannot)?)
            }
        })
    }

    /// Writes what is still buffered.
    pub(super) fn finish(self) -> io::Result<()> {
        match self {
            Self::Plain(mut stored) => stored.flush(),
            Self::Gzip(coder) => coder.finish()?.flush(),
            Self::Zstd(coder) => coder.finish()?.flush(),
        }
    }
}

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Plain(stored) => stored.write(bytes),
            Self::Gzip(coder) => coder.write(bytes),
            Self::Zstd(coder) => coder.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Plain(stored) => stored.flush(),
            Self::Gzip(coder) => coder.flush(),
            Self::Zstd(coder) => coder.flush(),
        }
    }
}

/// Writes a whole text, and the folder that its file is in.
pub(super) fn write_text(path: &Path, text: &str) -> anyhow::Result<()> {
    let cannot = || format!("cannot write {}", path.display());
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    }
    let mut out = Output::create(path)?;
    out.write_all(text.as_bytes()).and_then(|()| out.finish()).with_context(cannot)
}
