//! RTSP messages on a stream of bytes.

use bytes::{Buf as _, BufMut as _, BytesMut};
use rtsp_types::{Empty, Message, ParseError, Request};
use tokio_util::codec::{Decoder, Encoder};

use crate::connect::credentials::PeerError;

/// Longest message that is read: more than the 64 KiB of a packet, and than any description of a stream.
const MAX_MESSAGE_BYTES: usize = 128 << 10;

/// Reads the messages of a server and writes requests.
pub(super) struct Codec;

impl Decoder for Codec {
    type Item = Message<Vec<u8>>;
    type Error = PeerError;

    fn decode(&mut self, received: &mut BytesMut) -> Result<Option<Self::Item>, PeerError> {
        let missing = match Message::parse(&received[..]) {
            Ok((message, bytes)) => {
                received.advance(bytes);
                return Ok(Some(message));
            }
            Err(ParseError::Error) => return Err("the camera sent something else than RTSP".into()),
            Err(ParseError::Incomplete(missing)) => missing.map_or(1, usize::from),
        };
        if received.len().saturating_add(missing) > MAX_MESSAGE_BYTES {
            return Err(PeerError(format!("the camera sent more than {MAX_MESSAGE_BYTES} bytes at once")));
        }
        Ok(None)
    }
}

impl Encoder<Request<Empty>> for Codec {
    type Error = PeerError;

    fn encode(&mut self, request: Request<Empty>, out: &mut BytesMut) -> Result<(), PeerError> {
        request.write(&mut out.writer()).map_err(|error| PeerError(error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> Result<Option<Message<Vec<u8>>>, PeerError> {
        Codec.decode(&mut BytesMut::from(bytes))
    }

    #[test]
    fn no_message_makes_the_buffer_grow_without_end() {
        assert!(
            decoded(b"RTSP/1.0 200 OK\r\nCSeq: 1\r\nContent-Length: 10\r\n\r\n").is_ok_and(|it| it.is_none())
        );
        assert!(decoded(b"RTSP/1.0 200 OK\r\nCSeq: 1\r\nContent-Length: 1000000000000\r\n\r\n").is_err());
        let endless_header = [b"RTSP/1.0 200 OK\r\nServer: ".as_slice(), &[b'a'; MAX_MESSAGE_BYTES]].concat();
        assert!(decoded(&endless_header).is_err());
        let longest_packet = [b"$\x00\xff\xff".as_slice(), &[b'a'; 0xffff]].concat();
        assert!(decoded(&longest_packet).is_ok_and(|it| it.is_some()));
        assert!(decoded(b"HTTP/1.1 200 OK\r\n\r\n").is_err());
    }
}
