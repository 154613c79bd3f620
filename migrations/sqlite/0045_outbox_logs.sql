-- How far the outbox of a sink has come in the log of positions that the server keeps for it. The row is there before the
-- server makes positions and goes when all of them are in the outbox, so that of an earlier run tells of positions that may
-- be lost.
CREATE TABLE outbox_logs (
    connection_key INTEGER NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    log            TEXT    NOT NULL,
    position       INTEGER NOT NULL,
    PRIMARY KEY (connection_key, log)
) STRICT, WITHOUT ROWID;
