//! Fields of Kafka's protocol: big-endian numbers, texts and arrays after their lengths.

use bytes::{Buf, BufMut, Bytes, TryGetError};

/// Why fields cannot be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum FieldError {
    #[error("ends too early")]
    Short(#[from] TryGetError),
    #[error("contains a number of more than 64 bits")]
    LongNumber,
    #[error("contains a text that is not UTF-8")]
    Text(#[from] std::str::Utf8Error),
    #[error("has a wrong checksum")]
    Checksum,
}

/// Writes fields.
pub(super) trait Write: BufMut {
    /// A text of at most 32,767 bytes; a longer one is cut.
    fn put_text(&mut self, text: &str) {
        let length = text.floor_char_boundary(i16::MAX as usize);
        self.put_i16(length as i16);
        self.put_slice(&text.as_bytes()[..length]);
    }

    /// The items of an array, each written by a function.
    fn put_array<T>(&mut self, items: impl ExactSizeIterator<Item = T>, mut write: impl FnMut(&mut Self, T))
    where
        Self: Sized,
    {
        self.put_i32(items.len() as i32);
        items.for_each(|item| write(self, item));
    }

    fn put_bytes_field(&mut self, bytes: &[u8]) {
        self.put_i32(bytes.len() as i32);
        self.put_slice(bytes);
    }

    /// A number of a record: ZigZag, 7 bits per byte.
    fn put_varint(&mut self, number: i64) {
        let mut rest = ((number << 1) ^ (number >> 63)) as u64;
        while rest >= 0x80 {
            self.put_u8(rest as u8 | 0x80);
            rest >>= 7;
        }
        self.put_u8(rest as u8);
    }

    /// Bytes of a record.
    fn put_varint_bytes(&mut self, bytes: &[u8]) {
        self.put_varint(bytes.len() as i64);
        self.put_slice(bytes);
    }
}

impl<B: BufMut> Write for B {}

/// Reads fields of what a broker sent. A length is never believed before its content is there.
pub(super) struct Fields(pub(super) Bytes);

impl Fields {
    pub(super) fn i8(&mut self) -> Result<i8, FieldError> {
        Ok(self.0.try_get_i8()?)
    }

    pub(super) fn i16(&mut self) -> Result<i16, FieldError> {
        Ok(self.0.try_get_i16()?)
    }

    pub(super) fn i32(&mut self) -> Result<i32, FieldError> {
        Ok(self.0.try_get_i32()?)
    }

    pub(super) fn i64(&mut self) -> Result<i64, FieldError> {
        Ok(self.0.try_get_i64()?)
    }

    /// The next bytes, which share the memory of all; none for a negative length, which stands for null.
    pub(super) fn take(&mut self, length: i64) -> Result<Bytes, FieldError> {
        let requested = usize::try_from(length).unwrap_or(0);
        let available = self.0.len();
        if requested > available {
            return Err(TryGetError { requested, available }.into());
        }
        Ok(self.0.split_to(requested))
    }

    pub(super) fn bytes(&mut self) -> Result<Bytes, FieldError> {
        let length = self.i32()?;
        self.take(length.into())
    }

    pub(super) fn text(&mut self) -> Result<String, FieldError> {
        let length = self.i16()?;
        Ok(std::str::from_utf8(&self.take(length.into())?)?.to_owned())
    }

    /// The items of an array, each read by a function. Memory grows with the items that are there.
    pub(super) fn array<T>(
        &mut self,
        mut read: impl FnMut(&mut Self) -> Result<T, FieldError>,
    ) -> Result<Vec<T>, FieldError> {
        let count = self.i32()?;
        (0..count).map(|_| read(self)).collect()
    }

    pub(super) fn varint(&mut self) -> Result<i64, FieldError> {
        let mut number = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.0.try_get_u8()?;
            number |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Ok((number >> 1) as i64 ^ -((number & 1) as i64));
            }
        }
        Err(FieldError::LongNumber)
    }

    pub(super) fn varint_bytes(&mut self) -> Result<Bytes, FieldError> {
        let length = self.varint()?;
        self.take(length)
    }
}

#[cfg(test)]
mod tests {
    use bytes::BytesMut;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn numbers_of_records_come_back(number: i64) {
            let mut out = BytesMut::new();
            out.put_varint(number);
            let mut fields = Fields(out.freeze());
            prop_assert_eq!(fields.varint().expect("a number"), number);
            prop_assert!(fields.0.is_empty());
        }
    }

    #[test]
    fn an_announced_array_takes_no_memory_before_its_items_come() {
        let mut fields = Fields(Bytes::copy_from_slice(&i32::MAX.to_be_bytes()));
        assert!(matches!(fields.array(Fields::i64), Err(FieldError::Short(_))));
        let mut fields = Fields(Bytes::copy_from_slice(&i32::MAX.to_be_bytes()));
        assert!(matches!(fields.bytes(), Err(FieldError::Short(_))));
        assert!(matches!(Fields(vec![0xff; 11].into()).varint(), Err(FieldError::LongNumber)));
    }
}
