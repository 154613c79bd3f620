//! Field masks of changes.

use crate::domain::{Error, Result};

/// Says if a change names a field: those of the mask (`*` for all) or, without one, those `present` in the
/// profile.
///
/// # Errors
/// `InvalidArgument` naming the path of the mask that is none of `fields`.
pub(super) fn named_fields(
    mask: Option<prost_types::FieldMask>,
    fields: &[&str],
    present: Vec<&'static str>,
) -> Result<impl Fn(&str) -> bool + use<>> {
    let paths = mask.map_or_else(|| present.into_iter().map(str::to_owned).collect(), |mask| mask.paths);
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
