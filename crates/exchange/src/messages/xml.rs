//! Attributes of XML elements.

use quick_xml::events::BytesStart;

/// An attribute, if the element has it.
pub(super) fn attribute(element: &BytesStart<'_>, name: &str) -> Result<Option<String>, String> {
    let found = element.try_get_attribute(name).map_err(|error| format!("is not XML: {error}"))?;
    Ok(found.map(|attribute| attribute.value.into_owned()))
}

/// Attributes that are finite numbers.
pub(super) fn numbers<const N: usize>(
    element: &BytesStart<'_>,
    names: [&str; N],
) -> Result<[f64; N], String> {
    let mut values = [0.0; N];
    for (value, name) in values.iter_mut().zip(names) {
        let text = attribute(element, name)?.unwrap_or_default();
        let number = text.trim().parse().ok().filter(|number: &f64| number.is_finite());
        *value = number.ok_or_else(|| format!("the attribute {name} is `{text}`, which is not a number"))?;
    }
    Ok(values)
}
