//! Decompression that ends at a limit: a hundred kilobytes of zeros may stand for hundreds of megabytes.

use std::io::Read;

use flate2::read::MultiGzDecoder;
use lz4_flex::frame::FrameDecoder;

/// The compression of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::Display)]
#[strum(serialize_all = "lowercase")]
pub(super) enum Codec {
    Gzip,
    Snappy,
    Lz4,
    Zstd,
}

impl Codec {
    /// The codec that the attributes of a batch name; none where it is not compressed.
    pub(super) fn from_bits(bits: i16) -> Result<Option<Self>, String> {
        match bits {
            0 => Ok(None),
            1 => Ok(Some(Self::Gzip)),
            2 => Ok(Some(Self::Snappy)),
            3 => Ok(Some(Self::Lz4)),
            4 => Ok(Some(Self::Zstd)),
            _ => Err(format!("the batch is compressed by an unknown codec, {bits}")),
        }
    }
}

/// Why bytes are not decompressed.
#[derive(Debug, thiserror::Error)]
enum Undecoded {
    #[error("is larger")]
    Large,
    #[error(transparent)]
    Damaged(#[from] std::io::Error),
}

impl From<snap::Error> for Undecoded {
    fn from(error: snap::Error) -> Self {
        Self::Damaged(error.into())
    }
}

/// Decompresses to at most `most_bytes`; fails when the content would become larger.
///
/// # Errors
/// It is larger, or damaged.
pub(super) fn decompress(codec: Codec, content: &[u8], most_bytes: usize) -> Result<Vec<u8>, String> {
    let done = match codec {
        Codec::Gzip => bounded(MultiGzDecoder::new(content), most_bytes),
        Codec::Snappy => snappy(content, most_bytes),
        Codec::Lz4 => bounded(FrameDecoder::new(content), most_bytes),
        Codec::Zstd => zstd::Decoder::with_buffer(content)
            .map_err(Undecoded::from)
            .and_then(|decoder| bounded(decoder, most_bytes)),
    };
    done.map_err(|error| match error {
        Undecoded::Large => format!("the batch becomes more than {most_bytes} bytes when decompressed"),
        Undecoded::Damaged(error) => format!("the batch cannot be decompressed by {codec}: {error}"),
    })
}

fn bounded(decoder: impl Read, most_bytes: usize) -> Result<Vec<u8>, Undecoded> {
    let mut decoded = Vec::new();
    decoder.take(most_bytes as u64 + 1).read_to_end(&mut decoded)?;
    if decoded.len() > most_bytes { Err(Undecoded::Large) } else { Ok(decoded) }
}

/// The start of blocks as Java's producers frame them, with two numbers of versions; librdkafka writes one block alone.
const BLOCKS_MAGIC: &[u8] = b"\x82SNAPPY\0";
const BLOCKS_HEADER_BYTES: usize = BLOCKS_MAGIC.len() + 8;

fn snappy(content: &[u8], most_bytes: usize) -> Result<Vec<u8>, Undecoded> {
    let mut decoded = Vec::new();
    if !content.starts_with(BLOCKS_MAGIC) {
        add_block(&mut decoded, content, most_bytes)?;
        return Ok(decoded);
    }
    let mut blocks = content.get(BLOCKS_HEADER_BYTES..).unwrap_or_default();
    while let Some((length, rest)) = blocks.split_first_chunk() {
        let length = u32::from_be_bytes(*length) as usize;
        let (block, rest) =
            rest.split_at_checked(length).ok_or(std::io::Error::from(std::io::ErrorKind::UnexpectedEof))?;
        add_block(&mut decoded, block, most_bytes)?;
        blocks = rest;
    }
    Ok(decoded)
}

/// Adds what a block contains. The block says how much that is, and no decoder writes more.
fn add_block(decoded: &mut Vec<u8>, block: &[u8], most_bytes: usize) -> Result<(), Undecoded> {
    let (start, length) = (decoded.len(), snap::raw::decompress_len(block)?);
    if length > most_bytes - start {
        return Err(Undecoded::Large);
    }
    decoded.resize(start + length, 0);
    snap::raw::Decoder::new().decompress(block, &mut decoded[start..])?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    fn gzip(content: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(content).expect("written");
        encoder.finish().expect("written")
    }

    fn lz4(content: &[u8]) -> Vec<u8> {
        let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
        encoder.write_all(content).expect("written");
        encoder.finish().expect("written")
    }

    fn framed_snappy(content: &[u8]) -> Vec<u8> {
        let blocks = content.chunks(100).map(|chunk| snap::raw::Encoder::new().compress_vec(chunk));
        let mut framed = [BLOCKS_MAGIC, &[0, 0, 0, 1, 0, 0, 0, 1]].concat();
        for block in blocks.map(|block| block.expect("compressed")) {
            framed.extend(u32::try_from(block.len()).expect("short").to_be_bytes());
            framed.extend(block);
        }
        framed
    }

    #[test]
    fn content_of_exactly_the_limit_is_taken_and_one_byte_more_is_not() {
        let content = b"a record of a camera ".repeat(50);
        let raw_snappy = snap::raw::Encoder::new().compress_vec(&content).expect("compressed");
        let zstd = zstd::encode_all(&content[..], 0).expect("compressed");
        for (codec, compressed) in [
            (Codec::Gzip, gzip(&content)),
            (Codec::Snappy, raw_snappy),
            (Codec::Snappy, framed_snappy(&content)),
            (Codec::Lz4, lz4(&content)),
            (Codec::Zstd, zstd),
        ] {
            assert_eq!(decompress(codec, &compressed, content.len()).as_ref(), Ok(&content), "{codec}");
            let refused = decompress(codec, &compressed, content.len() - 1).expect_err("it is larger");
            assert!(refused.contains("1049 bytes"), "{codec}: {refused}");
            let cut = decompress(codec, &compressed[..compressed.len() - 9], content.len());
            assert!(cut.expect_err("it is cut").contains(&codec.to_string()), "{codec}");
        }
    }

    #[test]
    fn a_block_of_snappy_that_announces_gigabytes_takes_no_memory() {
        let announced = [0xff, 0xff, 0xff, 0xff, 0x0f, 0];
        assert!(decompress(Codec::Snappy, &announced, 1_000).is_err());
        let framed = [BLOCKS_MAGIC, &[0; 8], &u32::MAX.to_be_bytes()].concat();
        assert!(decompress(Codec::Snappy, &framed, 1_000).is_err());
    }
}
