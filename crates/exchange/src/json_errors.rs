//! The faults of a JSON document, in the words of its interface and not of the parser's language.

use crate::domain::{Error, ErrorKind};

/// The refusal of a document. `path` leads to the value at fault; it is empty for the document itself.
pub(super) fn refusal_of(path: &str, error: &serde_json::Error) -> Error {
    let message = error.to_string();
    let (what, place) = message.rfind(" at line ").map_or((message.as_str(), ""), |at| message.split_at(at));
    if what == "number out of range" {
        return Error::invalid(path, "the number is too large for a double");
    }
    if error.is_data() {
        let (field, reason) = field_and_reason(path, what);
        return Error::invalid(if field.is_empty() { "body" } else { &field }, reason);
    }
    Error::field(ErrorKind::MalformedBody, path, format!("not JSON: {what}{place}"))
}

/// The name at the start of the parser's message, and what follows it.
fn quoted<'m>(message: &'m str, begin: &str) -> Option<(&'m str, &'m str)> {
    message.strip_prefix(begin).and_then(|rest| rest.split_once('`'))
}

/// The field that the parser's message says is missing.
pub(super) fn missing_field(message: &str) -> Option<&str> {
    quoted(message, "missing field `").map(|(name, _)| name)
}

/// The field that the parser's message says is not known.
pub(super) fn unknown_field(message: &str) -> Option<&str> {
    quoted(message, "unknown field `").map(|(name, _)| name)
}

/// The first of the names that the parser's message says could be there.
pub(super) fn first_variant(message: &str) -> Option<&str> {
    let (_, rest) = quoted(message, "unknown variant `")?;
    rest.split('`').nth(1)
}

/// serde reports a missing or unknown field at its parent; this returns the path of the field itself.
fn field_and_reason(path: &str, what: &str) -> (String, String) {
    let join = |name: &str| if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
    if let Some(name) = missing_field(what) {
        return (join(name), "is required".to_owned());
    }
    if let Some((name, _)) = quoted(what, "duplicate field `") {
        return (join(name), "appears twice".to_owned());
    }
    if let Some((name, rest)) = quoted(what, "unknown field `") {
        let is_named = path == name || path.ends_with(&format!(".{name}"));
        let field = if is_named { path.to_owned() } else { join(name) };
        return (field, format!("is not a known field{rest}"));
    }
    if let Some((_, rest)) = quoted(what, "unknown variant `") {
        return (path.to_owned(), rest.replacen(", expected", "must be", 1).replace('`', ""));
    }
    (path.to_owned(), type_mismatch(what).unwrap_or_else(|| what.to_owned()))
}

/// `invalid type: integer `5`, expected f64` in words of JSON.
fn type_mismatch(what: &str) -> Option<String> {
    if let Some(rest) = what.strip_prefix("invalid value: ").or_else(|| what.strip_prefix("invalid length "))
    {
        let (_, expected) = rest.split_once(", expected ")?;
        return Some(format!("must be {}", json_type(expected)));
    }
    let (found, expected) = what.strip_prefix("invalid type: ")?.split_once(", expected ")?;
    let wanted = json_type(expected);
    let given = json_type(found);
    Some(if wanted == given {
        format!("must be {wanted} in range")
    } else {
        format!("must be {wanted}, not {given}")
    })
}

/// The JSON type of a value that the parser describes by a type or a sample.
fn json_type(described: &str) -> String {
    let first = described.split([' ', '`', '"']).next().unwrap_or_default();
    let name = match first {
        "f32" | "f64" | "integer" => "a number",
        "floating" => "a number with a fraction",
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
        "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number from 0 on",
        "string" | "character" => "text",
        "boolean" | "bool" => "true or false",
        "sequence" => "an array",
        "map" | "struct" => "an object",
        "null" | "unit" | "Option" => "null",
        _ if described.contains("string") || described.contains("text") => "text",
        _ if described.contains("bool") => "true or false",
        _ if described.contains("sequence") || described.contains("array") || described.contains("tuple") => {
            "an array"
        }
        _ if described.contains("map") || described.contains("struct") => "an object",
        _ if described.contains("enum") => "one of the values that the interface lists",
        _ => return described.to_owned(),
    };
    name.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_are_named_as_in_json() {
        for (what, message) in [
            ("invalid type: string \"x\", expected f64", "must be a number, not text"),
            ("invalid type: integer `5`, expected a string", "must be text, not a number"),
            ("invalid type: null, expected f64", "must be a number, not null"),
            ("invalid type: sequence, expected struct CameraDraft", "must be an object, not an array"),
            ("invalid type: map, expected a sequence", "must be an array, not an object"),
            ("invalid value: integer `-1`, expected u32", "must be a whole number from 0 on"),
            (
                "invalid type: boolean `true`, expected u64",
                "must be a whole number from 0 on, not true or false",
            ),
        ] {
            assert_eq!(field_and_reason("a.b", what), ("a.b".to_owned(), message.to_owned()));
        }
        assert_eq!(
            field_and_reason("recipe", "unknown variant `x`, expected one of `paper`, `auto`").1,
            "must be one of paper, auto"
        );
        assert_eq!(field_and_reason("", "missing field `id`"), ("id".to_owned(), "is required".to_owned()));
    }
}
