//! Statements on recordings of cameras, which both backends understand.

pub(crate) const APPEND: &str = "INSERT INTO recording_parts (camera_key, recorded_at_us, row_count, content) \
     SELECT key, $1, $2, $3 FROM cameras WHERE key = $4";

/// Deletes the parts of a camera beyond a number of rows or bytes, counted from the newest.
pub(crate) const TRIM: &str = "DELETE FROM recording_parts WHERE camera_key = $1 AND number IN (SELECT number FROM \
     (SELECT number, SUM(row_count) OVER newest AS row_sum, SUM(LENGTH(content)) OVER newest AS byte_sum \
     FROM recording_parts WHERE camera_key = $1 WINDOW newest AS (ORDER BY number DESC)) AS summed \
     WHERE row_sum > $2 OR byte_sum > $3)";

pub(crate) const READ: &str = "SELECT content FROM recording_parts WHERE camera_key = $1 ORDER BY number";

/// Deletes parts that are too old, and all of cameras that have a model or record no more.
pub(crate) const DELETE_UNWANTED: &str = "DELETE FROM recording_parts WHERE recorded_at_us < $1 OR camera_key IN \
     (SELECT key FROM cameras WHERE active_model IS NOT NULL OR NOT learn_automatically)";
