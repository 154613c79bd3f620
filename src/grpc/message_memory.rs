//! The memory of a decoded message, computed from its wire format and its description before any of it is
//! built.
//!
//! An element of two bytes may be a message of hundreds. Only what a message may have many of is counted; the rest is
//! within the fields of the message around it.

use std::collections::HashMap;
use std::sync::LazyLock;

use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorSet};

use super::proto;

/// A vector that grows has twice the place of its elements; so have maps.
const GROWTH: usize = 2;
/// The memory that the allocator takes for a short text.
const SHORT_TEXT_BYTES: usize = 16;
/// Messages within messages, at most; those of the interface have fewer.
const MOST_DEPTH: u32 = 32;

/// Why a message is not decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Misfit {
    /// It is not of the wire format.
    Malformed,
    /// It comes to too much.
    TooLarge,
}

/// The memory of a message of this name besides its own bytes; an estimate that is rather too large.
///
/// # Errors
/// A message that comes to more than `most` bytes, or is not of the wire format.
pub(super) fn decoded_bytes(name: &str, message: &[u8], most: usize) -> Result<usize, Misfit> {
    let mut scan = Scan { messages: &SHAPES.messages, bytes: 0, most };
    scan.message(SHAPES.by_name.get(name).copied(), message, 0)?;
    Ok(scan.bytes)
}

/// How the fields of a message are held.
struct Shape {
    /// The largest size of its struct.
    bytes: usize,
    /// By their numbers; `None` where all is within the struct.
    fields: Vec<Option<Field>>,
}

#[derive(Clone, Copy)]
enum Field {
    /// A text or bytes, each with this number of bytes besides its content.
    Text { header_bytes: usize },
    /// A message, by its place among the shapes, and how many of its structs each one takes besides the message around it.
    Message { shape: usize, structs: usize },
    /// Many numbers, each of this number of bytes in memory and, if that is fixed, on the wire.
    Numbers { bytes: usize, wire_bytes: Option<usize> },
}

struct Shapes {
    messages: Vec<Shape>,
    by_name: HashMap<String, usize>,
}

static SHAPES: LazyLock<Shapes> = LazyLock::new(|| {
    // The descriptors that the build wrote; every start reads them for server reflection, too.
    Shapes::of(&FileDescriptorSet::decode(proto::FILE_DESCRIPTOR_SET).unwrap_or_default())
});

impl Shapes {
    fn of(files: &FileDescriptorSet) -> Self {
        let mut described = Vec::new();
        for file in &files.file {
            add_messages(file.package(), &file.message_type, &mut described);
        }
        let by_name: HashMap<String, usize> =
            described.iter().enumerate().map(|(place, (name, _))| (name.clone(), place)).collect();
        let shape = |place: usize| Shape {
            bytes: struct_bytes(place, &described, &by_name, 0),
            fields: fields(&described[place], &by_name),
        };
        Self { messages: (0..described.len()).map(shape).collect(), by_name }
    }
}

fn fields(
    (name, message): &(String, &DescriptorProto),
    by_name: &HashMap<String, usize>,
) -> Vec<Option<Field>> {
    let mut fields = Vec::new();
    for field in &message.field {
        let number = usize::try_from(field.number()).unwrap_or_default();
        fields.resize_with(fields.len().max(number + 1), || None);
        fields[number] = held(name, field, by_name);
    }
    fields
}

fn add_messages<'d>(
    parent: &str,
    messages: &'d [DescriptorProto],
    all: &mut Vec<(String, &'d DescriptorProto)>,
) {
    for message in messages {
        let name = format!("{parent}.{}", message.name());
        add_messages(&name, &message.nested_type, all);
        all.push((name, message));
    }
}

/// The name of a field's message, as descriptions have it with a dot before.
fn message_name(field: &FieldDescriptorProto) -> &str {
    field.type_name().trim_start_matches('.')
}

fn is_repeated(field: &FieldDescriptorProto) -> bool {
    field.label() == Label::Repeated
}

/// True if the build has a field of a message held by a pointer.
fn is_boxed(message: &str, field: &FieldDescriptorProto) -> bool {
    env!("BOXED_FIELDS").split(' ').any(|boxed| boxed == format!("{message}.{}", field.name()))
}

