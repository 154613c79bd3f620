//! Bounds the HTTP/2 frames that cost the server work but move neither a request nor its body.
//!
//! Floods of PING, SETTINGS, PRIORITY, WINDOW_UPDATE or unknown frames stay within every other limit.
//! Only the 9-byte frame headers (RFC 9113, 4.1) are read here, as the bytes pass.

use tokio::time::Instant;

use crate::admission::TokenBucket;

/// The first bytes of a client's HTTP/2 connection (RFC 9113, 3.4).
pub(super) const PREFACE: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

const FRAME_HEADER_BYTES: usize = 9;
const DATA: u8 = 0;
const HEADERS: u8 = 1;

/// Counts control frames by a token bucket.
pub(super) struct FrameLimit {
    position: Position,
    per_s: f64,
    bucket: TokenBucket,
}

/// Where among frames the client's next byte belongs.
enum Position {
    /// Number of bytes of the preface that were there.
    Preface(usize),
    /// Number of bytes of a frame header that were there.
    Header([u8; FRAME_HEADER_BYTES], usize),
    /// Number of bytes of a frame's payload that are still to come.
    Payload(usize),
    /// The connection speaks HTTP/1.
    NotHttp2,
}

impl FrameLimit {
    pub(super) fn new(per_s: u32) -> Self {
        let per_s = f64::from(per_s);
        Self { position: Position::Preface(0), per_s, bucket: TokenBucket::full(per_s, Instant::now()) }
    }

    /// Takes note of bytes that were read; whether the limit still holds.
    pub(super) fn allows(&mut self, bytes: &[u8]) -> bool {
        match self.control_frames(bytes) {
            0 => true,
            frames => self.bucket.take(frames.into(), self.per_s, Instant::now()),
        }
    }

    /// Number of control frames that begin in these bytes.
    fn control_frames(&mut self, mut bytes: &[u8]) -> u32 {
        let mut frames = 0;
        while !bytes.is_empty() {
            let taken = match &mut self.position {
                Position::NotHttp2 => return 0,
                Position::Preface(matched) => {
                    let taken = bytes.len().min(PREFACE.len() - *matched);
                    if bytes[..taken] != PREFACE[*matched..*matched + taken] {
                        self.position = Position::NotHttp2;
                        return 0;
                    }
                    *matched += taken;
                    if *matched == PREFACE.len() {
                        self.position = Position::Header([0; FRAME_HEADER_BYTES], 0);
                    }
                    taken
                }
                Position::Header(header, filled) => {
                    let taken = bytes.len().min(FRAME_HEADER_BYTES - *filled);
                    header[*filled..*filled + taken].copy_from_slice(&bytes[..taken]);
                    *filled += taken;
                    if *filled == FRAME_HEADER_BYTES {
                        let payload = u32::from_be_bytes([0, header[0], header[1], header[2]]);
                        frames += u32::from(is_control(header[3], payload));
                        self.position = Position::after_header(payload as usize);
                    }
                    taken
                }
                Position::Payload(left) => {
                    let taken = bytes.len().min(*left);
                    *left -= taken;
                    if *left == 0 {
                        self.position = Position::Header([0; FRAME_HEADER_BYTES], 0);
                    }
                    taken
                }
            };
            bytes = &bytes[taken..];
        }
        frames
    }
}

impl Position {
    const fn after_header(payload: usize) -> Self {
        if payload == 0 { Self::Header([0; FRAME_HEADER_BYTES], 0) } else { Self::Payload(payload) }
    }
}

/// Requests have limits of their own, and data is what bodies are made of; data without a byte is not.
const fn is_control(kind: u8, payload: u32) -> bool {
    !(kind == HEADERS || kind == DATA && payload > 0)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn frame(kind: u8, payload: usize) -> Vec<u8> {
        let length = u32::try_from(payload).expect("short").to_be_bytes();
        let mut frame = vec![length[1], length[2], length[3], kind, 0, 0, 0, 0, 1];
        frame.resize(FRAME_HEADER_BYTES + payload, kind);
        frame
    }

    proptest! {
        #[test]
        fn control_frames_are_counted_however_the_bytes_are_cut(
            frames in prop::collection::vec((0_u8..12, 0_usize..40), 0..30),
            cut in 1_usize..50,
        ) {
            let mut bytes = PREFACE.to_vec();
            frames.iter().for_each(|&(kind, payload)| bytes.extend(frame(kind, payload)));
            let expected = frames.iter().filter(|&&(kind, payload)| kind > 1 || kind == 0 && payload == 0);
            let mut limit = FrameLimit::new(1);
            let counted: u32 = bytes.chunks(cut).map(|part| limit.control_frames(part)).sum();
            prop_assert_eq!(counted as usize, expected.count());
        }
    }

    #[test]
    fn http_1_is_left_alone() {
        let mut limit = FrameLimit::new(1);
        let request = b"PUT / HTTP/1.1\r\nhost: a\r\n\r\n".repeat(100);
        assert!(request.chunks(7).all(|part| limit.allows(part)));
    }
}
