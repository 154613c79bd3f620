//! A deserializer that takes objects for structs only, and no more elements than the text has memory for. serde's own
//! also takes an array with the fields in the order of their declaration, which no interface describes; and `{}` is two
//! bytes that may become hundreds.

use std::cell::Cell;
use std::fmt;

use serde::de::{
    Deserialize, DeserializeSeed, Deserializer, EnumAccess, Error, MapAccess, SeqAccess, VariantAccess,
    Visitor,
};

/// A vector that grows has twice the place of its elements; so have maps.
const GROWTH: usize = 2;

/// Parses a value whose structs are objects, with a limit on the memory of its elements and map entries, bytes.
///
/// # Errors
/// Those of the deserializer, also for an array instead of an object, and for more elements.
pub(super) fn deserialize<'de, T: Deserialize<'de>, D: Deserializer<'de>>(
    source: D,
    memory_bytes: usize,
) -> Result<T, D::Error> {
    T::deserialize(ObjectsOnly { inner: source, left_bytes: &Cell::new(memory_bytes), is_map: false })
}

/// Any part of a deserializer, so that nested values are parsed by the same rule.
struct ObjectsOnly<'b, T> {
    inner: T,
    /// Memory left for elements, bytes.
    left_bytes: &'b Cell<usize>,
    /// True if the keys of an object are entries of a map, and not fields of a struct.
    is_map: bool,
}

impl<'b, T> ObjectsOnly<'b, T> {
    const fn with<U>(&self, inner: U) -> ObjectsOnly<'b, U> {
        ObjectsOnly { inner, left_bytes: self.left_bytes, is_map: true }
    }

    /// Takes the memory of an element.
    fn take<E: Error>(&self, bytes: usize) -> Result<(), E> {
        let left_bytes = self.left_bytes.get().checked_sub(GROWTH * bytes);
        self.left_bytes.set(left_bytes.ok_or_else(|| {
            E::custom("has more elements than the length of the body has memory for; send fewer at once")
        })?);
        Ok(())
    }
}

macro_rules! forward {
    ($($method:ident)*) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
            let visitor = self.with(visitor);
            self.inner.$method(visitor)
        }
    )*};
}

impl<'de, D: Deserializer<'de>> Deserializer<'de> for ObjectsOnly<'_, D> {
    type Error = D::Error;

    forward! {
        deserialize_any deserialize_bool deserialize_i8 deserialize_i16 deserialize_i32 deserialize_i64
        deserialize_u8 deserialize_u16 deserialize_u32 deserialize_u64 deserialize_f32 deserialize_f64
        deserialize_char deserialize_str deserialize_string deserialize_bytes deserialize_byte_buf
        deserialize_option deserialize_unit deserialize_seq deserialize_map deserialize_identifier
        deserialize_ignored_any
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        _fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = ObjectsOnly { is_map: false, ..self.with(visitor) };
        self.inner.deserialize_map(visitor)
    }

    fn deserialize_unit_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = self.with(visitor);
        self.inner.deserialize_unit_struct(name, visitor)
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = self.with(visitor);
        self.inner.deserialize_newtype_struct(name, visitor)
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, length: usize, visitor: V) -> Result<V::Value, D::Error> {
        let visitor = self.with(visitor);
        self.inner.deserialize_tuple(length, visitor)
    }

    fn deserialize_tuple_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        length: usize,
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = self.with(visitor);
        self.inner.deserialize_tuple_struct(name, length, visitor)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        name: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = self.with(visitor);
        self.inner.deserialize_enum(name, variants, visitor)
    }

    fn is_human_readable(&self) -> bool {
        self.inner.is_human_readable()
    }
}

macro_rules! visit {
    ($($method:ident($kind:ty))*) => {$(
        fn $method<E: Error>(self, value: $kind) -> Result<V::Value, E> {
            self.inner.$method(value)
        }
    )*};
}

impl<'de, V: Visitor<'de>> Visitor<'de> for ObjectsOnly<'_, V> {
    type Value = V::Value;

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.expecting(out)
    }

    visit! {
        visit_bool(bool) visit_i8(i8) visit_i16(i16) visit_i32(i32) visit_i64(i64) visit_u8(u8)
        visit_u16(u16) visit_u32(u32) visit_u64(u64) visit_f32(f32) visit_f64(f64) visit_char(char)
        visit_str(&str) visit_borrowed_str(&'de str) visit_string(String) visit_bytes(&[u8])
        visit_borrowed_bytes(&'de [u8]) visit_byte_buf(Vec<u8>)
    }

    fn visit_none<E: Error>(self) -> Result<V::Value, E> {
        self.inner.visit_none()
    }

    fn visit_unit<E: Error>(self) -> Result<V::Value, E> {
        self.inner.visit_unit()
    }

    fn visit_some<D: Deserializer<'de>>(self, source: D) -> Result<V::Value, D::Error> {
        let source = self.with(source);
        self.inner.visit_some(source)
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, source: D) -> Result<V::Value, D::Error> {
        let source = self.with(source);
        self.inner.visit_newtype_struct(source)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, items: A) -> Result<V::Value, A::Error> {
        let items = self.with(items);
        self.inner.visit_seq(items)
    }

    fn visit_map<A: MapAccess<'de>>(self, entries: A) -> Result<V::Value, A::Error> {
        let entries = ObjectsOnly { is_map: self.is_map, ..self.with(entries) };
        self.inner.visit_map(entries)
    }

    fn visit_enum<A: EnumAccess<'de>>(self, variant: A) -> Result<V::Value, A::Error> {
        let variant = self.with(variant);
        self.inner.visit_enum(variant)
    }
}