/// The largest size of the struct of a message; of a oneof every field counts.
fn struct_bytes(
    place: usize,
    described: &[(String, &DescriptorProto)],
    by_name: &HashMap<String, usize>,
    depth: u32,
) -> usize {
    let (name, message) = &described[place];
    let inner = |field| by_name.get(message_name(field)).copied();
    let is_map = |field| {
        inner(field).is_some_and(|inner| described[inner].1.options.as_ref().is_some_and(|it| it.map_entry()))
    };
    let fields = message.field.iter().map(|field| match field.r#type() {
        Type::Message if is_map(field) => size_of::<HashMap<String, ()>>(),
        _ if is_repeated(field) => size_of::<Vec<()>>(),
        Type::Message if is_boxed(name, field) => size_of::<Box<()>>(),
        Type::String => size_of::<String>(),
        Type::Bytes => size_of::<bytes::Bytes>(),
        Type::Message if depth < MOST_DEPTH => {
            8 + inner(field).map_or(0, |inner| struct_bytes(inner, described, by_name, depth + 1))
        }
        _ if field.proto3_optional() => size_of::<Option<f64>>(),
        _ => size_of::<f64>(),
    });
    fields.sum()
}

/// How a field is held, unless it is within its message's struct.
fn held(message: &str, field: &FieldDescriptorProto, by_name: &HashMap<String, usize>) -> Option<Field> {
    let is_repeated = is_repeated(field);
    let (bytes, wire_bytes) = match field.r#type() {
        Type::String | Type::Bytes => {
            let header_bytes = if is_repeated { GROWTH * size_of::<bytes::Bytes>() } else { 0 };
            return Some(Field::Text { header_bytes });
        }
        Type::Message | Type::Group => {
            let shape = *by_name.get(message_name(field))?;
            let boxes = usize::from(is_boxed(message, field));
            return Some(Field::Message { shape, structs: if is_repeated { GROWTH } else { boxes } });
        }
        Type::Double | Type::Fixed64 | Type::Sfixed64 => (8, Some(8)),
        Type::Float | Type::Fixed32 | Type::Sfixed32 => (4, Some(4)),
        Type::Int64 | Type::Uint64 | Type::Sint64 => (8, None),
        Type::Bool => (1, None),
        Type::Int32 | Type::Uint32 | Type::Sint32 | Type::Enum => (4, None),
    };
    is_repeated.then_some(Field::Numbers { bytes, wire_bytes })
}

struct Scan<'s> {
    messages: &'s [Shape],
    bytes: usize,
    most: usize,
}

impl Scan<'_> {
    fn message(&mut self, shape: Option<usize>, mut rest: &[u8], depth: u32) -> Result<(), Misfit> {
        let messages = self.messages;
        while !rest.is_empty() {
            let key = varint(&mut rest)?;
            let field = shape.and_then(|shape| *messages[shape].fields.get((key >> 3) as usize)?);
            match key & 7 {
                0 => {
                    varint(&mut rest)?;
                    self.number(field)?;
                }
                1 => {
                    split(&mut rest, 8)?;
                    self.number(field)?;
                }
                5 => {
                    split(&mut rest, 4)?;
                    self.number(field)?;
                }
                2 => {
                    let length = varint(&mut rest)?;
                    self.content(field, split(&mut rest, length)?, depth)?;
                }
                // Groups are of proto2.
                _ => return Err(Misfit::Malformed),
            }
        }
        Ok(())
    }

    fn number(&mut self, field: Option<Field>) -> Result<(), Misfit> {
        match field {
            Some(Field::Numbers { bytes, .. }) => self.add(GROWTH * bytes),
            _ => Ok(()),
        }
    }

    fn content(&mut self, field: Option<Field>, content: &[u8], depth: u32) -> Result<(), Misfit> {
        match field {
            None => Ok(()),
            Some(Field::Text { header_bytes }) => {
                self.add(header_bytes + content.len().max(SHORT_TEXT_BYTES))
            }
            Some(Field::Numbers { bytes, wire_bytes }) => {
                let count = match wire_bytes {
                    Some(wire_bytes) => content.len() / wire_bytes,
                    None => content.iter().filter(|&&byte| byte < 0x80).count(),
                };
                self.add(GROWTH * bytes * count)
            }
            Some(Field::Message { shape, structs }) => {
                self.add(structs * self.messages[shape].bytes)?;
                if depth == MOST_DEPTH {
                    return Err(Misfit::Malformed);
                }
                self.message(Some(shape), content, depth + 1)
            }
        }
    }

    fn add(&mut self, bytes: usize) -> Result<(), Misfit> {
        self.bytes += bytes;
        if self.bytes > self.most { Err(Misfit::TooLarge) } else { Ok(()) }
    }
}

