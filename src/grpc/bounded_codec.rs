//! The codec of all RPCs: that of prost, for messages whose memory is bounded and charged before they are built.

use std::marker::PhantomData;

use prost::{Message, Name};
use tonic::Status;
use tonic::codec::{BufferSettings, Codec, DecodeBuf, Decoder};
use tonic_prost::{ProstDecoder, ProstEncoder};

use super::message_memory::{Misfit, decoded_bytes};
use crate::request::RequestContext;

/// Shorter messages are decoded at once: what they come to is within what a request counts as (16 KiB), or not much more.
const SHORT_BYTES: usize = 512;
/// The largest memory of the elements of a message, for each of its bytes, bytes.
const MEMORY_PER_BYTE: usize = 8;
/// The same whatever its length: a batch of a thousand short observations.
const FREE_MEMORY_BYTES: usize = 512 * 1024;

/// Encodes `E` and decodes `D`.
pub(super) struct BoundedCodec<E, D>(PhantomData<(E, D)>);

impl<E, D> Default for BoundedCodec<E, D> {
    fn default() -> Self {
        Self(PhantomData)
    }
}

impl<E, D> Codec for BoundedCodec<E, D>
where
    E: Message + Send + 'static,
    D: Message + Name + Default + Send + 'static,
{
    type Encode = E;
    type Decode = D;
    type Encoder = ProstEncoder<E>;
    type Decoder = BoundedDecoder<D>;

    fn encoder(&mut self) -> Self::Encoder {
        ProstEncoder::default()
    }

    fn decoder(&mut self) -> Self::Decoder {
        BoundedDecoder(ProstDecoder::default())
    }
}

pub(super) struct BoundedDecoder<D>(ProstDecoder<D>);

impl<D: Message + Name + Default> Decoder for BoundedDecoder<D> {
    type Item = D;
    type Error = Status;

    fn decode(&mut self, source: &mut DecodeBuf<'_>) -> Result<Option<D>, Status> {
        // The buffer is one slice.
        let message = bytes::Buf::chunk(source);
        if message.len() > SHORT_BYTES {
            admit::<D>(message)?;
        }
        self.0.decode(source)
    }

    fn buffer_settings(&self) -> BufferSettings {
        self.0.buffer_settings()
    }
}

/// Charges for what a message comes to.
fn admit<D: Name>(message: &[u8]) -> Result<(), Status> {
    let most = FREE_MEMORY_BYTES + MEMORY_PER_BYTE * message.len();
    let bytes = match decoded_bytes(&D::full_name(), message, most) {
        Ok(bytes) => bytes,
        // The decoder refuses it, with its reason.
        Err(Misfit::Malformed) => return Ok(()),
        Err(Misfit::TooLarge) => {
            return Err(Status::out_of_range(format!(
                "its elements come to more than {most} bytes in memory, {MEMORY_PER_BYTE} for each of its own and \
                 {FREE_MEMORY_BYTES} besides; send fewer at once"
            )));
        }
    };
    // Why is known, and reported, where requests are admitted.
    RequestContext::charge_decoded(bytes as u64)
        .map_err(|error| Status::resource_exhausted(error.to_string()))
}
