-- Whether a camera without a model records boxes of trackers and fixes of receivers and is trained on them, and what it has
-- recorded: parts of a few seconds, the oldest of which give way.
ALTER TABLE cameras ADD COLUMN learn_automatically INTEGER NOT NULL DEFAULT 1;

CREATE TABLE recording_parts (
    number         INTEGER PRIMARY KEY AUTOINCREMENT,
    camera_key     INTEGER NOT NULL REFERENCES cameras (key) ON DELETE CASCADE,
    recorded_at_us INTEGER NOT NULL,
    row_count      INTEGER NOT NULL,
    content        BLOB    NOT NULL
) STRICT;

CREATE INDEX recording_parts_by_camera ON recording_parts (camera_key, number);