fn varint(rest: &mut &[u8]) -> Result<u64, Misfit> {
    let mut value = 0;
    for shift in (0..70).step_by(7) {
        let (&byte, after) = rest.split_first().ok_or(Misfit::Malformed)?;
        *rest = after;
        value |= u64::from(byte & 0x7f).checked_shl(shift).unwrap_or_default();
        if byte < 0x80 {
            return Ok(value);
        }
    }
    Err(Misfit::Malformed)
}

fn split<'m>(rest: &mut &'m [u8], length: u64) -> Result<&'m [u8], Misfit> {
    let at = usize::try_from(length).map_err(|_| Misfit::Malformed)?;
    let (content, after) = rest.split_at_checked(at).ok_or(Misfit::Malformed)?;
    *rest = after;
    Ok(content)
}

#[cfg(test)]
mod tests {
    use prost::Name;

    use super::*;
    use crate::grpc::inference_proto;
    use crate::grpc::proto::{ImportSamplesRequest, PairSamplesRequest, Sample};

    /// The size that a shape states for a message's struct, and the size of the struct.
    fn sizes<M: Name>() -> (usize, usize) {
        let shape = SHAPES.by_name.get(&M::full_name()).expect("it is described");
        (SHAPES.messages[*shape].bytes, size_of::<M>())
    }

    #[test]
    fn a_struct_takes_no_more_than_its_description_says() {
        use inference_proto::InferTensorContents;
        use inference_proto::model_infer_request::InferInputTensor;
        let all = [
            sizes::<Sample>(),
            sizes::<proto::Observation>(),
            sizes::<proto::Fix>(),
            sizes::<proto::Position>(),
            sizes::<proto::Receiver>(),
            sizes::<InferInputTensor>(),
            sizes::<InferTensorContents>(),
        ];
        for (described, real) in all {
            assert!((real..=3 * real).contains(&described), "{described} for {real}");
        }
    }

    #[test]
    fn elements_count_wherever_they_are() {
        let bytes = |message: &ImportSamplesRequest| {
            decoded_bytes(&ImportSamplesRequest::full_name(), &message.encode_to_vec(), usize::MAX)
        };
        let empty = ImportSamplesRequest { samples: vec![Sample::default(); 1_000], ..Default::default() };
        assert!(bytes(&empty).expect("well formed") >= 1_000 * size_of::<Sample>());
        let numbers = |count| inference_proto::ModelInferRequest {
            inputs: vec![inference_proto::model_infer_request::InferInputTensor {
                contents: Some(inference_proto::InferTensorContents {
                    int64_contents: vec![1; count],
                    ..Default::default()
                }),
                ..Default::default()
            }],
            ..Default::default()
        };
        let name = inference_proto::ModelInferRequest::full_name();
        let of =
            |count| decoded_bytes(&name, &numbers(count).encode_to_vec(), usize::MAX).expect("well formed");
        assert_eq!(of(2_000) - of(1_000), 1_000 * 8 * GROWTH);
        let most = of(1_000);
        let longer = numbers(1_001).encode_to_vec();
        assert_eq!(decoded_bytes(&name, &longer, most), Err(Misfit::TooLarge));
    }

    proptest::proptest! {
        /// Every decoded message was counted: only messages that prost also refuses, and groups, are malformed here.
        #[test]
        fn what_prost_decodes_is_well_formed(message: Vec<u8>) {
            let name = PairSamplesRequest::full_name();
            let is_decoded = PairSamplesRequest::decode(&*message).is_ok();
            let has_groups = message.iter().any(|byte| matches!(byte & 7, 3 | 4));
            let scanned = decoded_bytes(&name, &message, usize::MAX);
            proptest::prop_assert!(!is_decoded || has_groups || scanned.is_ok());
        }
    }
}
