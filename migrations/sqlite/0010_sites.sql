-- Cameras whose targets are tracked together. Keys are never used twice, as those of cameras.
CREATE TABLE sites (
    key                  INTEGER PRIMARY KEY AUTOINCREMENT,
    id                   TEXT    NOT NULL UNIQUE,
    display_name         TEXT    NOT NULL,
    labels               TEXT    NOT NULL,
    origin_longitude_deg REAL,
    origin_latitude_deg  REAL,
    revision             INTEGER NOT NULL,
    created_at_us        INTEGER NOT NULL,
    updated_at_us        INTEGER NOT NULL,
    CHECK ((origin_longitude_deg IS NULL) = (origin_latitude_deg IS NULL))
) STRICT;

-- NULL: the camera belongs to no site. A site that cameras name cannot be deleted.
ALTER TABLE cameras ADD COLUMN site_key INTEGER REFERENCES sites (key);
CREATE INDEX cameras_of_site ON cameras (site_key, id) WHERE site_key IS NOT NULL;
