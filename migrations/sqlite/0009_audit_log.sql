-- Who changed what, when and from where; written in the transaction of the change. Cameras are named by
-- their id, for entries outlive them. Numbers are never used twice.

CREATE TABLE audit_log (
    number     INTEGER PRIMARY KEY AUTOINCREMENT,
    time_us    INTEGER NOT NULL,
    actor      TEXT    NOT NULL,
    key_id     TEXT,
    address    TEXT,
    request_id TEXT,
    action     TEXT    NOT NULL,
    camera_id  TEXT,
    subject    TEXT
) STRICT;

CREATE INDEX audit_log_of_camera ON audit_log (camera_id, number) WHERE camera_id IS NOT NULL;
