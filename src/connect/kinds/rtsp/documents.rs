//! XML documents from RTP packets: the packet with the marker ends a document (ONVIF Streaming Specification, 5.1.2.1.1).

use bytes::{Bytes, BytesMut};

use crate::connect::credentials::PeerError;

/// A document of the stream.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Document {
    Complete {
        /// The document, or its beginning where it is larger than is taken.
        content: Bytes,
        /// Bytes of the whole document.
        size_bytes: usize,
    },
    /// A packet of it is missing.
    Damaged,
}

/// Puts documents together, of which at most `max_bytes` are kept.
pub(super) struct Documents {
    max_bytes: usize,
    content: BytesMut,
    size_bytes: usize,
    is_damaged: bool,
    next_sequence: Option<u16>,
}

impl Documents {
    pub(super) fn new(max_bytes: usize) -> Self {
        Self { max_bytes, content: BytesMut::new(), size_bytes: 0, is_damaged: false, next_sequence: None }
    }

    /// Adds a packet, and returns the document that it ends.
    ///
    /// # Errors
    /// It is not a packet of RTP.
    pub(super) fn add(&mut self, packet: &[u8]) -> Result<Option<Document>, PeerError> {
        let packet = Packet::read(packet).ok_or("the camera sent something else than a packet of RTP")?;
        self.is_damaged |= match self.next_sequence {
            Some(expected) => packet.sequence != expected,
            // Who joins a stream may come in the middle of a document.
            None => !packet.payload.trim_ascii_start().starts_with(b"<"),
        };
        self.next_sequence = Some(packet.sequence.wrapping_add(1));
        self.size_bytes = self.size_bytes.saturating_add(packet.payload.len());
        let kept = packet.payload.len().min(self.max_bytes.saturating_sub(self.content.len()));
        self.content.extend_from_slice(&packet.payload[..kept]);
        if !packet.is_last {
            return Ok(None);
        }
        let content = self.content.split().freeze();
        let size_bytes = std::mem::take(&mut self.size_bytes);
        let is_damaged = std::mem::take(&mut self.is_damaged);
        Ok(Some(if is_damaged { Document::Damaged } else { Document::Complete { content, size_bytes } }))
    }
}

/// The parts of a packet that are used (RFC 3550, 5.1).
struct Packet<'a> {
    is_last: bool,
    sequence: u16,
    payload: &'a [u8],
}

impl<'a> Packet<'a> {
    fn read(packet: &'a [u8]) -> Option<Self> {
        let (&[flags, marker_and_type, high, low, ..], _) = packet.split_first_chunk::<12>()?;
        let (version, has_padding, has_extension) = (flags >> 6, flags & 0x20 != 0, flags & 0x10 != 0);
        let mut payload = packet.get(12 + 4 * usize::from(flags & 0x0f)..)?;
        if has_extension {
            let (&[_, _, high, low], extension) = payload.split_first_chunk::<4>()?;
            payload = extension.get(4 * usize::from(u16::from_be_bytes([high, low]))..)?;
        }
        if has_padding {
            let padding = usize::from(*payload.last()?);
            payload = &payload[..payload.len().checked_sub(padding)?];
        }
        let is_last = marker_and_type & 0x80 != 0;
        (version == 2).then_some(Self { is_last, sequence: u16::from_be_bytes([high, low]), payload })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(sequence: u16, is_last: bool, payload: &str) -> Vec<u8> {
        let [high, low] = sequence.to_be_bytes();
        let header = [0x80, if is_last { 0x80 | 107 } else { 107 }, high, low, 0, 0, 0, 0, 0, 0, 0, 1];
        [&header[..], payload.as_bytes()].concat()
    }

    fn complete(content: &'static str) -> Option<Document> {
        Some(Document::Complete {
            content: Bytes::from_static(content.as_bytes()),
            size_bytes: content.len(),
        })
    }

    fn added(documents: &mut Documents, sequence: u16, is_last: bool, payload: &str) -> Option<Document> {
        documents.add(&packet(sequence, is_last, payload)).expect("a packet of RTP")
    }

    #[test]
    fn a_document_ends_with_the_marker_and_needs_all_of_its_packets() {
        let mut documents = Documents::new(100);
        assert_eq!(added(&mut documents, 65_535, false, "<a>"), None);
        assert_eq!(added(&mut documents, 0, true, "</a>"), complete("<a></a>"));
        assert_eq!(added(&mut documents, 1, true, "<b/>"), complete("<b/>"));
        assert_eq!(added(&mut documents, 2, false, "<c>"), None);
        assert_eq!(added(&mut documents, 4, true, "</c>"), Some(Document::Damaged));
        assert_eq!(added(&mut documents, 5, true, "<d/>"), complete("<d/>"));
        let mut joined = Documents::new(100);
        assert_eq!(added(&mut joined, 7, true, "/></a>"), Some(Document::Damaged));
        assert_eq!(added(&mut joined, 8, true, "<b/>"), complete("<b/>"));
    }

    #[test]
    fn a_document_without_end_is_kept_to_the_limit() {
        let mut documents = Documents::new(10);
        for sequence in 0..1_000 {
            assert_eq!(added(&mut documents, sequence, false, "<aaaaaa"), None);
        }
        assert!(documents.content.capacity() < 1_000);
        let content = Bytes::from_static(b"<aaaaaa<aa");
        let expected = Document::Complete { content, size_bytes: 7_004 };
        assert_eq!(added(&mut documents, 1_000, true, "<a/>"), Some(expected));
    }

    #[test]
    fn sources_extensions_and_padding_are_no_content() {
        let mut header = vec![0x80 | 0x20 | 0x10 | 1, 0x80, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        header.extend([0; 4]);
        header.extend([0xab, 0xac, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0]);
        header.extend(b"<a/>\0\0\x03");
        assert_eq!(Documents::new(100).add(&header).expect("a packet"), complete("<a/>"));
        for end in 0..header.len() {
            let _ = Documents::new(100).add(&header[..end]);
        }
        assert!(Documents::new(100).add(b"$").is_err());
    }
}
