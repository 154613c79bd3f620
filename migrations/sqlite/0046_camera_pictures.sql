-- What a camera sees, as one still picture: JPEG or PNG, as `media_type` says.
CREATE TABLE camera_pictures (
    camera_key    INTEGER PRIMARY KEY REFERENCES cameras (key) ON DELETE CASCADE,
    media_type    TEXT    NOT NULL,
    content       BLOB    NOT NULL,
    updated_at_us INTEGER NOT NULL
) STRICT;
