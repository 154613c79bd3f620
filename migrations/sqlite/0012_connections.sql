-- Connections with other systems. `settings` is JSON and never contains a secret; `secrets` is a JSON object of texts,
-- which no interface shows.
CREATE TABLE connections (
    key           INTEGER PRIMARY KEY AUTOINCREMENT,
    id            TEXT    NOT NULL UNIQUE,
    display_name  TEXT    NOT NULL,
    paused        INTEGER NOT NULL CHECK (paused IN (0, 1)),
    settings      TEXT    NOT NULL,
    secrets       TEXT    NOT NULL,
    revision      INTEGER NOT NULL,
    created_at_us INTEGER NOT NULL,
    updated_at_us INTEGER NOT NULL
) STRICT;

-- Messages of sinks, in the order of their delivery. A row is deleted when its receiver has acknowledged it; a row with
-- a reason is not tried any more.
CREATE TABLE outbox (
    number         INTEGER PRIMARY KEY AUTOINCREMENT,
    connection_key INTEGER NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    message_id     TEXT    NOT NULL,
    subject        TEXT    NOT NULL,
    payload        BLOB    NOT NULL,
    created_at_us  INTEGER NOT NULL,
    dead_reason    TEXT
) STRICT;
CREATE INDEX outbox_queued ON outbox (connection_key, number) WHERE dead_reason IS NULL;
CREATE INDEX outbox_dead ON outbox (connection_key, number) WHERE dead_reason IS NOT NULL;
