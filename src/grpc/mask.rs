//! Field masks of changes.

use crate::domain::{Error, Result};

/// Whether a change names a field: those of the mask (`*` for all) or, without one, those that the profile has.
///
/// # Errors
/// `InvalidArgument` naming the path of the mask that is no field.
pub(super) fn named_fields<const N: usize>(
    mask: Option<prost_types::FieldMask>,
    fields: [&'static str; N],
    has: [bool; N],
) -> Result<impl Fn(&str) -> bool> {
    let paths: Vec<String> = match mask {
        Some(mask) => mask.paths,
        None => {
            fields.into_iter().zip(has).filter(|(_, has)| *has).map(|(field, _)| field.to_owned()).collect()
        }
    };
    let unknown = |path: &String| path != "*" && !fields.contains(&path.as_str());
    if let Some(index) = paths.iter().position(unknown) {
        let known = fields.join(", ");
        return Err(Error::invalid(
            format!("update_mask.paths[{index}]"),
            format!("must be one of {known}, or * for all"),
        ));
    }
    Ok(move |field: &str| paths.iter().any(|path| path == field || path == "*"))
}
