-- What a camera sees, as one still picture: JPEG or PNG, as `media_type` says.
CREATE TABLE camera_pictures (
    camera_key    BIGINT PRIMARY KEY REFERENCES cameras (key) ON DELETE CASCADE,
    media_type    TEXT   NOT NULL,
    content       BYTEA  NOT NULL,
    updated_at_us BIGINT NOT NULL
);