impl<'de, S: DeserializeSeed<'de>> DeserializeSeed<'de> for ObjectsOnly<'_, S> {
    type Value = S::Value;

    fn deserialize<D: Deserializer<'de>>(self, source: D) -> Result<S::Value, D::Error> {
        let source = self.with(source);
        self.inner.deserialize(source)
    }
}

impl<'de, A: SeqAccess<'de>> SeqAccess<'de> for ObjectsOnly<'_, A> {
    type Error = A::Error;

    fn next_element_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, A::Error> {
        let seed = self.with(seed);
        let element = self.inner.next_element_seed(seed)?;
        if element.is_some() {
            self.take(size_of::<S::Value>())?;
        }
        Ok(element)
    }

    fn size_hint(&self) -> Option<usize> {
        self.inner.size_hint()
    }
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for ObjectsOnly<'_, A> {
    type Error = A::Error;

    fn next_key_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, A::Error> {
        let seed = self.with(seed);
        let key = self.inner.next_key_seed(seed)?;
        if self.is_map && key.is_some() {
            self.take(size_of::<S::Value>())?;
        }
        Ok(key)
    }

    fn next_value_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value, A::Error> {
        if self.is_map {
            self.take(size_of::<S::Value>())?;
        }
        let seed = self.with(seed);
        self.inner.next_value_seed(seed)
    }

    fn size_hint(&self) -> Option<usize> {
        self.inner.size_hint()
    }
}

impl<'b, 'de, A: EnumAccess<'de>> EnumAccess<'de> for ObjectsOnly<'b, A> {
    type Error = A::Error;
    type Variant = ObjectsOnly<'b, A::Variant>;

    fn variant_seed<S: DeserializeSeed<'de>>(self, seed: S) -> Result<(S::Value, Self::Variant), A::Error> {
        let Self { inner, left_bytes, is_map } = self;
        let (value, variant) = inner.variant_seed(ObjectsOnly { inner: seed, left_bytes, is_map })?;
        Ok((value, ObjectsOnly { inner: variant, left_bytes, is_map }))
    }
}

impl<'de, A: VariantAccess<'de>> VariantAccess<'de> for ObjectsOnly<'_, A> {
    type Error = A::Error;

    fn unit_variant(self) -> Result<(), A::Error> {
        self.inner.unit_variant()
    }

    fn newtype_variant_seed<S: DeserializeSeed<'de>>(self, seed: S) -> Result<S::Value, A::Error> {
        let seed = self.with(seed);
        self.inner.newtype_variant_seed(seed)
    }

    fn tuple_variant<V: Visitor<'de>>(self, length: usize, visitor: V) -> Result<V::Value, A::Error> {
        let visitor = self.with(visitor);
        self.inner.tuple_variant(length, visitor)
    }

    fn struct_variant<V: Visitor<'de>>(
        self,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, A::Error> {
        let visitor = ObjectsOnly { is_map: false, ..self.with(visitor) };
        self.inner.struct_variant(fields, visitor)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use serde_json::Value;

    use super::*;

    fn parsed<T: serde::de::DeserializeOwned>(json: &str, memory_bytes: usize) -> Result<T, String> {
        let mut source = serde_json::Deserializer::from_str(json);
        deserialize(&mut source, memory_bytes).map_err(|error| error.to_string())
    }

    #[derive(serde::Deserialize)]
    struct Item {
        #[expect(dead_code, reason = "only its size matters")]
        number: Option<f64>,
    }

    #[test]
    fn elements_have_no_more_memory_than_is_given() {
        let item = GROWTH * size_of::<Item>();
        assert!(parsed::<Vec<Item>>("[{},{},{}]", 3 * item).is_ok());
        assert!(parsed::<Vec<Item>>("[{},{},{}]", 3 * item - 1).is_err());
        assert!(parsed::<Item>(r#"{"number": 1}"#, 0).is_ok(), "fields are within their struct");
        let value = GROWTH * size_of::<Value>();
        assert!(parsed::<Value>("[[],[[]]]", 3 * value).is_ok(), "nested ones count, too");
        let refused = parsed::<Value>("[[],[[]]]", 3 * value - 1).expect_err("one too many");
        assert!(refused.contains("send fewer at once"), "{refused}");
        let entry = GROWTH * (size_of::<String>() + size_of::<u8>());
        assert!(parsed::<BTreeMap<String, u8>>(r#"{"a":1,"b":2}"#, 2 * entry).is_ok());
        assert!(parsed::<BTreeMap<String, u8>>(r#"{"a":1,"b":2}"#, 2 * entry - 1).is_err());
    }
}
