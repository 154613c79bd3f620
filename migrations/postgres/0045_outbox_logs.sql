-- How far the outbox of a sink has come in the log of positions that a process keeps for it. The row is there before the
-- process makes positions and goes when all of them are in the outbox, so one whose node is not registered any more tells
-- of positions that may be lost; `ended_at_us` is when that was first seen.
CREATE TABLE outbox_logs (
    connection_key BIGINT NOT NULL REFERENCES connections (key) ON DELETE CASCADE,
    log            TEXT COLLATE "C" NOT NULL,
    node_id        TEXT COLLATE "C",
    position       BIGINT NOT NULL,
    ended_at_us    BIGINT,
    PRIMARY KEY (connection_key, log)
);
