//! Rows of pictures.

use crate::domain::{Picture, PictureFormat, Result};
use crate::row_decoder::{RowDecoder, StoredRow};

pub(crate) fn read_picture<'r>(row: impl Into<StoredRow<'r>>) -> Result<Picture> {
    let mut fields = RowDecoder::new("camera_pictures", row).skip(1);
    let format = fields.parse(|media_type: &str| media_type.parse::<PictureFormat>())?;
    fields.parse(|content: Vec<u8>| Picture::new(format, content))
}

/// What the audit log says of a picture that was set or removed.
pub(crate) fn picture_change(picture: Option<&Picture>) -> String {
    picture.map_or_else(
        || "picture removed".to_owned(),
        |picture| format!("picture of {} bytes", picture.content().len()),
    )
}
